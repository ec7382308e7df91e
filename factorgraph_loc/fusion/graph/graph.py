"""A graph as data: its keyframes and other variables, the factors on them, and what maps points while it is solved."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import gtsam
import numpy as np

from factorgraph_loc.errors import RunFailedError
from factorgraph_loc.fusion.graph.problem import DAMPED, blamed
from factorgraph_loc.fusion.layout import constants_of
from factorgraph_loc.fusion.tracking import Change
from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.model.belief import PosePrior
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.sensors.base import NewVariable, Sensor, Term
from factorgraph_loc.sensors.motion import MOTION, Motion
from factors import positive, se2
from factors.graph import (
    Factor,
    Values,
    constants_key,
    index_of,
    is_landmark,
    is_of_keyframe,
    is_point,
    is_pose,
    landmark_key,
    pose_key,
)
from factors.motion import ChainState, Increment
from factors.se2 import Array

STATE = len(ChainState._fields)
NOTHING_KNOWN = np.zeros(0)  # values of constants if none are estimated


@dataclass(frozen=True)
class Node:
    """A factor of the graph on the variables ``keys``: one of ours with ``rows`` residuals, GTSAM's own (``native``),
    or both, which are the same. ``sensor``: the name of the sensor that it comes from."""

    keys: tuple[int, ...]
    factor: Factor | None = None
    rows: int = 0
    native: gtsam.NonlinearFactor | None = None
    sensor: str = ""


Guess = tuple[Array, Array]  # a pose (3,) and its body-frame covariance (3, 3)


@dataclass
class Keyframe:
    """A pose variable of the graph: its time, the odometry there, and the factors of what is seen from it.

    ``from_previous``: the motion since the keyframe before, and ``factor``, the factor made of it. ``is_elsewhere``: whether the
    robot was carried there from the keyframe before. ``causal``: the estimate while it was the newest one; ``final``: the estimate
    with which it has left a window.
    """

    index: int
    t: float
    odometry: ChainState
    from_previous: Increment | None
    factor: Factor | None = None
    is_elsewhere: bool = False
    nodes: list[Node] = field(default_factory=list)
    causal: Guess | None = None
    final: Guess | None = None
    key: int = field(init=False)

    def __post_init__(self) -> None:
        self.key = pose_key(self.index)


class TickAt(NamedTuple):
    """A stamp at which the trajectory is wanted, the number of the keyframe before it, and the odometry there."""

    t: float
    keyframe: int
    odometry: ChainState


@dataclass
class Addition:
    """New factors of the graph, and new variables with their guesses."""

    nodes: list[Node] = field(default_factory=list)
    values: Values = field(default_factory=dict)

    def hang(self, keyframe: Keyframe, *nodes: Node) -> None:
        """Add factors, and keep them with a keyframe."""
        keyframe.nodes += nodes
        self.nodes += nodes


# squared Mahalanobis distance of a pose from its guess; Gauss-Newton steps may diverge where points contain little information
JUMPED = 50.0


def jumps(guess: Guess, pose: Array) -> bool:
    """Whether ``pose`` (3,) is where the robot, by the ``guess`` of it, cannot be."""
    return not positive.squared(se2.log(se2.between(guess[0], pose)), guess[1]) < JUMPED


class Mapper:
    """Makes variables of points that a sensor sees and no map has. This base class maps nothing.

    ``sensor``: the name of the one whose measurements it takes, "" for none. ``fewest``: number of sightings that a point of the
    graph needs.
    ``horizon``: number of recent keyframes that it needs. ``rejected``: why sightings of something else are rejected.
    ``estimates``: whether points become variables. ``knows_scale``: whether their scale comes from elsewhere than the motion.
    """

    sensor: str = ""
    fewest: int = 0
    horizon: int = 0
    rejected: str = ""
    estimates: bool = False
    knows_scale: bool = True

    def is_due(self, m: Any) -> bool:
        """Whether a measurement needs a keyframe of its own."""
        return False

    def take(self, m: Any, keyframe: Keyframe, guess: Guess, graph: Graph, addition: Addition) -> Guess:
        """Add the information of a measurement from the newest keyframe to an ``addition``. Returns the corrected guess of its
        pose."""
        return guess

    def is_astray(self, node: Node, values: Values) -> bool:
        """Whether a node is a sighting that cannot be of its point."""
        return False

    def point(self, node: Node) -> int | None:
        """The key of the point that a node is a sighting of."""
        return None

    def leave(self, t: float) -> Sequence[int]:
        """Keys of the points that were last seen before ``t``, which the graph has no more from now on."""
        return ()

    def keep_only(self, keys: set[int]) -> None:
        """Give up all points but those with these ``keys``."""

    def forget(self, first: Keyframe) -> Sequence[int]:
        """Forget the keyframes before the ``first``, and the points that have left the graph and were not seen since.
        Returns the keys of these points."""
        return ()

    def learnt(self, values: Mapping[int, Array], covariances: Mapping[int, Array]) -> PointMap | None:
        """The points that were ever in the graph and are not forgotten; None without any. ``values`` and ``covariances``, by key:
        those of the points and of the poses of keyframes."""
        return None


class Graph:
    """Keyframes by number, and the other variables by key: ``values`` with covariances ``spreads``.

    ``newest``: the last keyframe, whose current estimate is ``pose`` (3,) with body-frame ``covariance`` (3, 3). ``keys``: of
    blocks by name. ``departed``: estimates and covariances of points that have left the graph. ``t``: the newest time. Of its
    backend, ``current(key)``: the newest estimate of a variable; ``is_open(number)``: whether a keyframe may still get factors.
    """

    newest: Keyframe
    current: Callable[[int], Array]
    is_open: Callable[[int], bool]

    def __init__(self, motion: Motion, sensors: Mapping[str, Sensor], mapper: Mapper, diagnostics: Diagnostics) -> None:
        self.motion, self.sensors, self.mapper, self.diagnostics = motion, sensors, mapper, diagnostics
        self.constants = constants_of(motion, sensors)
        self.keys = {n: constants_key(i) for i, (n, c) in enumerate(self.constants.items()) if c.names}
        self.values, self.covariances = self.constant_priors()
        self.departed: tuple[Values, Values] = {}, {}
        self.keyframes: dict[int, Keyframe] = {}  # consecutive numbers
        self.ticks: list[TickAt] = []
        self.changes: tuple[Change, ...] = ()  # when the robot was carried elsewhere
        self.is_anchored = False  # whether the odometry of the first keyframe counts: earlier rows may still come
        self._damping = 0.0  # the largest that covariances were computed with
        self.t = -math.inf
        self.prior: PosePrior | None = None
        self.pose, self.covariance = np.full(3, np.nan), np.full((3, 3), np.nan)

    def begin(self, prior: PosePrior) -> Keyframe:
        """Start from a Gaussian, at a first keyframe."""
        self.prior, self.t = prior, prior.t
        self.pose = np.array(prior.pose, dtype=float)
        self.covariance = se2.world_to_body(prior.pose, prior.covariance)
        self.keyframes, self.is_anchored = {}, False
        self.append(Keyframe(0, prior.t, self.motion.state(prior.t), None))
        return self.newest

    def copy(self) -> Graph:
        """An independent graph with the same content, to be solved separately."""
        graph = object.__new__(Graph)
        vars(graph).update(vars(self))
        graph.diagnostics = self.diagnostics.copy()
        graph.keyframes = {i: replace(k, nodes=list(k.nodes)) for i, k in self.keyframes.items()}
        graph.newest = graph.keyframes[self.newest.index]
        graph.values, graph.covariances = dict(self.values), dict(self.covariances)
        return graph

    def anchor(self) -> None:
        """Take the odometry at the first keyframe from the rows that came by now, at the first measurement after a start."""
        self.newest.odometry, self.is_anchored = self.motion.state(self.newest.t), True

    def append(self, keyframe: Keyframe) -> None:
        """Add a keyframe after all others."""
        self.keyframes[keyframe.index] = self.newest = keyframe

    def cut(self, first: int, t: float) -> None:
        """Remove the keyframes with numbers from ``first`` on, and the ticks after them or at or after ``t``."""
        for index in range(first, self.newest.index + 1):
            del self.keyframes[index]
        self.newest = self.keyframes[first - 1]
        self.ticks = [tick for tick in self.ticks if tick.keyframe < first and tick.t < t]

    def forget(self, first: int) -> None:
        """Forget the keyframes with numbers below ``first``, the ticks after them, and the points that were not seen since."""
        for index in range(next(iter(self.keyframes)), first):
            del self.keyframes[index]
        self.ticks = [tick for tick in self.ticks if tick.keyframe >= first]
        for key in self.mapper.forget(next(iter(self.keyframes.values()))):
            for departed in self.departed:
                departed.pop(key, None)

    def keyframe_before(self, t: float) -> Keyframe:
        """The last keyframe at or before ``t``; the oldest one in the graph if all are later."""
        keyframe = self.newest
        while keyframe.t > t and keyframe.index - 1 in self.keyframes:
            keyframe = self.keyframes[keyframe.index - 1]
        return keyframe

    def since(self, keyframe: Keyframe, t: float) -> Increment:
        """The motion from a keyframe to ``t``, as the constants have it."""
        start = keyframe.odometry if self.is_anchored else self.motion.state(keyframe.t)
        return self.recalibrated(self.motion.relative(start, self.motion.state(t)))

    def part_of_step(self, keyframe: Keyframe, t: float) -> Increment:
        """The motion from a keyframe to ``t``, a time before the next keyframe. It is a share of the step to that keyframe by time,
        along its arc, because the odometry may be forgotten."""
        following = self.keyframes[keyframe.index + 1]
        assert following.from_previous is not None
        step, share = self.recalibrated(following.from_previous), (t - keyframe.t) / (following.t - keyframe.t)
        delta = se2.exp(share * se2.log(step.delta))
        return Increment(delta, share * step.covariance, share * step.duration, share * step.still)

    def moved(self, t: float) -> tuple[Array, Array, Array]:
        """The newest pose (3,), moved along the odometry to ``t`` if that is later, with its covariance (3, 3) in the body frame
        and in the world frame."""
        newest = self.newest
        if t <= newest.t:
            return self.pose, self.covariance, se2.body_to_world_one(self.pose, self.covariance)
        start = newest.odometry if self.is_anchored else self.motion.state(newest.t)
        return self.motion.moved(start, t, self.pose, self.covariance, self.value(MOTION, NOTHING_KNOWN))

    def between(self, first: Keyframe, last: Keyframe) -> Increment:
        """The motion between two keyframes, under the constants of the odometry."""
        return self.recalibrated(self.motion.relative(first.odometry, last.odometry))

    @property
    def mapped_constants(self) -> int | None:
        """The key of the estimated constants of the sensor whose points are mapped, None without any."""
        return self.keys.get(self.mapper.sensor)

    def recalibrated(self, increment: Increment) -> Increment:
        """An increment under the constants of the odometry."""
        key = self.keys.get(MOTION)
        return increment if key is None else self.motion.recalibrated(increment, self.values[key])

    def value(self, name: str, default: Array | None = None) -> Array:
        """The estimate of a block, or ``default`` without an estimate. KeyError if ``default`` is None."""
        if default is not None and name not in self.keys:
            return default
        return self.values[self.keys[name]]

    def constant_priors(self) -> tuple[Values, Values]:
        """Means and covariances of the sensors' constants before any measurement."""
        sigmas = {self.keys[name]: c.sigmas for name, c in self.constants.items() if c.names}
        return {key: np.zeros(len(s)) for key, s in sigmas.items()}, {key: np.diag(s**2) for key, s in sigmas.items()}

    def new_block(self, new: NewVariable, covariance: Array) -> int:
        """A landmark or a bias that becomes a variable, as seen from a pose with body-frame ``covariance`` (3, 3); its key."""
        is_position = len(new.mean) > 1
        numbers = [index_of(key) for key in self.keys.values() if is_landmark(key) is is_position]
        first = 0 if is_position else len(self.constants)
        number = max((1 + number for number in numbers), default=0)
        key = self.keys[new.name] = (landmark_key if is_position else constants_key)(max(first, number))
        self.values[key], (_, self.covariances[key]) = new.mean, new.joint(covariance, {})
        return key

    def node(self, keyframe: Keyframe, term: Term, sensor: str) -> Node:
        """A term of an observation as a factor on a keyframe."""
        keys = (keyframe.key, *map(self.keys.__getitem__, term.blocks))
        return Node(keys, term.factor, term.rows, sensor=sensor)

    def odometry_factor(self, keyframe: Keyframe) -> tuple[Factor, tuple[int, ...]]:
        """The factor from the previous keyframe, and its keys. Constants of the odometry do not apply while a robot is carried."""
        assert keyframe.from_previous is not None
        keys: tuple[int, ...] = (keyframe.key - 1, keyframe.key)
        if MOTION in self.keys and not keyframe.is_elsewhere:
            keys = (*keys, self.keys[MOTION])
        if keyframe.factor is None:
            increment = keyframe.from_previous
            if keyframe.is_elsewhere:
                keyframe.factor = self.motion.exact_factor(increment)
            else:
                keyframe.factor = self.motion.factor(increment, scale_known=self.mapper.knows_scale)
        return keyframe.factor, keys

    def drop_astray(self, keyframes: Collection[Keyframe], values: Values) -> bool:
        """Remove sightings that do not fit the estimate of their point, and points with too few remaining sightings. Returns
        whether any was removed."""
        mapper = self.mapper
        if not mapper.estimates:
            return False
        astray = {id(n) for k in keyframes for n in k.nodes if mapper.is_astray(n, values)}
        if not astray:
            return False
        left = Counter(mapper.point(n) for k in self.keyframes.values() for n in k.nodes if id(n) not in astray)
        for keyframe in keyframes:
            kept = [
                n
                for n in keyframe.nodes
                if id(n) not in astray and (mapper.point(n) is None or left[mapper.point(n)] >= mapper.fewest)
            ]
            if len(kept) < len(keyframe.nodes):
                self.diagnostics.reject(mapper.rejected, len(keyframe.nodes) - len(kept))
                keyframe.nodes[:] = kept
        return True

    def forget_points(self) -> None:
        """Remove points that the remaining keyframes do not determine."""
        keyframes = self.keyframes.values()
        sightings = Counter(key for k in keyframes for node in k.nodes for key in node.keys if is_point(key))
        if self.mapper.estimates:
            kept = {key for key, count in sightings.items() if count >= self.mapper.fewest}
            for k in keyframes:
                k.nodes = [node for node in k.nodes if all(key in kept or not is_point(key) for key in node.keys)]
            for key in [key for key in self.values if is_point(key) and key not in kept]:
                del self.values[key], self.covariances[key]
            self.mapper.keep_only(kept)
        for key in [k for k in self.values if is_of_keyframe(k) and index_of(k) >= self.newest.index]:
            del self.values[key]  # the tilt of a keyframe that was taken back

    def forget_landmarks(self, known: Collection[int]) -> None:
        """Remove landmarks and biases that no remaining keyframe observes and no summary contains. ``known``: variables of the
        summary of marginalised keyframes."""
        observed = {key for k in self.keyframes.values() for node in k.nodes for key in node.keys}
        for name, key in list(self.keys.items()):
            if name not in self.constants and key not in observed and key not in known:
                del self.keys[name], self.values[key], self.covariances[key]

    def report_damping(self, damping: float) -> None:
        """Note as an event that covariances needed a larger damping than before."""
        if damping > self._damping:
            self._damping = damping
            self.diagnostics.event(self.t, "damped", DAMPED, damping=damping)

    def unsolved(self, error: Exception) -> RunFailedError:
        """The error of a graph that cannot be solved, with the time and the variable that is to blame."""
        return RunFailedError(f"the graph cannot be solved at {self.t:.3f} s: {self.reason(error)}")

    def reason(self, error: Exception) -> str:
        """An error of the solver, or of GTSAM's, in one line."""
        key = blamed(error)
        if key is None:
            lines = str(error).strip().splitlines()
            return lines[0] if lines else "no step leads to a better solution"
        return f"the measurements do not determine {self._named(key)}"

    def _named(self, key: int) -> str:
        """A variable in words."""
        if is_of_keyframe(key):
            return f"the {'pose' if is_pose(key) else 'tilt'} at {self.keyframes[index_of(key)].t:.3f} s"
        if is_point(key):
            return f"point {index_of(key)}"
        name = {number: name for name, number in self.keys.items()}[key]
        return f"the landmark {name.partition('/')[2]}" if is_landmark(key) else f"the constants of the {name}"
