"""Extended Kalman filter on SE(2), with Rauch-Tung-Striebel smoothing for its final trajectory.

The error state is a body-frame perturbation of the pose (Sola, Deray, Atchuthan, 2018, section IV), followed by named
blocks. A block has the estimated constants of the odometry or of a sensor, or a landmark that the map lacks (EKF-SLAM:
Smith, Self, Cheeseman, 1990). A measurement whose innovation is too large is not rejected. Its noise is increased
instead, so that a wrong estimate does not reject all further measurements.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from factorgraph_loc.fusion.base import record_each
from factorgraph_loc.fusion.filter import Checkpoint, Filter, FilterSettings, FilterView, at_ticks
from factorgraph_loc.fusion.layout import POSE, Layout, constants_of, learnt_from
from factorgraph_loc.fusion.timeline import Taken
from factorgraph_loc.fusion.tracking import JUMPED, Refuted, Tracking, is_doubted, laplace_evidence
from factorgraph_loc.model.belief import Learnt, PoseEstimate, PosePrior, Status
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.measurement import Measurement, Tick
from factorgraph_loc.model.setup import Calibration, MapUse, Setup
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.base import Binding, Link, NewVariable, Observation
from factorgraph_loc.sensors.known_position import KnownPosition
from factorgraph_loc.sensors.motion import MOTION
from factorgraph_loc.sensors.registry import bound_sensors
from factors import positive, se2
from factors.motion import ChainState, Increment
from factors.se2 import Array

NOWHERE = slice(POSE, POSE)  # the slice of a block that does not exist
# Size of the error state above which uncertain landmarks of the map are not added. Their covariances are then noise.
MOST = 150
# A search with particles finds an unknown start heading. The filter then starts with this heading, and processes the
# measurements of the search again. The standard deviation of the heading is first multiplied by this factor, so that
# only 1/16 of the information of the measurements counts twice.
HEADING_WIDENED = 4.0


class EkfSettings(FilterSettings):
    """Settings of the EKF."""

    iterations: Annotated[int, Field(ge=1, le=20)] = 1
    """number of linearisations of an update; more than 1 is the iterated EKF (Bell and Cathey, 1993); updates by pixels
    and tags ignore this setting and iterate as often as needed"""
    self_calibration: bool = True
    """whether sensor constants that have an uncertainty in the rig are estimated"""
    landmarks: MapUse = "known"
    """known: landmarks of the map are fixed, others are ignored; extended: landmarks that the map lacks are estimated
    too; unknown: all landmarks are estimated"""


class _State(NamedTuple):
    """The state of the filter. ``pose`` (3,). ``rest`` (R,): the values of sensor constants and landmarks.
    ``covariance`` (3+R, 3+R): of the error state, the pose's body-frame perturbation and ``rest``. ``layout``: the
    names of the parts of ``rest``."""

    pose: Array
    rest: Array
    covariance: Array
    layout: Layout

    def plus(self, delta: Array, covariance: Array) -> _State:
        """Return the state after a correction ``delta`` (3+R,), with the new ``covariance`` (3+R, 3+R)."""
        return _State(se2.moved(self.pose, delta), self.rest + delta[POSE:], covariance, self.layout)

    def first(self, size: int) -> _State:
        """Return the state with only the first ``size`` components of the error state."""
        if size == len(self.covariance):
            return self
        return self._replace(rest=self.rest[: size - POSE], covariance=self.covariance[:size, :size])

    def on_pose(self, observation: Observation) -> Observation:
        """Return ``observation`` as a function of the pose only. Constants and landmarks are fixed at their values in
        this state, and their covariances are added to the noise."""
        values, columns = self.layout.values(self.rest), self.layout.columns
        spreads = {name: self.covariance[columns[name], columns[name]] for name in observation.blocks}
        return observation.on_pose({name: values[name] for name in spreads}, spreads)

    def with_block(self, new: NewVariable) -> _State:
        """Return the state with the variable ``new``, such as a landmark, added at the end. Its correlations with the
        other variables are included."""
        size, columns = len(self.covariance), self.layout.columns
        cross, own = new.joint(self.covariance, columns)
        end = size + len(new.mean)
        covariance = np.empty((end, end))
        covariance[:size, :size] = self.covariance
        covariance[size:, :size], covariance[:size, size:], covariance[size:, size:] = cross, cross.T, own
        rest = np.concatenate((self.rest, new.mean))
        return _State(self.pose, rest, covariance, self.layout.plus(new.name, len(new.mean)))


class _Step(NamedTuple):
    """The data of a prediction step that the final smoother needs. ``pose`` (3,): the predicted pose. ``transition``
    (3, 3+R): the pose's rows of the transition matrix; other rows equal an identity matrix. ``noise`` (3, 3): the
    covariance added to the pose."""

    pose: Array
    transition: Array
    noise: Array


class _Record(NamedTuple):
    """A record of the filter at time ``t`` [s]. ``step``: the prediction from the previous record. ``updated``: the
    state after all updates at this time."""

    t: float
    step: _Step
    updated: _State


class _View(FilterView):
    """Gives sensors read access to the current estimates and covariances of the EKF."""

    localized = True
    _filter: Ekf

    @property
    def pose(self) -> Array:
        return self._filter._state.pose

    @property
    def covariance(self) -> Array:
        return self._filter._state.covariance[:POSE, :POSE]

    def value(self, name: str) -> Array | None:
        return self._filter._state.layout.values(self._filter._state.rest).get(name)

    def block_covariance(self, name: str) -> Array:
        part = self._filter._state.layout.columns[name]
        return self._filter._state.covariance[part, part]

    def joint(self) -> tuple[Array, Mapping[str, slice]]:
        return self._filter._state.covariance, self._filter._state.layout.columns


class Ekf(Filter):
    """Extended Kalman filter on SE(2), with a Rauch-Tung-Striebel smoother at the end. See the module docstring."""

    _state: _State

    def __init__(self, setup: Setup, settings: EkfSettings, diagnostics: Diagnostics | None = None) -> None:
        super().__init__(setup, settings, diagnostics)
        self._iterations = settings.iterations
        calibration: Calibration = "all" if settings.self_calibration else "none"
        use = settings.landmarks
        self._sensors = bound_sensors(Binding(setup, self._motion, self.diagnostics, use=use, calibration=calibration))
        self._constants = constants_of(self._motion, self._sensors)
        finders = {name: sensor for name, sensor in self._sensors.items() if sensor.finder is not None}
        slow = {name for name, sensor in finders.items() if sensor.finder and not sensor.finder.at_once}
        # the sensors of a search for a start or lost pose: all except those that need several measurements for a pose
        fast = {n: s for n, s in self._sensors.items() if n not in slow}
        self._search = Tracking(fast, self._motion, setup.rng, self.diagnostics)
        if self._search.possible:
            self._search.remember()
        self._headings = Tracking(finders, self._motion, setup.rng, self.diagnostics)
        self.supports_unknown_start = len(slow) < len(finders)
        self.supports_unknown_heading = self._headings.possible
        self._step: _Step | None = None

    def initialize(self, prior: PosePrior) -> None:
        """Start from a Gaussian prior of the pose. If the prior has no heading, the filter starts when measurements
        have determined the heading."""
        if prior.has_heading:
            super().initialize(prior)
            return
        self._wait(prior.t)
        self._seek_heading(prior, self._headings)

    def _prior(self, t: float, best: PosePrior, moved: Increment, start: KnownPosition | None) -> PosePrior:
        pose: Array = se2.compose(best.pose, se2.inverse(moved.delta))
        covariance = HEADING_WIDENED**2 * best.covariance
        covariance[2, 2] += HEADING_WIDENED**2 * moved.covariance[2, 2]
        if start is not None:
            known = np.diag((0.0, 0.0, covariance[2, 2]))
            known[:2, :2] = start.prior.covariance[:2, :2]
            pose, covariance = np.append(start.prior.pose[:2], pose[2]), known
        return PosePrior(t, pose, covariance)

    def learnt(self) -> Learnt:
        """Return the estimated sensor constants and landmarks, with standard deviations or covariances."""
        if self._state is None:
            return Learnt()
        values, view = self._state.layout.values(self._state.rest), _View(self)
        return learnt_from(
            self._constants, ((name, mean, view.block_covariance(name)) for name, mean in values.items())
        )

    def trajectory(self) -> Trajectory:
        """Return the poses at all recorded times, smoothed backwards (Rauch, Tung, Striebel, 1965). They are not
        smoothed if the setting ``smooth`` is false. The trajectory is empty if the start pose was never found."""
        records: list[_Record] = self._records
        if not records:  # the unknown start pose was never found
            return Trajectory(np.empty(0), np.empty((0, 3)), np.empty((0, 3, 3)))
        smoothed = records[-1].updated
        poses, covariances = [smoothed.pose], [smoothed.covariance[:3, :3]]
        for later, record in zip(records[:0:-1], records[-2::-1], strict=True):
            smoothed = self._smoothed(record.updated, later.step, smoothed) if self._smooth else record.updated
            poses.append(smoothed.pose)
            covariances.append(smoothed.covariance[:3, :3])
        times = np.array([r.t for r in records])
        return at_ticks(self._ticks, times, np.array(poses[::-1]), np.array(covariances[::-1]))

    def _smoothed(self, state: _State, step: _Step, later: _State) -> _State:
        """Return ``state`` smoothed with the next record. ``step``: the prediction from ``state`` to the next record.
        ``later``: the smoothed state of the next record."""
        later = later.first(len(state.covariance))
        change = np.concatenate((se2.twist_to(step.pose, later.pose), later.rest - state.rest))
        return state.plus(*positive.smoothed(state.covariance, step.transition, step.noise, change, later.covariance))

    def _start(self, prior: PosePrior) -> _State:
        sigmas = np.concatenate([constants.sigmas for constants in self._constants.values()])
        covariance = np.diag(np.concatenate((np.zeros(POSE), sigmas**2)))
        covariance[:POSE, :POSE] = se2.world_to_body(prior.pose, prior.covariance)
        return _State(np.array(prior.pose, dtype=float), np.zeros(len(sigmas)), covariance, Layout.of(self._constants))

    def record(self, ticks: Sequence[float]) -> list[PoseEstimate]:
        """Return one estimate for each of ``ticks``, increasing times [s] at which a run records the pose."""
        if self._begun == math.inf or ticks[0] <= self._t or self._search.waits:
            return record_each(self, ticks)
        self._anchor()
        self._ahead = None
        doubts_model, doubted = any(s.doubts_model for s in self._sensors.values()), is_doubted(self._sensors.values())
        estimates = []
        for t, (odometry, step, state, world) in zip(ticks, self._predictions(ticks), strict=True):
            checkpoint = Checkpoint(self._state, self._t, self._odometry, len(self._records), len(self._ticks))
            self._t, self._odometry, self._state = t, odometry, state
            self._ticks.append(t)
            self._records.append(_Record(t, step, state))
            self._remember(Taken(Tick(t), checkpoint), self._max_delay)
            estimates.append(PoseEstimate(t, state.pose, world, self._status(doubted=doubted), doubts_model))
        return estimates

    def _predict(self, t: float) -> None:
        ((self._odometry, self._step, self._state, _),) = self._predictions((t,))

    def _predictions(self, times: Sequence[float]) -> list[tuple[ChainState, _Step, _State, Array]]:
        """Return one tuple (odometry, step, state, covariance) for each of ``times`` [s]. ``odometry``: the integrated
        odometry. ``step``: the prediction step from the previous of these times. ``state``: the predicted state.
        ``covariance`` (3, 3): of its pose, in the world frame."""
        s = self._state
        part = s.layout.columns.get(MOTION, NOWHERE)
        constants = s.rest[part.start - POSE : part.stop - POSE]
        states, poses, transitions, noises, covariances, worlds = self._motion.predictions(
            self._odometry, times, s.pose, s.covariance, constants, part.start
        )
        steps = zip(states.tolist(), poses, transitions, noises, covariances, worlds, strict=True)
        return [(ChainState(*at), _Step(p, f, q), _State(p, s.rest, c, s.layout), w) for at, p, f, q, c, w in steps]

    def _see(self, m: Measurement) -> None:
        self._step = self._step or self._standstill()
        sensor, view = self._sensors[m.source], _View(self)
        for observation in sensor.observe(m, view):
            if isinstance(observation, Link):
                continue
            if isinstance(observation, NewVariable):
                if observation.sightings or len(self._state.covariance) < MOST:
                    self._state = self._state.with_block(observation)
                continue
            s = self._state
            values = s.layout.values(s.rest)
            correction = observation.correct(
                s.pose, s.covariance, values, s.layout.columns, observation.iterations or self._iterations
            )
            if observation.is_judged:
                if not sensor.judge(observation, correction, view):
                    continue
                self._search.slips.add(partial(_at_its_time, observation, s), self._odometry, view, correction)
            if self._search.serves(sensor):
                alone = s.on_pose(observation)
                self._search.expect(sensor, alone, self._odometry, view)
                evidence = partial(laplace_evidence, alone, s.pose, s.covariance[:POSE, :POSE], correction)
                self._search.keep(sensor, alone, self._odometry, evidence)
            self._state = s.plus(correction.delta, correction.covariance)
        self._doubt(m)

    def _pass(self, tick: Tick) -> None:
        self._doubt(tick)

    def _doubt(self, m: Measurement) -> None:
        """Check after the measurement ``m`` whether recent observations contradict the estimated poses. If they do,
        continue at the pose that a global search has found."""
        view = _View(self)
        refuted = self._search.refuted(m, view.track, view.pose_back)
        best = self._search.best if refuted is not None else None
        if refuted is not None and best is not None:
            self.diagnostics.event(m.t, "lost", JUMPED, why=refuted.why, since=refuted.since)
            self._jump(self._search.brought(best, self._odometry), refuted)

    def _seek(self, m: Measurement) -> _State | None:
        if not self.supports_unknown_start:
            return None
        pose = self._search.best if self._search.look(m, self._odometry) else None
        if pose is None:
            return None
        self._search.begin_track(by_search=True)
        self.diagnostics.event(m.t, "localized", "localized")
        return self._start(self._search.brought(pose, self._odometry))

    def _jump(self, best: PosePrior, refuted: Refuted) -> None:
        """Replace the estimated pose by ``best``, without correlation with other variables. The sensor constants are
        reset to their estimates from before ``refuted.since``, the time when the estimated pose became wrong."""
        self._search.begin_track(by_search=True)
        for sensor in self._sensors.values():
            sensor.restart(refuted.since)
        right = next((r.updated for r in reversed(self._records) if r.t < refuted.since), self._state)
        s = right if right.layout == self._state.layout else self._state
        body = se2.world_to_body(best.pose, best.covariance) + refuted.extra_covariance
        covariance = s.covariance.copy()
        covariance[:3], covariance[:, :3], covariance[:3, :3] = 0.0, 0.0, body
        self._state = s._replace(pose=np.array(best.pose), covariance=covariance)
        self._step = _Step(self._state.pose, np.zeros((3, len(covariance))), body)

    def _estimate(self) -> PoseEstimate:
        pose, covariance = self._state.pose, se2.body_to_world_one(self._state.pose, self._state.covariance)
        return PoseEstimate(self._t, pose, covariance, self._status(doubted=is_doubted(self._sensors.values())))

    def _status(self, *, doubted: bool) -> Status:
        """Return the status of the current estimate, "ambiguous" or "localized". ``doubted``: True if a sensor
        contradicts it."""
        unsure = doubted or self._search.is_unsure(self._t, self._state.covariance)
        return "ambiguous" if unsure else "localized"

    def _record(self) -> _Record:
        step, self._step = self._step or self._standstill(), None
        return _Record(self._t, step, self._state)

    def _standstill(self) -> _Step:
        """Return the prediction step between two measurements of equal time. It has no motion and no noise."""
        return _Step(self._state.pose, np.eye(3, len(self._state.covariance)), np.zeros((3, 3)))


def _at_its_time(observation: Observation, state: _State) -> Observation | None:
    """Return ``observation`` as a function of the pose at its own time, with constants and landmarks fixed at
    ``state``. Returns None if the observation does not implement this."""
    return state.on_pose(observation).at_its_time()
