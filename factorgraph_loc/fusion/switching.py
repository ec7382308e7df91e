"""A fusion rule that uses RFID when tags are read, and vision otherwise (Raoui, Bouyakhf, Devy, ICINCO 2011, section 5).

An RFID scan with a read of a mapped tag makes a particle filter active. A scan without such a read makes an EKF active, which uses
all sensors except RFID. The inactive filter processes odometry only. At a change, the newly active filter starts from the mean and
covariance of the pose of the previous one. Only the pose is passed on, so uncertain constants of the odometry count as noise in
both filters. The final trajectory is smoothed over all changes (Rauch, Tung, Striebel, 1965), from the causal estimates.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import Field

from factorgraph_loc.fusion.base import EVERY
from factorgraph_loc.fusion.ekf import Ekf, EkfSettings
from factorgraph_loc.fusion.filter import Filter, FilterSettings, at_ticks
from factorgraph_loc.fusion.particle_filter import ParticleFilter, ParticleFilterSettings
from factorgraph_loc.model.belief import Belief, Learnt, PoseEstimate, PosePrior
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.measurement import Measurement, Tick
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.base import Binding
from factorgraph_loc.sensors.motion import Motion
from factorgraph_loc.sensors.registry import bound_sensors, sensor_of
from factors import positive, se2
from factors.motion import ChainState, Increment, propagate
from factors.se2 import Array

JUMPED = 50.0  # squared Mahalanobis distance: above it an estimate does not follow from the previous one
# This is added to covariances (standard deviations in m, m, rad), because identical particles have a singular covariance.
LEAST = np.diag((1e-4, 1e-4, 1e-4)) ** 2


class SwitchingSettings(FilterSettings):
    """Settings of the estimator ``Switching``, which uses a particle filter while RFID tags are read, otherwise
    an EKF."""

    particles: Annotated[int, Field(ge=10, le=1_000_000)] = 5000
    """number of particles of the particle filter"""


@dataclass(frozen=True)
class _PoseBelief:
    """An estimate during the run: ``pose`` (3,) with its body-frame ``covariance`` (3, 3). ``odometry``: the integrated
    odometry at its time."""

    odometry: ChainState
    pose: Array
    covariance: Array


class Switching:
    """An estimator that uses a particle filter while RFID tags are read, otherwise an EKF (Raoui, Bouyakhf, Devy,
    2011)."""

    deterministic = False
    takes_rows = True
    modalities = EVERY

    def __init__(self, setup: Setup, settings: SwitchingSettings) -> None:
        self.diagnostics = Diagnostics()
        self._smooth = settings.smooth
        self._motion = Motion(setup.rig, setup.sensors, Diagnostics())
        sensors = bound_sensors(Binding(setup, self._motion, Diagnostics()))
        self._scanners = {name: sensor for name, sensor in sensors.items() if sensor.gathers}
        scanning = {sensor_of(name).name for name in self._scanners}
        vision = {sensor_of(name).name for name in sensors} - scanning
        by_tags = replace(setup, sensors=tuple(s for s in setup.sensors if sensor_of(s).name not in vision))
        by_sight = replace(setup, sensors=tuple(s for s in setup.sensors if sensor_of(s).name not in scanning))
        delay = settings.max_delay
        of_tags = ParticleFilterSettings(
            max_delay=delay, smooth=False, self_calibration=False, particles=settings.particles
        )
        of_sight = EkfSettings(max_delay=delay, smooth=False, self_calibration=False)
        self._tags: Filter = ParticleFilter(by_tags, of_tags, self.diagnostics)
        self._vision: Filter = Ekf(by_sight, of_sight, self.diagnostics)
        self.supports_unknown_start = bool(scanning) or self._vision.supports_unknown_start
        self.supports_unknown_heading = bool(scanning) or self._vision.supports_unknown_heading
        self._active: Filter = self._tags if scanning else self._vision
        self._newest_scan = -np.inf
        self._ticks: list[float] = []
        self._records: dict[float, _PoseBelief] = {}  # the last estimate of each time [s]

    def initialize(self, prior: PosePrior) -> None:
        """Start from a Gaussian prior of the pose."""
        self._active.initialize(prior)

    def process(self, measurement: Measurement) -> None:
        """Process one measurement. A measurement that is older than the newest one by more than ``max_delay`` is
        counted and ignored."""
        if measurement.is_motion:
            self._tags.process(measurement)
            counted = self.diagnostics.ignored, self.diagnostics.late
            previous = [dict(counts) for counts in counted]
            self._vision.process(measurement)
            # both filters counted the same ignored and late measurements: restore the counts of the first filter
            for counts, once in zip(counted, previous, strict=True):
                counts.clear()
                counts.update(once)
            self._motion.add(measurement)
            return
        scanner = self._scanners.get(measurement.source)
        if scanner is not None and measurement.t >= self._newest_scan:
            self._newest_scan = measurement.t
            scan = scanner.evidence(measurement)
            self._hand_over(self._tags if scan is not None and scan.found else self._vision)
        if isinstance(measurement, Tick):
            self._ticks.append(measurement.t)
        if isinstance(measurement, Tick) or (scanner is not None) == (self._active is self._tags):
            self._active.process(measurement)
            self._record()
        elif scanner is not None:
            self.diagnostics.ignore(f"{measurement.source} while no tag is read", measurement.count)
        else:
            self.diagnostics.ignore("landmarks while tags are read")

    def estimate(self, t: float | None = None) -> PoseEstimate:
        """Return the estimate of the filter in use: at its newest measurement or, if later, at ``t`` [s]."""
        return self._active.estimate(t)

    def belief(self, t: float | None = None) -> Belief:
        """Return the probability distribution of the pose from the filter in use, at the time of :meth:`estimate`."""
        return self._active.belief(t)

    def learnt(self) -> Learnt:
        """Return an empty result, because no constants are estimated."""
        return Learnt()

    def trajectory(self) -> Trajectory:
        """Return the smoothed poses at the recorded times, or the estimates during the run if the setting ``smooth`` is
        false."""
        times = sorted(self._records)
        records = [self._records[t] for t in times]
        track = [(r.pose, r.covariance) for r in records[-1:]]
        for record, later in zip(records[-2::-1], records[:0:-1], strict=True):
            step = self._motion.relative(record.odometry, later.odometry)
            track.append(_smoothed(record, step, track[-1]) if self._smooth else (record.pose, record.covariance))
        poses = np.array([pose for pose, _ in track[::-1]]).reshape(-1, 3)
        covariances = np.array([covariance for _, covariance in track[::-1]]).reshape(-1, 3, 3)
        ticks = [t for t in self._ticks if times and t >= times[0]]
        return at_ticks(ticks, np.array(times), poses, covariances)

    def forget(self, until: float) -> None:
        """Delete the trajectory before the time ``until`` [s]. The part that a measurement with a delay up to
        ``max_delay`` can still change is not deleted."""
        for part in (self._tags, self._vision):
            part.forget(until)
        self._ticks = [t for t in self._ticks if t >= until]
        self._records = {t: record for t, record in self._records.items() if t >= until}

    def _hand_over(self, successor: Filter) -> None:
        """Use the filter ``successor`` from now on, and start it at the current pose. Does nothing if the pose is not
        localized."""
        if successor is self._active:
            return
        now = self._active.estimate()
        if now.status != "localized":
            return
        self._active = successor
        self._active.initialize(PosePrior(now.t, now.pose, now.covariance + LEAST))

    def _record(self) -> None:
        now = self._active.estimate()
        if now.status != "unlocalized":
            body = se2.world_to_body(now.pose, now.covariance)
            self._records[now.t] = _PoseBelief(self._motion.state(now.t), now.pose, body + LEAST)


def _smoothed(record: _PoseBelief, step: Increment, later: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return the smoothed pose (3,) and covariance (3, 3) of ``record``. ``step``: the motion to the next record.
    ``later``: the smoothed pose and covariance of the next record. If these contradict ``record`` and ``step``, the
    pose and covariance of ``record`` are returned unchanged."""
    predicted = propagate(record.covariance, step)
    error = se2.log(se2.between(se2.compose(record.pose, step.delta), later[0]))
    if positive.squared(error, predicted + later[1]) > JUMPED:
        return record.pose, record.covariance
    moved = se2.adjoint(se2.inverse(step.delta))
    change, covariance = positive.smoothed(record.covariance, moved, step.covariance, error, later[1])
    return se2.compose(record.pose, se2.exp(change)), covariance
