"""What the graph estimators have in common: keyframes, the factors on them, and the trajectory between them.

A keyframe stands at each stamp of landmarks, unless the one before is nearer than ``keyframe_interval``, and at least every
``keyframe_max_interval``. What is seen between two keyframes, or arrives late, becomes a factor on the earlier one, displaced
by the odometry since.
"""

from __future__ import annotations

import bisect
import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from pydantic import Field

from factorgraph_loc.estimators.base import Belief, Diagnostics, Learnt, PoseEstimate, PosePrior, gaussian_belief
from factorgraph_loc.estimators.landmarks import KnownLandmarks, robust_update
from factorgraph_loc.estimators.motion import Motion, propagate
from factorgraph_loc.estimators.problem import Problem, pose_key
from factorgraph_loc.estimators.registry import Setup
from factorgraph_loc.files import FileModel
from factorgraph_loc.measurements import BearingRange, Measurement, Tick
from factorgraph_loc.trajectory import Trajectory
from factors import se2
from factors.bearing_range import BearingRangeFactor
from factors.odometry import PARAMETERS, ChainState, Increment, OdometryFactor, recalibrated
from factors.se2 import Array

ITERATIONS_OF_GUESS = 1


class GraphSettings(FileModel):
    """Settings of every graph estimator, in seconds; see the module. ``max_delay``: how late a measurement may come."""

    keyframe_interval: Annotated[float, Field(ge=0.0, le=10.0)] = 0.09
    keyframe_max_interval: Annotated[float, Field(gt=0.0, le=60.0)] = 1.0
    max_delay: Annotated[float, Field(ge=0.0, le=4.0)] = 0.5


@dataclass
class Keyframe:
    """A pose variable of the graph: its time, the odometry there, and the factors that hang on it alone."""

    index: int
    t: float
    odometry: ChainState
    from_previous: Increment | None
    factors: list[BearingRangeFactor] = field(default_factory=list)

    @property
    def key(self) -> int:
        return pose_key(self.index)


@dataclass(frozen=True)
class _Tick:
    """A stamp at which the trajectory is wanted, and the motion to it from the keyframe before."""

    t: float
    keyframe: int
    since: Increment


class GraphEstimator(ABC):
    """Builds the graph as measurements come; what is done with it is the business of the classes below."""

    deterministic = True
    supports_unknown_start = False

    def __init__(self, setup: Setup, settings: GraphSettings) -> None:
        self.diagnostics = Diagnostics()
        self._graph_settings = settings
        self._motion = Motion(setup.rig, setup.sensors, self.diagnostics)
        self._landmarks = KnownLandmarks(setup, self.diagnostics)
        self._estimated = setup.rig.estimated_odometry()
        self._parameters = np.zeros(len(self._estimated.indices))
        self._parameter_covariance = np.diag(self._estimated.sigmas**2)
        self._keyframes: list[Keyframe] = []
        self._keyframe_times: list[float] = []
        self._ticks: list[_Tick] = []
        self._t = -math.inf
        self._prior: PosePrior | None = None
        # of the newest keyframe: pose and body-frame covariance
        self._pose = np.full(3, np.nan)
        self._covariance = np.full((3, 3), np.nan)

    def initialize(self, prior: PosePrior) -> None:
        """Start from a Gaussian."""
        self._prior = prior
        self._t = prior.t
        self._pose = np.array(prior.pose, dtype=float)
        self._covariance = se2.world_to_body(prior.pose, prior.covariance)
        first = Keyframe(0, prior.t, self._motion.state(prior.t), None)
        self._keyframes, self._keyframe_times = [first], [prior.t]
        self._begin(first)

    def process(self, measurement: Measurement) -> None:
        """Take one measurement, in time or late by at most ``max_delay``."""
        if not isinstance(measurement, BearingRange | Tick):
            self._motion.add(measurement)
        elif self._prior is None:
            self.diagnostics.ignore("before the start")
        elif measurement.t < max(self._t - self._graph_settings.max_delay, self._prior.t):
            if isinstance(measurement, BearingRange):
                self.diagnostics.drop_late("bearing_range", len(measurement.landmarks))
        elif isinstance(measurement, Tick):
            self._pass_time(measurement.t)
        else:
            self._t = max(self._t, measurement.t)
            self._see(measurement)

    def estimate(self) -> PoseEstimate:
        """The newest keyframe, moved along the odometry since."""
        if self._prior is None:
            return PoseEstimate(self._t, np.full(3, np.nan), np.full((3, 3), np.nan), "unlocalized")
        pose, covariance = self._pose, self._covariance
        if self._t > self._keyframes[-1].t:
            since = self._since(self._keyframes[-1], self._t)
            pose, covariance = se2.compose(pose, since.delta), propagate(covariance, since)
        return PoseEstimate(self._t, pose, se2.body_to_world(pose, covariance), "localized")

    def belief(self) -> Belief:
        """The belief behind :meth:`estimate`."""
        return gaussian_belief(self.estimate())

    def learnt(self) -> Learnt:
        """The odometry's constants that are estimated."""
        sigmas = np.sqrt(np.diag(self._parameter_covariance))
        return Learnt(
            {n: (float(v), float(s)) for n, v, s in zip(self._estimated.names, self._parameters, sigmas, strict=True)}
        )

    @abstractmethod
    def trajectory(self) -> Trajectory:
        """The best estimate of the whole past at the stamps of the ticks."""

    @abstractmethod
    def _begin(self, first: Keyframe) -> None:
        """Start the graph with its first keyframe and the prior."""

    @abstractmethod
    def _extend(self, keyframe: Keyframe, guess: Array, spread: Array) -> None:
        """Add a keyframe with its factors, and bring pose, covariance and parameters up to date.

        ``guess`` (3,) and ``spread`` (3, 3): its pose and body-frame covariance by an update of the one before.
        """

    @abstractmethod
    def _attach(self, keyframe: Keyframe, factor: BearingRangeFactor) -> None:
        """Add a factor to an earlier keyframe (it is already among its factors), and bring the estimate up to date."""

    def _pass_time(self, t: float) -> None:
        self._t = max(self._t, t)
        if t - self._keyframes[-1].t >= self._graph_settings.keyframe_max_interval:
            self._add_keyframe(t, None)
        before = self._keyframe_before(t)
        self._ticks.append(_Tick(t, before.index, self._since(before, t)))

    def _see(self, m: BearingRange) -> None:
        newest = self._keyframes[-1]
        if m.t - newest.t >= self._graph_settings.keyframe_interval:
            self._add_keyframe(m.t, m)
            return
        before = self._keyframe_before(m.t)
        factor = self._landmarks.factor(m, self._since(before, m.t) if m.t > before.t else None)
        if factor is not None:
            if before is newest:
                seen = robust_update(factor, self._pose, self._covariance, iterations=1)
                self._landmarks.report(m.t, factor, seen)
            before.factors.append(factor)
            self._attach(before, factor)

    def _add_keyframe(self, t: float, m: BearingRange | None) -> None:
        newest = self._keyframes[-1]
        odometry = self._motion.state(t)
        increment = self._motion.relative(newest.odometry, odometry)
        moved = self._recalibrated(increment)
        keyframe = Keyframe(newest.index + 1, t, odometry, increment)
        pose, covariance = se2.compose(self._pose, moved.delta), propagate(self._covariance, moved)
        factor = None if m is None else self._landmarks.factor(m)
        if factor is not None:
            # the guess is where the graph linearises first, and what the robust weights are computed at
            seen = robust_update(factor, pose, covariance, ITERATIONS_OF_GUESS)
            self._landmarks.report(t, factor, seen)
            pose, covariance = se2.compose(pose, se2.exp(seen.delta)), seen.covariance
            keyframe.factors.append(factor)
        self._keyframes.append(keyframe)
        self._keyframe_times.append(t)
        self._extend(keyframe, pose, covariance)

    def _keyframe_before(self, t: float) -> Keyframe:
        return self._keyframes[bisect.bisect_right(self._keyframe_times, t) - 1]

    def _since(self, keyframe: Keyframe, t: float) -> Increment:
        return self._recalibrated(self._motion.relative(keyframe.odometry, self._motion.state(t)))

    def _recalibrated(self, increment: Increment) -> Increment:
        if not len(self._parameters):
            return increment
        delta, _ = recalibrated(increment, self._estimated.full(self._parameters, len(PARAMETERS)))
        return Increment(delta, increment.covariance, increment.duration)

    def _problem(self, width: float = 1.0) -> Problem:
        """All that is known as one problem; the robust losses ``width`` times as wide as they are."""
        assert self._prior is not None
        steps = [k.from_previous for k in self._keyframes if k.from_previous is not None]
        return Problem(
            self._prior,
            self._estimated.sigmas,
            [OdometryFactor(step, self._estimated.indices) for step in steps],
            [(k.index, factor.widened(width)) for k in self._keyframes for factor in k.factors],
        )

    def _between(self, poses: Array, covariances: Array) -> Trajectory:
        """The trajectory at the ticks from all keyframes: ``poses`` (M, 3) and body-frame ``covariances`` (M, 3, 3).

        A tick between two keyframes follows the odometry from the earlier one; what then misses the later one is spread in
        proportion to time. The covariance goes linearly from one to the other, plus that of a bridge pinned at both ends.
        """
        newest: dict[float, _Tick] = {tick.t: tick for tick in self._ticks}
        ticks = [newest[t] for t in sorted(newest)]
        at = np.empty((len(ticks), 3))
        spread = np.empty((len(ticks), 3, 3))
        for i, tick in enumerate(ticks):
            k = tick.keyframe
            at[i] = se2.compose(poses[k], tick.since.delta)
            spread[i] = propagate(covariances[k], tick.since)
            if k + 1 < len(self._keyframes):
                after = self._keyframes[k + 1]
                assert after.from_previous is not None
                whole = self._recalibrated(after.from_previous)
                share = tick.since.duration / whole.duration
                missed = se2.log(se2.between(se2.compose(poses[k], whole.delta), poses[k + 1]))
                at[i] = se2.compose(at[i], se2.exp(share * missed))
                bridge = share * (1.0 - share) * whole.covariance
                spread[i] = (1.0 - share) * covariances[k] + share * covariances[k + 1] + bridge
        return Trajectory(np.array([tick.t for tick in ticks]), at, se2.body_to_world(at, spread))
