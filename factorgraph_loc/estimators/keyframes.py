"""What the graph estimators have in common: keyframes, the factors on them, and the trajectory between them.

A keyframe stands at each stamp of landmarks, unless the one before is nearer than ``keyframe_interval``, and at least every
``keyframe_max_interval``. What is seen between two keyframes, or arrives late, becomes a factor on the earlier one, displaced
by the odometry since.

Scans of RFID antennas come many a second and each tells little. Those from one keyframe to the next, half a second later, make one
factor, which enters the graph with the next keyframe; until then the newest pose is updated by them alone, as a filter would.
"""

from __future__ import annotations

import bisect
import math
from abc import ABC, abstractmethod
from dataclasses import replace

import numpy as np

from factorgraph_loc.estimators import landmarks
from factorgraph_loc.estimators.base import (
    Belief,
    Diagnostics,
    Learnt,
    LearntPoint,
    PoseEstimate,
    PosePrior,
    gaussian_belief,
)
from factorgraph_loc.estimators.graph_parts import Addition, GraphSettings, Guess, Keyframe, TickAt, between_keyframes
from factorgraph_loc.estimators.landmarks import KnownLandmarks, robust_update
from factorgraph_loc.estimators.mapping import NewLandmarks
from factorgraph_loc.estimators.motion import Motion, propagate
from factorgraph_loc.estimators.problem import Problem
from factorgraph_loc.estimators.registry import Setup
from factorgraph_loc.estimators.tags import TagUpdate
from factorgraph_loc.estimators.variables import ODOMETRY_KEY, SENSOR_KEY, Node, Values, landmark_key, pose_key
from factorgraph_loc.estimators.waiting_scans import WaitingScans
from factorgraph_loc.measurements import BearingRange, Exteroceptive, Measurement, Odometry, RfidScan, Tick
from factorgraph_loc.rig import NOTHING
from factorgraph_loc.trajectory import Trajectory
from factors import se2
from factors.bearing_range import TIME_OFFSET
from factors.bearing_range_factor import BearingRangeFactor
from factors.graph import Factor, PriorFactor, VectorPriorFactor
from factors.odometry import PARAMETERS, Increment, OdometryFactor, recalibrated
from factors.rfid_factor import ROWS, RfidFactor
from factors.rfid_likelihood import Looks
from factors.se2 import Array

ITERATIONS_OF_GUESS = 1
KEYFRAME_INTERVAL, MAPPING_KEYFRAME_INTERVAL = 0.09, 0.5  # s
SCAN_KEYFRAME_INTERVAL = 0.45  # s between keyframes that stand there for scans


class GraphEstimator(ABC):
    """Builds the graph as measurements come; what is done with it is the business of the classes below."""

    deterministic = True
    supports_unknown_start = False

    def __init__(self, setup: Setup, settings: GraphSettings) -> None:
        self.diagnostics = Diagnostics()
        self._graph_settings = settings
        self_calibration = settings.self_calibration
        self._motion = Motion(setup.rig, setup.sensors, self.diagnostics, self_calibration=self_calibration)
        self._odometry_constants = setup.rig.estimated_odometry() if settings.self_calibration else NOTHING
        self._sensor_constants = setup.rig.estimated_bearing_range() if settings.self_calibration else NOTHING
        self._landmarks = KnownLandmarks(setup, self.diagnostics, settings.landmarks, self._sensor_constants.indices)
        default = KEYFRAME_INTERVAL if settings.landmarks == "known" else MAPPING_KEYFRAME_INTERVAL
        self._interval = default if settings.keyframe_interval is None else settings.keyframe_interval
        self._scans = WaitingScans(setup, self.diagnostics)
        self._new_landmarks: NewLandmarks[tuple[int, BearingRangeFactor]] = NewLandmarks()
        self._places: dict[str, int] = {}  # numbers of the landmarks that were taken in
        # all variables but the poses: estimate and covariance
        self._constants, self._spreads = self._constant_priors()
        self._keyframes: list[Keyframe] = []
        self._keyframe_times: list[float] = []
        self._ticks: list[TickAt] = []
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
        if isinstance(measurement, Odometry):
            self._motion.add(measurement)
        elif self._prior is None:
            self.diagnostics.ignore("before the start")
        elif measurement.t < max(self._t - self._graph_settings.max_delay, self._prior.t):
            self._drop_late(measurement)
        else:
            self._take(measurement)

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
        """The constants and landmarks that are estimated."""
        values: dict[str, tuple[float, float]] = {}
        for key, prefix, constants in (
            (ODOMETRY_KEY, "", self._odometry_constants),
            (SENSOR_KEY, "bearing_range.", self._sensor_constants),
        ):
            if key in self._constants:
                sigmas = np.sqrt(np.diag(self._spreads[key]))
                for name, value, sigma in zip(constants.names, self._constants[key], sigmas, strict=True):
                    values[prefix + name] = (float(value), float(sigma))
        points = {
            name: LearntPoint(self._constants[landmark_key(i)], self._spreads[landmark_key(i)])
            for name, i in self._places.items()
        }
        return Learnt(values, points)

    def trajectory(self) -> Trajectory:
        """The best estimate of the whole past at the stamps of the ticks, from the start on; empty if there was none."""
        if self._prior is None:
            return Trajectory(np.empty(0), np.empty((0, 3)), np.empty((0, 3, 3)))
        if waiting := self._gather():
            self._attach(self._keyframes[-1], Addition(waiting), None)
        return self._between(*self._final())

    def _take(self, m: Exteroceptive | Tick) -> None:
        if isinstance(m, Tick):
            self._pass_time(m.t)
            return
        self._t = max(self._t, m.t)
        if isinstance(m, RfidScan):
            self._scan(m)
        else:
            self._see(m)

    def _drop_late(self, m: Exteroceptive | Tick) -> None:
        if isinstance(m, BearingRange):
            self.diagnostics.drop_late("bearing_range", len(m.landmarks))
        elif isinstance(m, RfidScan):
            self.diagnostics.drop_late("rfid", len(m.antennas))

    @abstractmethod
    def _final(self) -> tuple[Array, Array]:
        """The best estimate of all keyframes: poses (M, 3) and body-frame covariances (M, 3, 3)."""

    @abstractmethod
    def _begin(self, first: Keyframe) -> None:
        """Start the graph with its first keyframe and the prior."""

    @abstractmethod
    def _extend(self, keyframe: Keyframe, addition: Addition, spread: Array) -> None:
        """Add a keyframe and what came with it, and bring pose, covariance and constants up to date.

        The guess of its pose in ``addition``, and its body-frame covariance ``spread`` (3, 3), come from an update of the one
        before.
        """

    @abstractmethod
    def _attach(self, keyframe: Keyframe, addition: Addition, guess: Guess | None) -> None:
        """Add to a keyframe that is in the graph, and bring the estimate up to date.

        ``guess``: pose and covariance of the newest keyframe after the update, where it is that.
        """

    @abstractmethod
    def _refine(self, newest: Keyframe, guess: Guess) -> None:
        """Take over pose and covariance of the newest keyframe from scans that are not yet in the graph."""

    @abstractmethod
    def _scanned(self, t: float, looks: Looks, update: TagUpdate) -> None:
        """Antennas listened at ``t``; ``update``: what that changed."""

    @abstractmethod
    def _observed(self, t: float, seen: BearingRangeFactor, guess: Guess) -> None:
        """Landmarks of the map were seen at ``t`` from a keyframe whose pose is expected to be ``guess``."""

    def _is_open(self, keyframe: int) -> bool:
        """Whether factors may still be added to a keyframe."""
        return 0 <= keyframe < len(self._keyframes)

    def _pass_time(self, t: float) -> None:
        self._t = max(self._t, t)
        if t - self._keyframes[-1].t >= self._graph_settings.keyframe_max_interval:
            self._add_keyframe(t, None)
        before = self._keyframe_before(t)
        self._ticks.append(TickAt(t, before.index, self._since(before, t)))

    def _see(self, m: BearingRange) -> None:
        newest = self._keyframes[-1]
        if m.t - newest.t >= self._interval:
            self._add_keyframe(m.t, m)
            return
        before = self._keyframe_before(m.t)
        if not self._is_open(before.index):
            self.diagnostics.drop_late("bearing_range", len(m.landmarks))
            return
        offset = self._since(before, m.t) if m.t > before.t else None
        addition = Addition(self._gather())
        guess = self._sight(before, m, offset, (self._pose, self._covariance) if before is newest else None, addition)
        if addition.nodes:
            self._attach(before, addition, guess)

    def _scan(self, m: RfidScan) -> None:
        looks = self._scans.tags.looks(m)
        if looks is None:
            return
        if m.t - self._keyframes[-1].t >= SCAN_KEYFRAME_INTERVAL:
            self._add_keyframe(m.t, None)
        keyframe = self._keyframe_before(m.t)
        offset = self._since(keyframe, m.t).delta if m.t > keyframe.t else np.zeros(3)
        here = looks.moved(offset)
        if keyframe is not self._keyframes[-1]:
            self._add_late(keyframe, self._scans.factors(m, here), m)
            return
        update = self._scans.update(m, here, self._pose, self._covariance)
        if update is None:
            return
        self._take_over(update)
        self._scanned(m.t, looks, update)
        by_phases = self._scans.update_by_phases(m, self._places_at, self._pose, self._covariance)
        if by_phases is not None:
            self._take_over(by_phases)

    def _places_at(self, times: Array) -> Array:
        """Where the robot was at these times (R,), in the frame of the newest keyframe, (R, 3)."""
        changes = None
        if ODOMETRY_KEY in self._constants:
            changes = self._odometry_constants.full(self._constants[ODOMETRY_KEY], len(PARAMETERS))
        return self._motion.places(self._keyframes[-1].odometry, times, changes)

    def _take_over(self, update: TagUpdate) -> None:
        self._pose, self._covariance = update.pose, update.covariance
        self._refine(self._keyframes[-1], (update.pose, update.covariance))

    def _add_late(self, keyframe: Keyframe, factors: list[RfidFactor], m: RfidScan) -> None:
        if not self._is_open(keyframe.index):
            self._drop_late(m)
            return
        nodes = [Node((keyframe.key,), factor, ROWS) for factor in factors]
        keyframe.nodes += nodes
        self._attach(keyframe, Addition([*self._gather(), *nodes]), None)

    def _gather(self) -> list[Node]:
        """The scans from the newest keyframe, which are in no graph yet."""
        keyframe = self._keyframes[-1]
        nodes = [Node((keyframe.key,), factor, ROWS) for factor in self._scans.gather()]
        keyframe.nodes += nodes
        return nodes

    def _add_keyframe(self, t: float, m: BearingRange | None) -> None:
        newest = self._keyframes[-1]
        odometry = self._motion.state(t)
        increment = self._motion.relative(newest.odometry, odometry)
        moved = self._recalibrated(increment)
        keyframe = Keyframe(newest.index + 1, t, odometry, increment)
        guess: Guess | None = (se2.compose(self._pose, moved.delta), propagate(self._covariance, moved))
        addition = Addition(self._gather())
        self._keyframes.append(keyframe)
        self._keyframe_times.append(t)
        if m is not None:
            guess = self._sight(keyframe, m, None, guess, addition)
        assert guess is not None
        addition.values[keyframe.key] = guess[0]
        self._extend(keyframe, addition, guess[1])

    def _sight(
        self,
        keyframe: Keyframe,
        m: BearingRange,
        offset: Increment | None,
        guess: Guess | None,
        addition: Addition,
    ) -> Guess | None:
        """Turn a measurement into factors of ``keyframe``; returned is the guess of its pose, updated by them.

        The guess is where the graph linearises first, and what the robust weights are computed at. Without one (the keyframe is
        an older one) landmarks that are not yet in the graph stay out.
        """
        twist = self._motion.twist(m.t) if TIME_OFFSET in self._sensor_constants.indices else None
        nodes: list[Node] = []
        seen: list[BearingRangeFactor] = []
        met: list[tuple[str, BearingRangeFactor]] = []
        shared = (SENSOR_KEY,) if self._sensor_constants.names else ()
        constants = [self._constants[key] for key in shared]
        known = self._landmarks.factor(m, offset, twist)
        if known is not None:
            nodes.append(Node((keyframe.key, *shared), known, 2 * len(known.points)))
            seen.append(known.fixed(constants, None))
        for name, factor in self._landmarks.others(m, offset, twist):
            if name not in self._places:
                met.append((name, factor))
                continue
            key = landmark_key(self._places[name])
            nodes.append(Node((keyframe.key, *shared, key), factor, 2))
            here = factor.fixed(constants, self._constants[key])
            seen.append(replace(here, point_covariances=self._spreads[key][None]))
        if guess is not None:
            if known is not None:
                self._observed(m.t, known.fixed(constants, None), guess)
            if seen:
                factor = landmarks.together(seen)
                update = robust_update(factor, *guess, ITERATIONS_OF_GUESS)
                self._landmarks.report(m.t, factor, update)
                guess = se2.compose(guess[0], se2.exp(update.delta)), update.covariance
            for name, factor in met:
                self._meet(name, factor, keyframe, guess, addition)
        keyframe.nodes += nodes
        addition.nodes += nodes
        return guess

    def _meet(
        self, name: str, factor: BearingRangeFactor, keyframe: Keyframe, guess: Guess, addition: Addition
    ) -> None:
        """A landmark that is not in the graph: it comes in when an earlier sighting agrees, with both."""
        shared = (SENSOR_KEY,) if self._sensor_constants.names else ()
        point, (by_pose, *_), noise = factor.locate([guess[0], *(self._constants[key] for key in shared)])
        covariance = by_pose @ guess[1] @ by_pose.T + noise
        sighting = (keyframe.index, factor)
        self._new_landmarks, earlier = self._new_landmarks.propose(name, point, covariance, sighting)
        if earlier is None:
            return
        self._places[name] = len(self._places)
        key = landmark_key(self._places[name])
        self._constants[key], self._spreads[key] = point, covariance
        addition.values[key] = point
        for index, sighted in (earlier, sighting):
            if self._is_open(index):
                node = Node((pose_key(index), *shared, key), sighted, 2)
                self._keyframes[index].nodes.append(node)
                addition.nodes.append(node)

    def _keyframe_before(self, t: float) -> Keyframe:
        return self._keyframes[bisect.bisect_right(self._keyframe_times, t) - 1]

    def _since(self, keyframe: Keyframe, t: float) -> Increment:
        return self._recalibrated(self._motion.relative(keyframe.odometry, self._motion.state(t)))

    def _recalibrated(self, increment: Increment) -> Increment:
        if ODOMETRY_KEY not in self._constants:
            return increment
        changes = self._odometry_constants.full(self._constants[ODOMETRY_KEY], len(PARAMETERS))
        return Increment(recalibrated(increment, changes)[0], increment.covariance, increment.duration)

    def _constant_priors(self) -> tuple[Values, Values]:
        """Means and covariances of the sensors' constants before any measurement."""
        means: Values = {}
        spreads: Values = {}
        for key, constants in ((ODOMETRY_KEY, self._odometry_constants), (SENSOR_KEY, self._sensor_constants)):
            if constants.names:
                means[key], spreads[key] = np.zeros(len(constants.names)), np.diag(constants.sigmas**2)
        return means, spreads

    def _odometry_factor(self, keyframe: Keyframe) -> tuple[OdometryFactor, tuple[int, ...]]:
        """The factor from the keyframe before, and its keys."""
        assert keyframe.from_previous is not None
        keys: tuple[int, ...] = (pose_key(keyframe.index - 1), keyframe.key)
        if self._odometry_constants.names:
            keys = (*keys, ODOMETRY_KEY)
        return OdometryFactor(keyframe.from_previous, self._odometry_constants.indices), keys

    def _problem(self, width: float = 1.0) -> Problem:
        """All that is known as one problem; the robust losses ``width`` times as wide as they are, and without the phases of tags,
        which have many optima, where that is more than once."""
        assert self._prior is not None
        body = se2.world_to_body(self._prior.pose, self._prior.covariance)
        factors: list[tuple[Factor, tuple[int, ...]]] = [(PriorFactor(self._prior.pose, body), (pose_key(0),))]
        means, spreads = self._constant_priors()
        factors += [(VectorPriorFactor(means[key], np.sqrt(np.diag(spreads[key]))), (key,)) for key in means]
        factors += [self._odometry_factor(k) for k in self._keyframes[1:]]
        for keyframe in self._keyframes:
            for node in keyframe.nodes:
                assert node.factor is not None
                factor = node.factor
                if isinstance(factor, BearingRangeFactor):
                    factor = factor.widened(width)
                if width == 1.0 or not (isinstance(factor, RfidFactor) and factor.is_phase):
                    factors.append((factor, node.keys))
        return Problem(factors)

    def _settle(self, problem: Problem, values: Values) -> Array:
        """Take over a solution of the whole problem: the constants, and the body-frame covariances (M, 3, 3) that are returned."""
        covariances = problem.covariances(values, values)
        for key in self._constants:
            self._constants[key], self._spreads[key] = values[key], covariances[key]
        return np.array([covariances[k.key] for k in self._keyframes])

    def _between(self, poses: Array, covariances: Array) -> Trajectory:
        """The trajectory at the ticks from all keyframes: ``poses`` (M, 3) and body-frame ``covariances`` (M, 3, 3)."""
        steps = [self._recalibrated(k.from_previous) for k in self._keyframes if k.from_previous is not None]
        return between_keyframes(self._ticks, steps, poses, covariances)
