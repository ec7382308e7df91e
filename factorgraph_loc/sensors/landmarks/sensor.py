"""The landmark sensor of a run: it converts measurements to observations, and initialises new landmarks."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self, cast

import numpy as np

from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.measurement import GOING_BACK
from factorgraph_loc.model.settings import Estimated
from factorgraph_loc.sensors.base import Binding, Blocks, Columns, NewVariable, ResidualObservation, Sensor, Term, View
from factorgraph_loc.sensors.landmarks.candidates import Candidate, PartialSighting
from factorgraph_loc.sensors.landmarks.finder import LandmarkFinder
from factorgraph_loc.sensors.landmarks.known import KnownLandmarks
from factorgraph_loc.sensors.landmarks.measurement import BearingRange, BearingRangeSettings
from factorgraph_loc.sensors.motion import MOTION
from factors import positive, se2
from factors.graph import Factor
from factors.landmarks.factor import BearingRangeFactor, landmark_update
from factors.landmarks.kernels import innovations
from factors.landmarks.late import LateShares
from factors.landmarks.model import HEIGHT, PARAMETERS, TIME_OFFSET, on_floor
from factors.se2 import Array
from factors.update import GATE, Correction

NOT_LOCATED = "landmark not located yet"


def together(factors: Sequence[BearingRangeFactor]) -> BearingRangeFactor:
    """Return one factor with the landmarks of all ``factors``. All factors must depend on the same pose."""
    first, *rest = factors
    if not rest:
        return first
    covariances = [
        np.zeros((len(f.points), 2, 2)) if f.point_covariances is None else f.point_covariances for f in factors
    ]
    return replace(
        first,
        points=np.concatenate([f.points for f in factors]),
        ranges=np.concatenate([f.ranges for f in factors]),
        bearings=np.concatenate([f.bearings for f in factors]),
        point_covariances=np.concatenate(covariances),
    )


SURVEYED_ITERATIONS = 4  # number of linearisations if the position of a surveyed landmark is estimated
WORK = 8  # time to compute the likelihood of one landmark at one pose, relative to the time for an RFID tag
SMALL = 40  # maximum size of an error state that compiled code corrects
MAX_PENDING = 5  # maximum number of stored sightings of a new landmark; two of them must agree


@dataclass(frozen=True)
class LandmarkObservation(ResidualObservation):
    """The observation of one measurement of landmarks. One term contains all landmarks with a known position. Each
    other landmark has its own term. ``surveyed``: True if the position of a surveyed landmark is estimated."""

    surveyed: bool = False

    @property
    def work(self) -> int:
        return WORK * self.found

    @property
    def iterations(self) -> int | None:  # type: ignore[override]
        return SURVEYED_ITERATIONS if self.surveyed else None

    @property
    def measured(self) -> BearingRangeFactor:
        """One factor with all landmarks of the observation."""
        return together([cast(BearingRangeFactor, term.factor) for term in self.terms])

    def correct(
        self, pose: Array, covariance: Array, values: Blocks, columns: Columns, iterations: int = 1
    ) -> Correction:
        term = self.terms[0]
        if len(self.terms) == 1 and len(covariance) <= SMALL:
            held, first = (values[term.blocks[0]], columns[term.blocks[0]].start) if term.blocks else (np.zeros(0), 3)
            factor = cast(BearingRangeFactor, term.factor)
            update = landmark_update(factor, pose, covariance, held, first, iterations, self.settled)
            if update is not None:
                return update
        if not self.measured.model.late.share:
            return super().correct(pose, covariance, values, columns, iterations)
        terms = []
        for term in self.terms:
            rows = [slice(0, 3), *(columns[name] for name in term.blocks)]
            indices = np.concatenate([np.arange(part.start, part.stop) for part in rows])
            at = [pose, *(values[name] for name in term.blocks)]
            resolved = cast(BearingRangeFactor, term.factor).resolved(at, covariance[np.ix_(indices, indices)])
            terms.append(replace(term, factor=cast(Factor, resolved)))
        observation = ResidualObservation(self.t, tuple(terms))
        correction = observation.correct(pose, covariance, values, columns, iterations)
        at_prediction = [
            cast(BearingRangeFactor, term.factor).whitened([pose, *(values[name] for name in term.blocks)])[0]
            for term in self.terms
        ]
        return replace(correction, residual=np.concatenate(at_prediction))

    def log_likelihood(self, poses: Array, values: Blocks) -> Array:
        total = np.zeros(len(poses))
        for term in self.terms:
            factor, at, parameters = cast(BearingRangeFactor, term.factor), poses, None
            if factor.estimated and term.blocks[0] in values:
                parameters = np.zeros((len(poses), len(PARAMETERS)))
                parameters[:, list(factor.estimated)] = values[term.blocks[0]]
            if factor.free:  # shift the robots instead of the landmark, which has the same effect
                places = values[term.blocks[-1]]
                point = np.concatenate((places[:1], factor.points[:1, HEIGHT:]), axis=1)
                factor, at = replace(factor, points=point), poses.copy()
                at[:, :2] -= places - places[0]
            total += factor.log_likelihood(at, parameters)
        return total

    @property
    def things(self) -> frozenset[Hashable]:
        return frozenset(map(tuple, self.measured.points.tolist()))

    def at_its_time(self) -> Self | None:
        """Return an equivalent observation of the pose at the time ``t`` of the measurement. The original may depend on
        an earlier pose and the odometry since then. Returns None if it depends on other blocks of the state."""
        if self.blocks:
            return None
        factor = self.measured
        return replace(
            self, terms=(replace(self.terms[0], factor=replace(factor, offset=None, offset_covariance=None)),)
        )

    def on_pose(self, values: Blocks, spreads: Blocks) -> Self:
        """Return an observation that depends on the pose only. ``values``: the estimates (d,) of all blocks by name.
        ``spreads``: their covariances (d, d) by name. The covariances of landmarks and range biases are added to the
        noise. Those of calibration constants are ignored."""
        if len(self.terms) == 1 and not self.terms[0].blocks:
            return self
        fixed = []
        for term in self.terms:
            factor, names = cast(BearingRangeFactor, term.factor), list(term.blocks)
            own = names.pop() if factor.free else None
            bias = names.pop() if factor.biased else None
            point, shorter = None if own is None else values[own], 0.0 if bias is None else float(values[bias][0])
            bound = factor.fixed([values[name] for name in names], point, shorter)
            uncertain = np.zeros((2, 2)) if bound.point_covariances is None else bound.point_covariances[0]
            uncertain = uncertain if own is None else spreads[own]
            if bias is not None:  # a range error acts as a shift of the landmark along the line of sight
                uncertain = uncertain + spreads[bias] * np.eye(2)
            fixed.append(bound if len(names) == len(term.blocks) else replace(bound, point_covariances=uncertain[None]))
        factor = together(fixed)
        return type(self)(self.t, (Term(factor, (), 2 * len(factor.points)),), self.surveyed)


Sighted = tuple[float, LandmarkObservation]  # the observation, after the time [s] of the pose that it depends on


@dataclass(frozen=True)
class NewLandmarks:
    """Stored sightings of landmarks that are not yet in the state, by the name of the landmark's state block.

    ``pending``: sightings with range and bearing: the position (2,) of the landmark, its covariance (2, 2), and the
    observation. Two of them must agree before the landmark is added to the state. ``partial``: other sightings.
    """

    pending: Mapping[str, tuple[tuple[Array, Array, Sighted], ...]] = field(default_factory=dict)
    partial: Mapping[str, Candidate] = field(default_factory=dict)

    def without(self, name: str) -> NewLandmarks:
        """Return a copy without the sightings of the landmark ``name``."""
        pending = {key: rows for key, rows in self.pending.items() if key != name}
        return NewLandmarks(pending, {key: rows for key, rows in self.partial.items() if key != name})

    def propose(
        self, name: str, point: Array, covariance: Array, sighting: Sighted
    ) -> tuple[NewLandmarks, Sighted | None]:
        """Return a copy with the new ``sighting`` of the landmark ``name``, and None. If a stored sighting agrees with
        it, return a copy without all sightings of the landmark, and the stored sighting.

        ``point`` (2,), ``covariance`` (2, 2): the position of the landmark from the new ``sighting``.
        """
        waiting = self.pending.get(name, ())
        for earlier, noise, candidate in reversed(waiting):
            apart = point - earlier
            if positive.squared(apart, noise + covariance) < GATE:
                return self.without(name), candidate
        rows = (*waiting, (point, covariance, sighting))[-MAX_PENDING:]
        return replace(self, pending={**self.pending, name: rows}), None


class LandmarkSensor(Sensor):
    """A sensor of identified landmarks. :class:`KnownLandmarks` describes how it uses the map.

    A landmark that is not in the map becomes the state block ``bearing_range/NAME``, which all landmark sensors share.
    It is initialised when two sightings agree on its position, or when several ranges or bearings determine it.
    """

    modality = "bearing_range"
    lost = "landmarks were not where they were expected"

    def __init__(self, binding: Binding, settings: BearingRangeSettings, constants: Estimated) -> None:
        super().__init__(binding.name)
        world, motion, use = binding.setup.world, binding.motion, binding.use
        self.constants, self._motion, self._diagnostics = constants, motion, binding.diagnostics
        self._bias = settings.uncertainty.range_bias if binding.calibration == "all" else 0.0
        locates, biased = binding.points != "known", self._bias > 0.0
        self._landmarks = KnownLandmarks(
            settings, world, self._diagnostics, use, constants.indices, carries=True, locates=locates, biased=biased
        )
        # factors for global localization; with own diagnostics, so that no sighting is counted twice
        self._sought = KnownLandmarks(settings, world, Diagnostics())
        self._shared = (self.name,) if constants.names else ()
        self._new: NewLandmarks = NewLandmarks()
        self._before: deque[tuple[float, NewLandmarks]] = deque()
        self._late: LateShares = LateShares(settings.late)
        self._late_before: deque[tuple[float, LateShares]] = deque()
        self._finder: LandmarkFinder | None = None
        if use == "known" and world.landmarks:
            self.finder = self._finder = LandmarkFinder(self._sought.factor, motion, world.positions())

    def observe(self, m: BearingRange, view: View) -> Iterator[LandmarkObservation | NewVariable]:
        twist = self._motion.twist(m.t) if TIME_OFFSET in self.constants.indices else None
        known, single, inexact, unknown = self._landmarks.factors(m, view.offset, twist, self._late.expected)
        terms = [] if known is None else [Term(known, self._shared, 2 * len(known.points))]
        for name, factor in single:
            yield from self._new_bias(name, view)
            terms.append(self._term(name, factor, view))
        for name, factor in inexact:
            yield from self._new_bias(name, view) if factor.biased else ()
            block, (position, spread) = f"{self.modality}/{name}", self._landmarks.survey(name)
            if view.value(block) is None:
                yield NewVariable(block, position, np.zeros((2, 3)), {}, spread, ())
            # if the estimator has rejected the block, the covariance of the survey becomes noise
            if view.value(block) is None:
                prior = replace(factor, point_covariances=spread[None], free=False)
                terms.append(self._term(name, prior, view))
            else:
                terms.append(self._term(name, factor, view))
        surveyed = any(term.blocks != self._shared for term in terms)
        met: list[tuple[str, Term]] = []
        for name, factor in unknown:
            block = f"{self.modality}/{name}"
            if view.value(block) is None:
                biases = (f"{block}/bias",) if factor.biased else ()
                met.append((block, Term(factor, (*self._shared, *biases, block), 2)))
            else:
                yield from self._new_bias(name, view) if factor.biased else ()
                terms.append(self._term(name, factor, view))
        if terms:
            yield LandmarkObservation(m.t, tuple(terms), surveyed)
        for block, term in met if view.newest else ():
            self._before.append((m.t, self._new))
            while self._before[0][0] < m.t - GOING_BACK:
                self._before.popleft()
            is_partial = cast(BearingRangeFactor, term.factor).dof() < 2
            new = (self._located if is_partial else self._proposed)(m.t, block, term, view)
            if new is not None:
                yield from self._new_bias(block.partition("/")[2], view) if self._bias else ()
                yield new

    def _new_bias(self, name: str, view: View) -> Iterator[NewVariable]:
        """Yield a new state block for the range bias of the landmark ``name``, unless the state contains it."""
        block = f"{self.modality}/{name}/bias"
        if view.value(block) is None:
            yield NewVariable(block, np.zeros(1), np.zeros((1, 3)), {}, np.array([[self._bias**2]]), ())

    def _term(self, name: str, factor: BearingRangeFactor, view: View) -> Term:
        """Return the graph term of ``factor``, the sightings of the landmark ``name``. It depends on a range bias if
        the state has this bias."""
        block = f"{self.modality}/{name}"
        if factor.biased and view.value(f"{block}/bias") is None:
            factor = replace(factor, biased=False)
        biases = (f"{block}/bias",) if factor.biased else ()
        return Term(factor, (*self._shared, *biases, *((block,) if factor.free else ())), 2)

    def _proposed(self, t: float, block: str, term: Term, view: View) -> NewVariable | None:
        """Return a new state block if two sightings with range and bearing agree on the position of a landmark.
        Otherwise store the sighting ``term`` at ``t`` [s] and return None. ``block``: the name of the block."""
        shared = [value for name in self._shared if (value := view.value(name)) is not None]
        factor = replace(cast(BearingRangeFactor, term.factor), biased=False)
        point, (by_pose, *by_shared), noise = factor.locate([view.pose, *shared])
        current = (view.t, LandmarkObservation(t, (term,)))
        new = NewVariable(block, point, by_pose, dict(zip(self._shared, by_shared, strict=True)), noise, (current,))
        _, widened = new.joint(*view.joint())
        self._new, earlier = self._new.propose(block, point, widened, current)
        return None if earlier is None else replace(new, sightings=(earlier, current))

    def _located(self, t: float, block: str, term: Term, view: View) -> NewVariable | None:
        """Return a new state block if sightings with range alone or bearing alone determine the position of a landmark.
        Otherwise store the sighting ``term`` at ``t`` [s] and return None. ``block``: the name of the block."""
        factor = cast(BearingRangeFactor, term.factor)
        (along_floor,) = on_floor(factor.model, factor.points, factor.ranges).tolist()
        sighting = PartialSighting(self._motion.state(t), along_floor, float(factor.bearings[0]))
        source = (view.t, LandmarkObservation(t, (term,)))
        waiting = self._new.partial.get(block, Candidate())
        candidate = waiting.plus(sighting, source)
        position = None
        if candidate.is_due:
            constants = view.value(MOTION)
            known = (np.zeros(0), np.zeros((0, 0))) if constants is None else (constants, view.block_covariance(MOTION))
            noisier = replace(factor.model, range_sigma=math.hypot(factor.model.range_sigma, self._bias))
            position = candidate.position(noisier, self._motion, *known)
            candidate = candidate.tried()
        self._diagnostics.ignore(NOT_LOCATED, len(candidate.sources) - len(waiting.sources))
        if position is None:
            self._new = replace(self._new, partial={**self._new.partial, block: candidate})
            return None
        self._diagnostics.ignore(NOT_LOCATED, -len(candidate.sources))
        self._new = self._new.without(block)
        at = view.pose if view.offset is None else se2.compose(view.pose, view.offset.delta)
        mean = se2.transform_from(at, position.point)
        noise = _rotation(at[2]) @ position.covariance @ _rotation(at[2]).T
        x, y = mean - view.pose[:2]
        by_pose = np.column_stack((_rotation(view.pose[2]), (-y, x)))
        return NewVariable(block, mean, by_pose, {}, noise, cast("tuple[Sighted, ...]", candidate.sources))

    def judge(self, observation: LandmarkObservation, correction: Correction, view: View) -> bool:
        factor = observation.measured
        self._diagnostics.innovation(self.name, observation.t, correction.nis, correction.dof)
        ranges, bearings = innovations(factor.model.packed, correction.residual, factor.ranges, factor.bearings)
        self._diagnostics.add_residuals(f"{self.name}.range", ranges.tolist())
        self._diagnostics.add_residuals(f"{self.name}.bearing", bearings.tolist())
        if self._late.probability and len(bearings) < len(factor.bearings):
            self._learn(observation, view)
        return True

    def _learn(self, observation: LandmarkObservation, view: View) -> None:
        """Update the estimated fraction and excess of late (too long) ranges from ``observation``, which must include
        landmarks with range alone. ``view``: the current estimate."""
        self._late_before.append((observation.t, self._late))
        while self._late_before[0][0] < observation.t - GOING_BACK:
            self._late_before.popleft()
        values = {name: value for name in observation.blocks if (value := view.value(name)) is not None}
        alone = observation.on_pose(values, {name: view.block_covariance(name) for name in values})
        self._late = self._late.updated(*alone.measured.predicted(view.pose, view.covariance))

    @property
    def suspicious_since(self) -> float | None:
        return None if self._finder is None else self._finder.suspicious_since

    def accept(self) -> None:
        if self._finder is not None:
            self._finder.clear()

    def evidence(self, m: BearingRange) -> LandmarkObservation | None:
        factor = self._sought.factor(m)
        return None if factor is None else LandmarkObservation(m.t, (Term(factor, (), 2 * len(factor.points)),))

    def at_end(self, factor: Factor, width: float) -> Factor:
        return cast(BearingRangeFactor, factor).with_late(self._late.expected).widened(width)

    def rewind(self, t: float) -> None:
        while self._before and self._before[-1][0] > t:
            _, self._new = self._before.pop()
        while self._late_before and self._late_before[-1][0] > t:
            _, self._late = self._late_before.pop()

    def restart(self, t: float) -> None:
        self._late = LateShares(self._late.probability)
        self._late_before.clear()
        self._new = NewLandmarks()
        self._before.clear()


def _rotation(heading: float) -> Array:
    c, s = math.cos(heading), math.sin(heading)
    return np.array(((c, -s), (s, c)))


def bind(binding: Binding) -> LandmarkSensor | None:
    """Return the landmark sensor of a run, or None if the run does not use it. ``binding``: arguments of the sensor."""
    settings = binding.setup.rig.find(BearingRangeSettings)
    if settings is None or LandmarkSensor.modality not in binding.setup.sensors:
        return None
    names = PARAMETERS[:TIME_OFFSET] if binding.calibration == "particles" else PARAMETERS
    uncertainty = None if binding.calibration == "none" else settings.uncertainty
    return LandmarkSensor(binding, settings, Estimated.of(names, uncertainty))
