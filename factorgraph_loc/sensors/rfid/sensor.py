"""The RFID sensor of a run: it turns scans into observations of reads and misses, signal strength, and phase."""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self, cast

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.settings import NOTHING, Estimated
from factorgraph_loc.sensors.base import Binding, Sensor, Term, View
from factorgraph_loc.sensors.rfid.installation import installed
from factorgraph_loc.sensors.rfid.known_tags import STANDING, KnownTags, TagEvidence, TagSignals, extent
from factorgraph_loc.sensors.rfid.monitor import (
    DURATION,
    KNOWN,
    POSSIBLE,
    BurstMonitor,
    ConsistencyMonitor,
    ScanMonitor,
    SilenceMonitor,
)
from factorgraph_loc.sensors.rfid.settings import RfidSettings
from factorgraph_loc.sensors.rfid.stream import RfidScan
from factors import positive
from factors.graph import Factor
from factors.rfid.detection import RfidLikelihood, TagReadCounts, merged
from factors.rfid.factor import ITERATIONS, NO_VALUES, RfidFactor
from factors.rfid.signals import PhaseLikelihood
from factors.se2 import Array
from factors.update import Correction

PLACED = 5.0  # m; maximum standard deviation of the position for a scan that gives evidence for the states of tags
SCAN = 50  # computing time of a scan without tags, relative to the time for one tag
# messages of events
DEAD_ANTENNA = "antenna {antenna} reads no tag although reads are expected: it is ignored until it reads a tag"
DOUBTED_MODEL = "reads are not as the detection models predict: {shares}"
SILENT = "no tag is read where some should be"


@dataclass(frozen=True)
class TagObservation:
    """An observation of RFID reads: of reads and misses, of signal strengths, or of phases.

    ``factor``: the likelihood, which depends on the pose and on estimated parameters of the detection models.
    ``found``: number of reads. ``here``: the reads and misses relative to the pose at the scan, None for strength and
    phase. ``rounds``: number of inventory rounds. ``blocks``: the name of the state block with the estimated
    parameters, or (). ``states``: likelihood of the scan if tags are dead, weak or moved, or None.
    """

    t: float
    factor: RfidFactor
    found: int
    here: TagReadCounts | None = None  # reads and misses relative to the pose at ``t``; None for strength and phase
    rounds: int = 0  # number of antenna rounds
    blocks: tuple[str, ...] = ()
    states: TagEvidence | None = None  # evidence from the scan for the states of tags
    iterations: ClassVar[int] = ITERATIONS

    @property
    def is_judged(self) -> bool:
        """True if this is an observation of reads and misses."""
        return self.here is not None

    @property
    def work(self) -> int:
        return self.factor.work

    @property
    def things(self) -> frozenset[Hashable]:
        """The indices in the map of the tags that were read."""
        reads = self.factor.reads
        return frozenset(reads.read_tags.tolist()) if isinstance(reads, TagReadCounts) else frozenset()

    def at_its_time(self) -> Self | None:
        """Return an equivalent observation of the pose at the time ``t`` of the scan. The original may depend on an
        earlier pose and the odometry since then. Returns None for signal strengths and phases. The result has the
        detection models of the rig instead of estimated models."""
        likelihood = self.factor.likelihood
        if self.here is None or not isinstance(likelihood, RfidLikelihood):
            return None
        of_rig = likelihood.adjusted(np.zeros_like(likelihood.parameters))
        return replace(self, factor=replace(self.factor, likelihood=of_rig, reads=self.here))

    @property
    def terms(self) -> tuple[Term, ...]:
        return (Term(self.factor, self.blocks, self.factor.rows),)

    def correct(
        self,
        pose: Array,
        covariance: Array,
        values: Mapping[str, Array],
        columns: Mapping[str, slice],
        iterations: int = 1,
    ) -> Correction:
        """Return the correction of a Gaussian estimate of pose and blocks by this observation, computed by Fisher
        scoring. For the arguments see :meth:`.Observation.correct`."""
        at, prior = [0, 1, 2], NO_VALUES
        for name in self.blocks:  # there is at most one block
            at, prior = [*at, *range(columns[name].start, columns[name].stop)], np.array(values[name])
        own = np.ascontiguousarray(covariance[np.ix_(at, at)])
        correction = self.factor.correct(pose, own, prior, iterations)
        if len(covariance) == len(at):
            return correction
        gain = positive.solve(own, covariance[at]).T
        posterior = covariance - gain @ (own - correction.covariance) @ gain.T
        return replace(correction, delta=gain @ correction.delta, covariance=posterior)

    def log_likelihood(self, poses: Array, values: Mapping[str, Array]) -> Array:
        return self.factor.log_likelihood(poses, *(values[name] for name in self.blocks))

    def on_pose(self, values: Mapping[str, Array], spreads: Mapping[str, Array]) -> Self:
        """Return an observation that depends on the pose only. ``values``: the estimated parameters of the detection
        models by block, treated as exact. ``spreads`` is ignored."""
        if not self.blocks:
            return self
        return replace(self, factor=self.factor.fixed(values[self.blocks[0]]), blocks=())


class TagSensor(Sensor):
    """A sensor that uses the scans of an RFID reader.

    Each scan yields an observation of reads and misses, and an observation of signal strengths. Time windows of phases
    yield further observations. Scans are rejected while the reader has failed (:class:`.SilenceMonitor`). Global
    localization uses reads and misses only, because the likelihoods of strength and phase are multimodal.
    """

    modality = "rfid"
    lost = "tags were not read as they were expected"
    keyframe_every = 0.45
    gathers = True
    evidence_every = 0.0

    def __init__(self, binding: Binding, constants: Estimated) -> None:
        super().__init__(binding.name)
        setup, diagnostics = binding.setup, binding.diagnostics
        self.constants, self._wheels = constants, binding.motion
        self._blocks = (self.name,) if constants.names else ()
        self.tags = KnownTags(setup, diagnostics)
        self.tags.likelihood.prepare()
        self.work = SCAN + round(self.tags.likelihood.reached)
        self.bounds = extent(setup.world, self.tags.surveyed)
        self._diagnostics = diagnostics
        self._signals = TagSignals(setup, self.tags)
        self._monitor, self._silence = ScanMonitor(), SilenceMonitor()
        self._bursts = BurstMonitor(len(self.tags.antennas), len(self.tags.map.names))
        self._consistency = ConsistencyMonitor(self.tags.antennas)
        self._heard = -math.inf  # time [s] of the last scan of the silence monitor
        self._confirmed = -math.inf  # time [s] after which states of tags and models are estimated with a new pose

    def observe(self, m: RfidScan, view: View) -> Iterator[TagObservation]:
        twist = self._wheels.twist(m.t) if "time_offset" in self.constants.names else STANDING
        counts = self.tags.read_counts(m, twist)
        if counts is None:
            return
        relative = counts if view.offset is None else counts.moved(view.offset.delta)
        evidence = None
        if view.localized and np.trace(view.covariance[:2, :2]) < PLACED**2:
            evidence = self.tags.weigh_states(relative, view.pose, view.covariance, self._estimated(view))
            counts = self.tags.with_states(counts, evidence)
            relative = counts if view.offset is None else counts.moved(view.offset.delta)
        observation = replace(self._detection(m, relative, counts), states=evidence)
        yield observation if not view.localized or self._learns(m.t) else observation.on_pose(self._values(view), {})
        if self._silence.lasts and view.newest:
            return
        strengths = self._signals.strengths(m)
        if strengths is not None and self._signals.strength is not None:
            yield TagObservation(
                m.t, RfidFactor(self._signals.strength, strengths.moved(relative.offsets[0])), len(strengths.rssi)
            )
        if view.newest and view.localized:
            self._signals.forget(m.t)
            if self._signals.keep(m):
                window = self._signals.phases(view.poses_at(self._signals.times()), view.pose)
                if window is not None:
                    yield TagObservation(m.t, window, 1)

    def _learns(self, t: float) -> bool:
        """Return True if detection models and states of tags may be estimated at ``t`` [s]. Returns False if the pose
        was recently replaced or is suspicious, or if the wheels slip."""
        return not self._wheels.is_slipping and self.suspicious_since is None and t >= self._confirmed

    def _detection(self, m: RfidScan, moved: TagReadCounts, counts: TagReadCounts) -> TagObservation:
        """Return the observation of reads and misses of the scan ``m``. ``counts``: the reads and misses, relative to
        the pose at the scan. ``moved``: these reads and misses, relative to the pose that the observation must depend
        on."""
        factor = RfidFactor(self.tags.likelihood, moved, self.constants.indices)
        return TagObservation(m.t, factor, int(counts.hits.sum()), counts, len(m.antennas), self._blocks)

    def judge(self, observation: TagObservation, correction: Correction, view: View) -> bool:
        t = observation.t
        assert correction.evidence is not None
        self._diagnostics.innovation("rfid", t, correction.nis, correction.dof)
        if view.newest and not self._is_evidence(observation, correction.evidence):
            self._diagnostics.reject(SilenceMonitor.REJECTED, observation.rounds)
            return False
        if view.newest:
            self._monitor.add(t, correction.excess_nll, correction.variance)
        if observation.states is not None and self._monitor.suspicious_since is None and t >= self._confirmed:
            self.tags.learn(t, observation.states)
            if view.newest:
                self._count(observation, view)
        return True

    def _count(self, observation: TagObservation, view: View) -> None:
        """Compare the reads of ``observation`` with reads predicted at the pose in ``view``. This adapts the tempering
        of the likelihood, excludes dead antennas, and reports detection models that contradict the reads."""
        assert isinstance(observation.factor.reads, TagReadCounts)
        t, measured, states = observation.t, observation.factor.reads, self.tags.states
        reads = self.tags.likelihood.expected(view.pose, measured, self._estimated(view))
        surveyed = states.odds[reads.tags] <= 0.0
        self._bursts.add(t, measured, reads, surveyed)
        self.tags.temper(1.0 / self._bursts.overdispersion)
        if np.trace(view.covariance[:2, :2]) < KNOWN**2:
            # tags that were read are also counted if they seem to have moved, because a wrong model has the same effect
            counts = (reads.p > POSSIBLE) & (surveyed | states.were_read(reads.tags))
            overdispersion = 1.0 / self.tags.likelihood.model.tempering
            doubted = self._consistency.doubted
            self._consistency.add(t, measured, reads, counts, overdispersion)
            for antenna in self._consistency.dead_antennas(overdispersion):
                name = self.tags.exclude(antenna)
                self._diagnostics.event(t, "dead_antenna", DEAD_ANTENNA, antenna=name)
                self._consistency.clear()
            if self._consistency.doubted and not doubted:
                self._diagnostics.event(t, "doubted_model", DOUBTED_MODEL, shares=self._consistency.shares)

    def _values(self, view: View) -> dict[str, Array]:
        """Return the estimated parameters (P,) of the detection models as {name of the state block: parameters}. Return
        {} if no parameters are estimated."""
        value = view.value(self.name) if self._blocks else None
        return {} if value is None else {self.name: value}

    def _estimated(self, view: View) -> Array:
        """Return all parameters (Q,) of the read likelihood. Those that are estimated have their estimates in
        ``view``."""
        out = self.tags.likelihood.parameters.copy()
        for value in self._values(view).values():
            out[list(self.constants.indices)] = value
        return out

    def _is_evidence(self, observation: TagObservation, evidence: float) -> bool:
        """Return False if the reader or all tags have failed at the time of ``observation``, otherwise True.
        ``evidence``: the log-probability of the scan at the predicted pose."""
        # a scan without reads counts only once, even if it is processed again after a late measurement
        if observation.found or observation.t > self._heard:
            lasted = self._silence.lasts
            if self._silence.add(observation.found, evidence) and not lasted:
                self._diagnostics.event(observation.t, "silent", SILENT)
                self.tags.silent()
            self._heard = max(self._heard, observation.t)
        return not self._silence.lasts

    def evidence(self, m: RfidScan) -> TagObservation | None:
        counts = self.tags.read_counts(m, count=False)
        if counts is None:
            return None
        observation = self._detection(m, counts, counts)  # with the detection models of the rig
        return replace(observation, factor=replace(observation.factor, estimated=()), blocks=())

    @property
    def suspicious_since(self) -> float | None:
        return self._monitor.suspicious_since

    @property
    def silent(self) -> bool:
        return self._silence.lasts

    @property
    def doubts_model(self) -> bool:
        return self._consistency.doubted

    def accept(self) -> None:
        self._monitor.accept()

    def gathered(self, observations: Sequence[TagObservation]) -> list[Term]:
        """Return the graph factors of ``observations`` of the same pose: one factor for all reads and misses, and one
        for each observation of strength or phase."""
        counts: list[TagReadCounts] = []
        terms: list[Term] = []
        for observation in observations:
            factor = observation.factor
            if isinstance(factor.reads, TagReadCounts):
                counts.append(factor.reads)
            else:
                terms.append(Term(factor, (), factor.rows))
        if counts:
            factor, blocks = RfidFactor(self.tags.likelihood, merged(counts), self.constants.indices), self._blocks
            fixed = next((o.factor for o in observations if o.is_judged and not o.blocks), None)
            if blocks and fixed is not None:
                factor, blocks = replace(fixed, reads=factor.reads), ()
            terms.append(Term(factor, blocks, factor.rows))
        return terms

    def at_end(self, factor: Factor, width: float) -> Factor | None:
        """Return a copy of ``factor`` without the effect of tags that are clearly dead, weak or moved. ``width``: the
        multiplier of the scale of robust losses. Returns None for phases if ``width`` is above 1, because their
        likelihood has local optima centimetres apart."""
        factor = cast(RfidFactor, factor)
        if width > 1.0 and isinstance(factor.likelihood, PhaseLikelihood):
            return None
        if not isinstance(factor.reads, TagReadCounts):
            return factor
        return replace(factor, reads=self.tags.without_doubtful(factor.reads))

    def rewind(self, t: float) -> None:
        self.tags.forget(math.nextafter(t, math.inf))

    def restart(self, t: float) -> None:
        self._confirmed = max(t, self._heard) + DURATION
        self._monitor.clear()
        self._bursts.clear()
        self._consistency.clear()
        self._signals.clear()
        self.tags.forget(t)


def bind(binding: Binding) -> TagSensor | None:
    """Return the RFID sensor of a run, or None if the run does not use it. ``binding``: the arguments of the sensor.
    Raises InputError if the run uses strength or phase, and the rig lacks their model or antennas on the robot."""
    settings, sensors = binding.setup.rig.rfid, binding.setup.sensors
    signals = [signal for signal in ("rssi", "phase") if signal in sensors]
    if settings is not None and settings.tags and signals:
        raise InputError(
            f"the sensor {signals[0]} needs antennas on the robot, but the robot has tags ([rfid.tags]): leave it out of --sensors"
        )
    for signal in signals:
        if getattr(settings, signal, None) is None:
            raise InputError(f"the rig has no [rfid.{signal}]: add it, or do not use the sensor {signal}")
    if settings is None or TagSensor.modality not in sensors:
        return None
    # the mounting is not estimated from reads if strength or phase is used, because these use the mounting in the rig
    setup = installed(binding.setup)
    settings = setup.rig.of(RfidSettings)
    constants = NOTHING if binding.calibration == "none" else settings.estimated(mounting=not signals)
    return TagSensor(replace(binding, setup=setup), constants)
