"""Extended Kalman filter on SE(2), with Rauch-Tung-Striebel smoothing for its final trajectory.

The error state is a body-frame perturbation of the pose (Sola, Deray, Atchuthan, 2018, section IV), followed by the constants of
odometry and sensors that are estimated, and by the landmarks that the map lacks (EKF-SLAM: Smith, Self, Cheeseman, 1990). A
measurement whose innovation is too large has its noise widened instead of being dropped, so that the filter cannot lock itself out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.linalg.lapack import dpotrf

from factorgraph_loc.fusion.heading_search import HeadingSearch
from factorgraph_loc.fusion.known_position import KnownPosition
from factorgraph_loc.fusion.timeline import Filter, FilterSettings, at_ticks, world_estimate
from factorgraph_loc.model.belief import Belief, PoseEstimate, PosePrior
from factorgraph_loc.model.learnt import Learnt, LearntPoint
from factorgraph_loc.model.measurement import Exteroceptive, Tick
from factorgraph_loc.model.setup import MapUse, Setup
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.variable import NOTHING
from factorgraph_loc.sensors.camera.finder import MISSED, PixelFinder
from factorgraph_loc.sensors.camera.measurement import PixelSightings
from factorgraph_loc.sensors.camera.sensor import ITERATIONS, SETTLED, KnownPoints, Predicted
from factorgraph_loc.sensors.landmarks.measurement import BearingRange
from factorgraph_loc.sensors.landmarks.pending import NewLandmarks
from factorgraph_loc.sensors.landmarks.sensor import KnownLandmarks, together
from factorgraph_loc.vision.frame import CameraFrame
from factors import positive, se2
from factors.camera.factor import ReprojectionFactor
from factors.landmarks.factor import BearingRangeFactor
from factors.landmarks.model import TIME_OFFSET
from factors.motion import Increment
from factors.odometry.model import PARAMETERS, recalibrated
from factors.se2 import Array
from factors.update import update_state

SKEW = 1e-7  # of two standard deviations: more asymmetry is not one of a few roundings


class EkfSettings(FilterSettings):
    """``iterations``: 1 is the plain update; more linearise again at the updated pose (Bell and Cathey, 1993). Pixels, which are
    sharp, have as many as they need.

    ``self_calibration``: constants to which the rig gives an uncertainty are states. ``landmarks``: see
    :class:`~factorgraph_loc.sensors.landmarks.sensor.KnownLandmarks`.
    """

    iterations: Annotated[int, Field(ge=1, le=20)] = 1
    self_calibration: bool = True
    landmarks: MapUse = "known"


@dataclass(frozen=True)
class _State:
    """``pose`` (3,); ``rest`` (R,): constants, then ``landmarks``; ``covariance`` (3+R, 3+R) of the error state.

    ``waiting``: landmarks that are not in the state yet.
    """

    pose: Array
    rest: Array
    covariance: Array
    landmarks: tuple[str, ...] = ()
    waiting: NewLandmarks[bool] = field(default_factory=NewLandmarks)

    def plus(self, delta: Array, covariance: Array) -> _State:
        pose = se2.compose(self.pose, se2.exp(delta[:3]))
        return replace(self, pose=pose, rest=self.rest + delta[3:], covariance=covariance)

    def first(self, size: int) -> _State:
        """The first ``size`` components of the error state: without landmarks that were met later."""
        return _State(self.pose, self.rest[: size - 3], self.covariance[:size, :size])


@dataclass(frozen=True)
class _Step:
    """A prediction: the pose that it led to, the first rows (3, S) of its transition, and the covariance (3, 3) that it added."""

    pose: Array
    transition: Array
    noise: Array

    def covariance(self, before: Array) -> Array:
        """The covariance (S, S) after the prediction, from that before."""
        moved = self.transition @ before
        after = before.copy()
        after[:3] = moved
        after[:, :3] = moved.T
        after[:3, :3] = moved @ self.transition.T + self.noise
        return after


@dataclass(frozen=True)
class _Record:
    t: float
    step: _Step  # from the record before
    updated: _State


class Ekf(Filter):
    """The EKF; see the module."""

    modalities = frozenset({"bearing_range", "camera"})
    _state: _State

    def __init__(self, setup: Setup, settings: EkfSettings) -> None:
        super().__init__(setup, settings)
        self._iterations = settings.iterations
        self._odometry_constants = setup.rig.estimated("odometry") if settings.self_calibration else NOTHING
        self._sensor_constants = setup.rig.estimated("bearing_range") if settings.self_calibration else NOTHING
        self._landmarks = KnownLandmarks(setup, self.diagnostics, settings.landmarks, self._sensor_constants.indices)
        self._camera_constants = setup.rig.estimated("camera") if settings.self_calibration else NOTHING
        self._points = KnownPoints(setup, self.diagnostics, self._camera_constants, motion=self._motion)
        self._finder = PixelFinder(self._points, self._motion)
        self.supports_unknown_start = self._points.known
        self.supports_unknown_heading = self._points.known or self._landmarks.known
        self._setup = setup
        self._search: HeadingSearch | None = None
        # where the constants lie in the state's rest, and where the landmarks begin
        middle = len(self._odometry_constants.names)
        end = middle + len(self._sensor_constants.names)
        self._first_landmark = end + len(self._camera_constants.names)
        self._odometry_part, self._sensor_part = slice(0, middle), slice(middle, end)
        self._camera_part = slice(end, self._first_landmark)
        self._step: _Step | None = None

    def initialize(self, prior: PosePrior) -> None:
        """Start from a Gaussian; without a heading, once what is seen tells it."""
        self._search = None
        if prior.has_heading:
            super().initialize(prior)
            return
        self._wait(prior.t)
        start = KnownPosition(prior, self._motion)
        self._search = HeadingSearch(self._setup, self._motion, start, self._finder)

    def estimate(self, t: float | None = None) -> PoseEstimate:
        """The pose at the time of the newest measurement or tick, or at ``t`` if that is later; ``ambiguous`` while its heading is
        sought."""
        if self._search is None:
            return super().estimate(t)
        at = self._t if t is None else max(t, self._t)
        likeliest = self._search.belief(at).modes[0]
        return PoseEstimate(at, likeliest.pose, likeliest.covariance, "ambiguous")

    def belief(self, t: float | None = None) -> Belief:
        """The belief behind :meth:`estimate`; of all headings while that is sought."""
        if self._search is None:
            return super().belief(t)
        return self._search.belief(self._t if t is None else max(t, self._t))

    def learnt(self) -> Learnt:
        """The constants and landmarks that are estimated."""
        if self._state is None:
            return Learnt()
        rest, covariance = self._state.rest, self._state.covariance[3:, 3:]
        sigmas = np.sqrt(np.diag(covariance))
        names = [*self._odometry_constants.names, *(f"bearing_range.{name}" for name in self._sensor_constants.names)]
        names += [f"camera.{name}" for name in self._camera_constants.names]
        points = {}
        for number, name in enumerate(self._state.landmarks):
            part = self._landmark_part(number)
            points[name] = LearntPoint(rest[part], covariance[part, part])
        return Learnt({n: (float(v), float(s)) for n, v, s in zip(names, rest, sigmas, strict=False)}, points)

    def trajectory(self) -> Trajectory:
        """The smoothed estimates (Rauch, Tung, Striebel, 1965), or the causal ones with ``smooth`` off."""
        records: list[_Record] = self._records
        if not records:  # nothing told where an unknown start was
            return Trajectory(np.empty(0), np.empty((0, 3)), np.empty((0, 3, 3)))
        smoothed = records[-1].updated
        poses, covariances = [smoothed.pose], [smoothed.covariance[:3, :3]]
        for after, record in zip(records[:0:-1], records[-2::-1], strict=True):
            smoothed = self._smoothed(record.updated, after.step, smoothed) if self._smooth else record.updated
            poses.append(smoothed.pose)
            covariances.append(smoothed.covariance[:3, :3])
        times = np.array([r.t for r in records])
        return at_ticks(self._ticks, times, np.array(poses[::-1]), np.array(covariances[::-1]))

    def _smoothed(self, here: _State, step: _Step, after: _State) -> _State:
        """The state ``here`` given what came later: ``step`` led from it to where ``after`` is the smoothed state."""
        after = after.first(len(here.covariance))
        predicted = step.covariance(here.covariance)
        carried = here.covariance.copy()  # transition times covariance
        carried[:3] = step.transition @ here.covariance
        gain = positive.solve(predicted, carried).T
        change = np.concatenate((se2.log(se2.between(step.pose, after.pose)), after.rest - here.rest))
        covariance = here.covariance + gain @ (after.covariance - predicted) @ gain.T
        if not _is_sound(covariance):
            # a sum that is as positive as its parts, whatever the gain
            gain = positive.solve(positive.nearest(predicted), carried).T
            transition = np.eye(len(carried))
            transition[:3] = step.transition
            left, later = np.eye(len(carried)) - gain @ transition, after.covariance.copy()
            later[:3, :3] += step.noise
            covariance = positive.nearest(left @ here.covariance @ left.T + gain @ later @ gain.T)
        return here.plus(gain @ change, covariance)

    def _start(self, prior: PosePrior) -> _State:
        constants = (self._odometry_constants, self._sensor_constants, self._camera_constants)
        sigmas = np.concatenate([c.sigmas for c in constants])
        covariance = np.diag(np.concatenate((np.zeros(3), sigmas**2)))
        covariance[:3, :3] = se2.world_to_body(prior.pose, prior.covariance)
        return _State(np.array(prior.pose, dtype=float), np.zeros(len(sigmas)), covariance)

    def _predict(self, increment: Increment) -> None:
        s = self._state
        delta = increment.delta
        transition = np.zeros((3, len(s.covariance)))
        if self._odometry_constants.names:
            changes = self._odometry_constants.full(s.rest[self._odometry_part], len(PARAMETERS))
            delta, jacobian = recalibrated(increment, changes)
            places = list(self._odometry_constants.indices)
            transition[:, 3 : 3 + len(places)] = jacobian[:, places]
        transition[:, :3] = se2.adjoint(se2.inverse(delta))
        self._step = _Step(se2.compose(s.pose, delta), transition, increment.covariance)
        self._state = replace(s, pose=self._step.pose, covariance=self._step.covariance(s.covariance))

    def _update(self, m: BearingRange) -> None:
        self._step = self._step or self._standstill()
        twist = None
        if TIME_OFFSET in self._sensor_constants.indices:
            twist = self._motion.twist(m.t)
        known = self._landmarks.factor(m, None, twist)
        seen: list[tuple[BearingRangeFactor, slice | None]] = [] if known is None else [(known, None)]
        met: list[tuple[str, BearingRangeFactor]] = []
        for name, factor in self._landmarks.others(m, None, twist):
            if name in self._state.landmarks:
                seen.append((factor, self._landmark_part(self._state.landmarks.index(name))))
            else:
                met.append((name, factor))
        if seen:
            self._correct(m.t, seen)
        for name, factor in met:
            self._meet(name, factor)

    def _look(self, m: PixelSightings | CameraFrame) -> None:
        self._step = self._step or self._standstill()
        prior, part = self._state, self._camera_part
        twist = self._motion.twist(m.t) if self._points.needs_twist else None
        predicted = Predicted(prior.pose, prior.covariance[:3, :3])
        size = 3
        if self._camera_constants.names:
            size = 3 + part.stop
            spread = prior.covariance[3 + part.start : size, 3 + part.start : size]
            predicted = replace(predicted, constants=prior.rest[part], spread=spread)
        factor = self._points.factor(m, predicted, None, twist)
        if factor is not None:
            self._correct_by_pixels(m.t, factor, size)
        since = self._finder.refuted_since(m, self._odometry, self._state.pose)
        found = self._finder.best
        if since is not None and found is not None:
            self.diagnostics.events.append((m.t, f"lost: {MISSED} since {since:.1f} s; goes on at another place"))
            self._jump(found)

    def _begin(self, m: Exteroceptive | Tick) -> None:
        if self._search is None:
            super()._begin(m)
            return
        self._search.start.settle()
        if m.t < max(self._search.start.t, self._t - self._max_delay):
            self._drop_late(m)
            return
        self._t = max(self._t, m.t)
        found = self._search.take(m)
        if found is None:
            return
        again = self._search.kept()
        self.diagnostics.events.append((m.t, "localized"))
        self.initialize(found)
        for one in again:
            self._take(one)

    def _seek(self, m: Exteroceptive) -> _State | None:
        if not isinstance(m, PixelSightings | CameraFrame) or not self._finder.look(m, self._odometry):
            return None
        found = self._finder.best
        if found is None:
            return None
        self._finder.clear()
        self.diagnostics.events.append((m.t, "localized"))
        return self._start(found)

    def _jump(self, found: PosePrior) -> None:
        """Go on at another place: neither the pose nor what it has to do with the rest comes from the record before."""
        self._finder.clear()
        s, body = self._state, se2.world_to_body(found.pose, found.covariance)
        covariance = s.covariance.copy()
        covariance[:3], covariance[:, :3], covariance[:3, :3] = 0.0, 0.0, body
        self._state = replace(s, pose=np.array(found.pose), covariance=covariance)
        self._step = _Step(self._state.pose, np.zeros((3, len(covariance))), body)

    def _correct_by_pixels(self, t: float, factor: ReprojectionFactor, size: int) -> None:
        """Update pose and camera's constants, the first ``size`` components of the error state up to the last of them."""
        prior, part = self._state, self._camera_part

        def linearize(delta: Array) -> tuple[Array, Array]:
            state = prior.plus(delta, prior.covariance)
            values = [state.pose, state.rest[part]] if self._camera_constants.names else [state.pose]
            residual, blocks = factor.whitened(values)
            jacobian = np.zeros((len(residual), 2, size))
            jacobian[..., :3] = blocks[0]
            if self._camera_constants.names:
                jacobian[..., 3 + part.start :] = blocks[1]
            return residual, jacobian

        update = update_state(linearize, prior.covariance, factor.weight, ITERATIONS, factor.dof(), SETTLED)
        self._points.report(t, factor, update)
        self._state = prior.plus(update.delta, update.covariance)

    def _correct(self, t: float, seen: Sequence[tuple[BearingRangeFactor, slice | None]]) -> None:
        prior = self._state
        size = 3  # of the part of the state that the measurement depends on
        if any(part is not None for _, part in seen):
            size = len(prior.covariance)
        elif self._sensor_constants.names:
            size = 3 + self._sensor_part.stop

        def linearize(delta: Array) -> tuple[Array, Array]:
            state = prior.plus(delta, prior.covariance)
            parts = []
            for factor, part in seen:
                residual, blocks = factor.whitened(self._values(state, part))
                jacobian = np.zeros((len(residual), 2, size))
                jacobian[..., :3] = blocks[0]
                if self._sensor_constants.names:
                    jacobian[..., 3 + self._sensor_part.start : 3 + self._sensor_part.stop] = blocks[1]
                if part is not None:
                    jacobian[..., 3 + part.start : 3 + part.stop] = blocks[-1]
                parts.append((residual, jacobian))
            return np.concatenate([r for r, _ in parts]), np.concatenate([j for _, j in parts])

        measured = together([factor for factor, _ in seen])
        update = update_state(linearize, prior.covariance, measured.weight, self._iterations, measured.dof())
        self._landmarks.report(t, measured, update)
        self._state = prior.plus(update.delta, update.covariance)

    def _meet(self, name: str, factor: BearingRangeFactor) -> None:
        """A landmark that is not in the state: it comes in when an earlier sighting agrees, at where it is seen now."""
        s = self._state
        size = len(s.covariance)
        point, blocks, noise = factor.locate(self._values(s, None))
        jacobian = np.zeros((2, size))
        jacobian[:, :3] = blocks[0]
        if self._sensor_constants.names:
            jacobian[:, 3 + self._sensor_part.start : 3 + self._sensor_part.stop] = blocks[1]
        carried = jacobian @ s.covariance
        spread = carried @ jacobian.T + noise
        waiting, earlier = s.waiting.propose(name, point, spread, True)
        if earlier is None:
            self._state = replace(s, waiting=waiting)
            return
        covariance = np.empty((size + 2, size + 2))
        covariance[:size, :size] = s.covariance
        covariance[size:, :size], covariance[:size, size:], covariance[size:, size:] = carried, carried.T, spread
        self._state = _State(s.pose, np.concatenate((s.rest, point)), covariance, (*s.landmarks, name), waiting)

    def _values(self, state: _State, landmark: slice | None) -> list[Array]:
        """The values of a factor."""
        values = [state.pose]
        if self._sensor_constants.names:
            values.append(state.rest[self._sensor_part])
        if landmark is not None:
            values.append(state.rest[landmark])
        return values

    def _landmark_part(self, number: int) -> slice:
        start = self._first_landmark + 2 * number
        return slice(start, start + 2)

    def _estimate(self) -> PoseEstimate:
        return world_estimate(self._t, self._state.pose, self._state.covariance[:3, :3])

    def _record(self) -> _Record:
        step, self._step = self._step or self._standstill(), None
        return _Record(self._t, step, self._state)

    def _standstill(self) -> _Step:
        """The step to a second measurement of the same time."""
        return _Step(self._state.pose, np.eye(3, len(self._state.covariance)), np.zeros((3, 3)))


def _is_sound(covariance: Array) -> bool:
    """Whether rounding left a covariance symmetric and positive."""
    variances = covariance.diagonal()
    skew = np.abs(covariance - covariance.T)
    if skew.max() > SKEW * variances.min() and np.any(skew**2 > SKEW**2 * np.outer(variances, variances)):
        return False
    return bool(dpotrf(covariance, lower=1)[1] == 0)  # LAPACK's own, as this is asked at each step
