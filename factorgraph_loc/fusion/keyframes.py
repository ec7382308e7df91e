"""What the graph estimators have in common: keyframes, the problem that they are part of, and the trajectory between them."""

from __future__ import annotations

import bisect
import copy
import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from factorgraph_loc.errors import RunFailedError
from factorgraph_loc.fusion.graph_parts import Addition, GraphSettings, Guess, Keyframe, TickAt, between_keyframes
from factorgraph_loc.fusion.kept import Kept
from factorgraph_loc.fusion.marginals import IndeterminateError, blamed, damped
from factorgraph_loc.fusion.problem import Problem
from factorgraph_loc.fusion.variables import (
    CAMERA_KEY,
    ODOMETRY_KEY,
    SENSOR_KEY,
    Node,
    Values,
    index_of,
    is_point,
    is_pose,
    landmark_key,
    pose_key,
)
from factorgraph_loc.model.belief import Belief, PoseEstimate, PosePrior, gaussian_belief
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.learnt import Learnt, LearntPoint
from factorgraph_loc.model.measurement import Exteroceptive, Measurement, Odometry, Tick
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.variable import NOTHING
from factorgraph_loc.sensors.odometry.motion import Motion
from factorgraph_loc.slam.new_points import FEWEST as FEWEST_SIGHTINGS
from factorgraph_loc.slam.unknown_points import UnknownPoints
from factors import se2
from factors.camera.factor import ReprojectionFactor
from factors.graph import Factor, PriorFactor, VectorPriorFactor
from factors.landmarks.factor import BearingRangeFactor
from factors.motion import Increment, propagate
from factors.odometry.kernels import recalibrated
from factors.odometry.model import PARAMETERS, OdometryFactor
from factors.rfid.factor import RfidFactor
from factors.se2 import Array


@dataclass(frozen=True)
class Conclusion:
    """A graph that is solved to its end: poses (M, 3) and body-frame covariances (M, 3, 3) of all its keyframes."""

    graph: KeyframeGraph
    poses: Array
    covariances: Array


class KeyframeGraph(ABC):
    """Keyframes and constants; how they come to be, and what is done with them, is the business of the classes below."""

    deterministic = True
    supports_unknown_start = False

    def __init__(self, setup: Setup, settings: GraphSettings) -> None:
        self.diagnostics = Diagnostics()
        self._graph_settings = settings
        self_calibration = settings.self_calibration
        self._motion = Motion(setup.rig, setup.sensors, self.diagnostics, self_calibration=self_calibration)
        self._odometry_constants = setup.rig.estimated("odometry") if settings.self_calibration else NOTHING
        self._sensor_constants = setup.rig.estimated("bearing_range") if settings.self_calibration else NOTHING
        self._camera_constants = setup.rig.estimated("camera") if settings.self_calibration else NOTHING
        self._places: dict[str, int] = {}  # numbers of the landmarks that were taken in
        self._unknown: UnknownPoints | None = None
        # points that have left the graph: estimate and covariance
        self._departed: tuple[Values, Values] = {}, {}
        # all variables but the poses: estimate and covariance
        self._constants, self._spreads = self._constant_priors()
        self._keyframes: Kept[Keyframe] = Kept()
        self._keyframe_times: Kept[float] = Kept()
        self._ticks: list[TickAt] = []
        self._anchored = False  # whether the odometry of the first keyframe counts: rows of before it may still come
        self._conclusion: Conclusion | None = None  # the end, until something is taken
        self._damping = 0.0  # the largest that covariances were computed with
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
        self._keyframes, self._keyframe_times, self._anchored = Kept([first]), Kept([prior.t]), False
        self._begin(first)

    def process(self, measurement: Measurement) -> None:
        """Take one measurement, in time or late by at most ``max_delay``."""
        self._conclusion = None
        if isinstance(measurement, Odometry):
            self._motion.add(measurement)
        elif self._prior is None:
            self.diagnostics.ignore("before the start")
        elif measurement.t < max(self._t - self._graph_settings.max_delay, self._prior.t):
            self._drop_late(measurement)  # type: ignore[arg-type]
        else:
            self._take(measurement)  # type: ignore[arg-type]

    def estimate(self, t: float | None = None) -> PoseEstimate:
        """The newest keyframe, moved along the odometry since, to the newest time or to ``t`` if that is later."""
        if self._prior is None:
            return PoseEstimate(self._t, np.full(3, np.nan), np.full((3, 3), np.nan), "unlocalized")
        at = self._t if t is None else max(t, self._t)
        pose, covariance = self._pose, self._covariance
        if at > self._keyframes[-1].t:
            since = self._since(self._keyframes[-1], at)
            pose, covariance = se2.compose(pose, since.delta), propagate(covariance, since)
        return PoseEstimate(at, pose, se2.body_to_world(pose, covariance), "localized")

    def belief(self, t: float | None = None) -> Belief:
        """The belief behind :meth:`estimate`."""
        return gaussian_belief(self.estimate(t))

    def learnt(self) -> Learnt:
        """The constants and landmarks that are estimated, as the final trajectory has them."""
        return self._learnt() if self._prior is None else self._concluded().graph._learnt()

    def trajectory(self) -> Trajectory:
        """The best estimate of the whole past at the stamps of the ticks, from the start on; empty if there was none."""
        if self._prior is None:
            return Trajectory(np.empty(0), np.empty((0, 3)), np.empty((0, 3, 3)))
        end = self._concluded()
        return end.graph._between(end.poses, end.covariances)

    def final_diagnostics(self) -> Diagnostics:
        """The diagnostics, and what the final trajectory adds to them."""
        return self.diagnostics if self._prior is None else self._concluded().graph.diagnostics

    def _learnt(self) -> Learnt:
        values: dict[str, tuple[float, float]] = {}
        for key, prefix, constants in (
            (ODOMETRY_KEY, "", self._odometry_constants),
            (SENSOR_KEY, "bearing_range.", self._sensor_constants),
            (CAMERA_KEY, "camera.", self._camera_constants),
        ):
            if key in self._constants:
                sigmas = np.sqrt(np.diag(self._spreads[key]))
                for name, value, sigma in zip(constants.names, self._constants[key], sigmas, strict=True):
                    values[prefix + name] = (float(value), float(sigma))
        points = {
            name: LearntPoint(self._constants[landmark_key(i)], self._spreads[landmark_key(i)])
            for name, i in self._places.items()
        }
        if self._unknown is None:
            return Learnt(values, points)
        positions, covariances = self._departed[0] | self._constants, self._departed[1] | self._spreads
        return Learnt(values, points, self._unknown.learnt(positions, covariances))

    def _concluded(self) -> Conclusion:
        """The graph as it is at its end, which is solved beside it: nothing that comes later shall depend on who asked."""
        if self._conclusion is None:
            graph = copy.copy(self)
            graph.diagnostics = self.diagnostics.copy()
            graph._keyframes = self._keyframes.copy()
            for place, keyframe in enumerate(self._keyframes, start=self._keyframes.first):
                graph._keyframes[place] = replace(keyframe, nodes=list(keyframe.nodes))
            graph._keyframes[-1].nodes += self._waiting_nodes()
            graph._constants, graph._spreads = dict(self._constants), dict(self._spreads)
            self._conclusion = Conclusion(graph, *graph._final())
        return self._conclusion

    def _anchor(self) -> None:
        """At the first measurement after a start: the odometry there is what has come by now."""
        if not self._anchored:
            first = self._keyframes[-1]
            first.odometry, self._anchored = self._motion.state(first.t), True

    @abstractmethod
    def _take(self, m: Exteroceptive | Tick) -> None:
        """Take a measurement that is not too late."""

    @abstractmethod
    def _drop_late(self, m: Exteroceptive | Tick) -> None:
        """Count a measurement that is too late."""

    @abstractmethod
    def _waiting_nodes(self) -> list[Node]:
        """What waits on the newest keyframe and is in no graph yet."""

    @abstractmethod
    def _odds_of_tags(self) -> Array:
        """Log-odds (T,) that each tag of the map is dead, as far as is known."""

    @abstractmethod
    def _final(self) -> tuple[Array, Array]:
        """The best estimate of all keyframes: poses (M, 3) and body-frame covariances (M, 3, 3).

        The graph may change its keyframes, constants and diagnostics, which are its own then; all else may only be read.
        """

    @abstractmethod
    def _begin(self, first: Keyframe) -> None:
        """Start the graph with its first keyframe and the prior."""

    @abstractmethod
    def _attach(self, keyframe: Keyframe, addition: Addition, guess: Guess | None) -> None:
        """Add to a keyframe that is in the graph, and bring the estimate up to date.

        ``guess``: pose and covariance of the newest keyframe after the update, where it is that.
        """

    def _is_open(self, keyframe: int) -> bool:
        """Whether factors may still be added to a keyframe."""
        return 0 <= keyframe < len(self._keyframes)

    def _keyframe_before(self, t: float) -> Keyframe:
        return self._keyframes[bisect.bisect_right(self._keyframe_times, t, self._keyframe_times.first) - 1]

    def _since(self, keyframe: Keyframe, t: float) -> Increment:
        start = keyframe.odometry if self._anchored else self._motion.state(keyframe.t)
        return self._recalibrated(self._motion.relative(start, self._motion.state(t)))

    def _recalibrated(self, increment: Increment) -> Increment:
        if ODOMETRY_KEY not in self._constants:
            return increment
        changes = self._odometry_constants.full(self._constants[ODOMETRY_KEY], len(PARAMETERS))
        delta = recalibrated(increment.delta, increment.moving, changes)
        return Increment(delta, increment.covariance, increment.duration, increment.still)

    def _constant_priors(self) -> tuple[Values, Values]:
        """Means and covariances of the sensors' constants before any measurement."""
        means: Values = {}
        spreads: Values = {}
        for key, constants in (
            (ODOMETRY_KEY, self._odometry_constants),
            (SENSOR_KEY, self._sensor_constants),
            (CAMERA_KEY, self._camera_constants),
        ):
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
        which have many optima, where that is more than once. Tags count by what is known of their states now, at the end, and not
        by what was known at each scan."""
        assert self._prior is not None
        body = se2.world_to_body(self._prior.pose, self._prior.covariance)
        natives: list[tuple[Factor, tuple[int, ...], gtsam.NonlinearFactor]] = []
        factors: list[tuple[Factor, tuple[int, ...]]] = [(PriorFactor(self._prior.pose, body), (pose_key(0),))]
        means, spreads = self._constant_priors()
        factors += [(VectorPriorFactor(means[key], np.sqrt(np.diag(spreads[key]))), (key,)) for key in means]
        factors += [self._odometry_factor(k) for k in self._keyframes[1:]]
        for keyframe in self._keyframes:
            for node in keyframe.nodes:
                assert node.factor is not None
                factor = node.factor
                if node.native is not None:
                    natives.append((factor, node.keys, node.native))
                    continue
                if isinstance(factor, BearingRangeFactor):
                    factor = factor.widened(width)
                elif isinstance(factor, RfidFactor):
                    if factor.is_phase and width > 1.0:
                        continue
                    factor = factor.with_odds(self._odds_of_tags())
                factors.append((factor, node.keys))
        return Problem(factors, natives)

    def _drop_astray(self, keyframes: Sequence[Keyframe], values: Values) -> bool:
        """Take sightings out of the graph that cannot be of their points, as these are estimated, and points of which too few are
        left. Returns whether there were any."""
        astray = {id(node): node for k in keyframes for node in k.nodes if _is_astray(node, values)}
        if not astray:
            return False
        left = Counter(_point(node) for k in self._keyframes for node in k.nodes if id(node) not in astray)
        for keyframe in keyframes:
            kept = [
                n
                for n in keyframe.nodes
                if id(n) not in astray and (_point(n) is None or left[_point(n)] >= FEWEST_SIGHTINGS)
            ]
            if len(kept) < len(keyframe.nodes):
                self.diagnostics.reject("camera: not where it was seen", len(keyframe.nodes) - len(kept))
                keyframe.nodes[:] = kept
        return True

    def _settle(self, problem: Problem, values: Values) -> Array:
        """Take over a solution of the whole problem: the constants, and the body-frame covariances (M, 3, 3) that are returned."""
        try:
            found = problem.covariances(values, values)
        except IndeterminateError as error:
            raise self._unsolved(error) from error
        self._report_damping(found.damping)
        for key in self._constants:
            self._constants[key], self._spreads[key] = values[key], found.by_key[key]
        return np.array([found.by_key[k.key] for k in self._keyframes])

    def _report_damping(self, damping: float) -> None:
        if damping > self._damping:
            self._damping = damping
            self.diagnostics.events.append((self._t, damped(damping)))

    def _unsolved(self, error: RuntimeError) -> RunFailedError:
        """What a user is told where the graph cannot be solved: when, and which variable is to blame."""
        return RunFailedError(f"the graph cannot be solved at {self._t:.3f} s: {self._reason(error)}")

    def _reason(self, error: RuntimeError) -> str:
        """An error of the solver, or of GTSAM's, in one line."""
        key = blamed(error)
        if key is None:
            lines = str(error).strip().splitlines()
            return lines[0] if lines else "no step leads to a better solution"
        return f"the measurements do not determine {self._named(key)}"

    def _named(self, key: int) -> str:
        """A variable in words."""
        if is_pose(key):
            return f"the pose at {self._keyframe_times[index_of(key)]:.3f} s"
        names = {ODOMETRY_KEY: "odometry", SENSOR_KEY: "sensor of landmarks", CAMERA_KEY: "camera"}
        if key in names:
            return f"the constants of the {names[key]}"
        if is_point(key):
            return f"point {index_of(key)}"
        names_of = {number: name for name, number in self._places.items()}
        return f"the landmark {names_of[index_of(key)]}"

    def _between(self, poses: Array, covariances: Array) -> Trajectory:
        """The trajectory at the ticks from all keyframes: ``poses`` (M, 3) and body-frame ``covariances`` (M, 3, 3)."""
        _, *later = self._keyframes
        steps = [self._recalibrated(k.from_previous) for k in later if k.from_previous is not None]
        first = self._keyframes.first
        ticks = [
            replace(tick, keyframe=tick.keyframe - first, since=self._recalibrated(tick.since)) for tick in self._ticks
        ]
        return between_keyframes(ticks, steps, poses, covariances)


def _is_astray(node: Node, values: Values) -> bool:
    factor = node.factor
    if not isinstance(factor, ReprojectionFactor) or not factor.free or any(key not in values for key in node.keys):
        return False
    return factor.is_astray(values[node.keys[0]], values[node.keys[-1]])


def _point(node: Node) -> int | None:
    """The unknown point that a node is a sighting of."""
    free = isinstance(node.factor, ReprojectionFactor) and node.factor.free
    return node.keys[-1] if free else None
