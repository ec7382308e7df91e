"""The data of a factor graph: keyframes, other variables, and factors. Also the interface of mappers, which add points
to a graph."""

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
NOTHING_KNOWN = np.zeros(0)  # the empty array of the odometry's estimated constants, if none are estimated


@dataclass(frozen=True)
class Node:
    """A factor of the graph. ``keys``: the keys of its variables. ``factor``: the factor, with ``rows`` residuals.
    ``native``: an equivalent factor of GTSAM, used instead if it is given. One of ``factor`` and ``native`` may be
    None. ``sensor``: the name of the sensor."""

    keys: tuple[int, ...]
    factor: Factor | None = None
    rows: int = 0
    native: gtsam.NonlinearFactor | None = None
    sensor: str = ""


Guess = tuple[Array, Array]  # a pose (3,) and its body-frame covariance (3, 3)


@dataclass
class Keyframe:
    """A pose variable of the graph. ``index``, ``key``: its index among the keyframes and its key in the graph. ``t``
    [s]: its time. ``odometry``: the integrated odometry at ``t``. ``from_previous``: the motion since the previous
    keyframe. ``factor``: the factor of this motion, None until it is needed. ``is_elsewhere``: True if the robot was
    carried since the previous keyframe. ``nodes``: the factors of measurements. ``causal``: the estimate while this
    keyframe was the newest. ``final``: the estimate when this keyframe left the window."""

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
    """A time ``t`` [s] at which the trajectory needs a pose. ``keyframe``: the index of the last keyframe at or before
    ``t``. ``odometry``: the integrated odometry at ``t``."""

    t: float
    keyframe: int
    odometry: ChainState


@dataclass
class Addition:
    """New factors (``nodes``) and new variables for a graph. ``values``: the variables' initial values, by key."""

    nodes: list[Node] = field(default_factory=list)
    values: Values = field(default_factory=dict)

    def hang(self, keyframe: Keyframe, *nodes: Node) -> None:
        """Add the factors ``nodes`` to this object, and to the factors of ``keyframe``."""
        keyframe.nodes += nodes
        self.nodes += nodes


# Squared Mahalanobis distance of a solved pose from its prediction above which the solver is assumed to diverge.
JUMPED = 50.0


def jumps(guess: Guess, pose: Array) -> bool:
    """Return True if ``pose`` (3,) is far outside of the Gaussian ``guess`` (predicted pose and covariance)."""
    return not positive.squared(se2.log(se2.between(guess[0], pose)), guess[1]) < JUMPED


class Mapper:
    """Adds observed points that the map lacks to the graph, as variables. This base class adds nothing. ``sensor``: the
    name of the sensor, "" for none. ``fewest``: the minimum number of observations of a point in the graph.
    ``horizon``: how many of the last keyframes the mapper needs. ``rejected``: the message for rejected observations.
    ``estimates``: True if points become variables. ``knows_scale``: False if only odometry determines the scale of the
    points."""

    sensor: str = ""
    fewest: int = 0
    horizon: int = 0
    rejected: str = ""
    estimates: bool = False
    knows_scale: bool = True

    def is_due(self, m: Any) -> bool:
        """Return True if a new keyframe is needed at the time of the measurement ``m``."""
        return False

    def take(self, m: Any, keyframe: Keyframe, guess: Guess, graph: Graph, addition: Addition) -> Guess:
        """Process the measurement ``m`` at the newest ``keyframe``, and add its factors and points to ``addition``.
        ``guess``: pose and covariance of the keyframe. Returns pose and covariance, corrected by the measurement."""
        return guess

    def is_astray(self, node: Node, values: Values) -> bool:
        """Return True if ``node`` is the observation of a point, and certainly a false match given the estimates
        ``values``."""
        return False

    def point(self, node: Node) -> int | None:
        """Return the key of the observed point if ``node`` is an observation of a point, otherwise None."""
        return None

    def leave(self, t: float) -> Sequence[int]:
        """Remove the points that were last observed before ``t`` [s] from the graph, and return their keys."""
        return ()

    def keep_only(self, keys: set[int]) -> None:
        """Discard all points except the points with the keys ``keys``."""

    def forget(self, first: Keyframe) -> Sequence[int]:
        """Delete the data of keyframes before ``first``. Also delete the points that were removed from the graph and
        are not observed from ``first`` on, and return their keys."""
        return ()

    def learnt(self, values: Mapping[int, Array], covariances: Mapping[int, Array]) -> PointMap | None:
        """Return a map of all points that were ever in the graph and are not deleted, None if there are none.
        ``values``, ``covariances``: the estimates and covariances of points and keyframes by key."""
        return None


class Graph:
    """A factor graph of a run. ``keyframes``: by index. ``values``, ``covariances``: of all other variables, by key.
    ``newest``: the last keyframe, with the current estimate ``pose`` (3,) and body-frame ``covariance`` (3, 3).
    ``keys``: the keys of constants and landmarks by name. ``departed``: estimates and covariances of points that were
    removed from the graph. ``t`` [s]: the newest time. The solver sets two functions. ``current(key)`` returns the
    current estimate of a variable. ``is_open(index)`` is True if a keyframe may still get factors."""

    newest: Keyframe
    current: Callable[[int], Array]
    is_open: Callable[[int], bool]

    def __init__(self, motion: Motion, sensors: Mapping[str, Sensor], mapper: Mapper, diagnostics: Diagnostics) -> None:
        self.motion, self.sensors, self.mapper, self.diagnostics = motion, sensors, mapper, diagnostics
        self.constants = constants_of(motion, sensors)
        self.keys = {n: constants_key(i) for i, (n, c) in enumerate(self.constants.items()) if c.names}
        self.values, self.covariances = self.constant_priors()
        self.departed: tuple[Values, Values] = {}, {}
        self.keyframes: dict[int, Keyframe] = {}  # by consecutive numbers
        self.ticks: list[TickAt] = []
        self.changes: tuple[Change, ...] = ()  # the intervals when the robot was carried
        self.is_anchored = False  # False while odometry from before the first keyframe may still arrive
        self._damping = 0.0  # the largest damping that was needed so far to compute covariances
        self.t = -math.inf
        self.prior: PosePrior | None = None
        self.pose, self.covariance = np.full(3, np.nan), np.full((3, 3), np.nan)

    def begin(self, prior: PosePrior) -> Keyframe:
        """Start from a Gaussian prior of the pose. Returns the first keyframe."""
        self.prior, self.t = prior, prior.t
        self.pose = np.array(prior.pose, dtype=float)
        self.covariance = se2.world_to_body(prior.pose, prior.covariance)
        self.keyframes, self.is_anchored = {}, False
        self.append(Keyframe(0, prior.t, self.motion.state(prior.t), None))
        return self.newest

    def copy(self) -> Graph:
        """Return a copy of the graph with its own values, lists of factors and diagnostics, to solve it separately."""
        graph = object.__new__(Graph)
        vars(graph).update(vars(self))
        graph.diagnostics = self.diagnostics.copy()
        graph.keyframes = {i: replace(k, nodes=list(k.nodes)) for i, k in self.keyframes.items()}
        graph.newest = graph.keyframes[self.newest.index]
        graph.values, graph.covariances = dict(self.values), dict(self.covariances)
        return graph

    def anchor(self) -> None:
        """Store the integrated odometry at the first keyframe. Call this at the first measurement after a start, when
        all odometry from before the start has arrived."""
        self.newest.odometry, self.is_anchored = self.motion.state(self.newest.t), True

    def append(self, keyframe: Keyframe) -> None:
        """Add a keyframe as the newest one."""
        self.keyframes[keyframe.index] = self.newest = keyframe

    def cut(self, first: int, t: float) -> None:
        """Remove the keyframes from index ``first`` on. The trajectory ends there or, if earlier, at ``t`` [s]."""
        for index in range(first, self.newest.index + 1):
            del self.keyframes[index]
        self.newest = self.keyframes[first - 1]
        self.ticks = [tick for tick in self.ticks if tick.keyframe < first and tick.t < t]

    def forget(self, first: int) -> None:
        """Delete the keyframes with an index below ``first``, the trajectory before ``first``, and points not observed
        since."""
        for index in range(next(iter(self.keyframes)), first):
            del self.keyframes[index]
        self.ticks = [tick for tick in self.ticks if tick.keyframe >= first]
        for key in self.mapper.forget(next(iter(self.keyframes.values()))):
            for departed in self.departed:
                departed.pop(key, None)

    def keyframe_before(self, t: float) -> Keyframe:
        """Return the last keyframe at or before the time ``t`` [s], or the oldest keyframe if all are later."""
        keyframe = self.newest
        while keyframe.t > t and keyframe.index - 1 in self.keyframes:
            keyframe = self.keyframes[keyframe.index - 1]
        return keyframe

    def since(self, keyframe: Keyframe, t: float) -> Increment:
        """Return the motion from a keyframe to time ``t`` [s] by odometry, with the odometry's estimated constants
        applied."""
        start = keyframe.odometry if self.is_anchored else self.motion.state(keyframe.t)
        return self.recalibrated(self.motion.relative(start, self.motion.state(t)))

    def part_of_step(self, keyframe: Keyframe, t: float) -> Increment:
        """Return the motion from ``keyframe`` to the time ``t`` [s], which must lie between this keyframe and the next
        one. It is interpolated along the arc between them in proportion to time."""
        following = self.keyframes[keyframe.index + 1]
        assert following.from_previous is not None
        step, share = self.recalibrated(following.from_previous), (t - keyframe.t) / (following.t - keyframe.t)
        delta = se2.exp(share * se2.log(step.delta))
        return Increment(delta, share * step.covariance, share * step.duration, share * step.still)

    def moved(self, t: float) -> tuple[Array, Array, Array]:
        """Return the newest pose (3,), predicted by odometry to ``t`` [s] if ``t`` is later. Also returns the pose's
        covariance (3, 3) in the body frame, then in the world frame."""
        if t <= self.newest.t:
            return self.pose, self.covariance, se2.body_to_world_one(self.pose, self.covariance)
        _, poses, bodies, worlds = self.all_moved((t,))
        return poses[0], bodies[0], worlds[0]

    def all_moved(self, times: Sequence[float]) -> tuple[Array, Array, Array, Array]:
        """Predict the newest pose by odometry to each of K later ``times`` [s]. Returns the odometry states (K, 8) and
        the poses (K, 3). Also returns the poses' covariances (K, 3, 3) in the body frame and in the world frame."""
        start = self.newest.odometry if self.is_anchored else self.motion.state(self.newest.t)
        return self.motion.moved(start, times, self.pose, self.covariance, self.value(MOTION, NOTHING_KNOWN))

    def between(self, first: Keyframe, last: Keyframe) -> Increment:
        """Return the motion between two keyframes by odometry, with the odometry's estimated constants applied."""
        return self.recalibrated(self.motion.relative(first.odometry, last.odometry))

    @property
    def mapped_constants(self) -> int | None:
        """The key of the estimated constants of the sensor that observes unknown points, or None if there are none."""
        return self.keys.get(self.mapper.sensor)

    def recalibrated(self, increment: Increment) -> Increment:
        """Return an odometry increment, corrected with the estimated constants of the odometry."""
        key = self.keys.get(MOTION)
        return increment if key is None else self.motion.recalibrated(increment, self.values[key])

    def value(self, name: str, default: Array | None = None) -> Array:
        """Return the estimate of the sensor constants or of the landmark ``name``. If the graph does not contain them,
        returns ``default``, or raises KeyError if ``default`` is None."""
        if default is not None and name not in self.keys:
            return default
        return self.values[self.keys[name]]

    def constant_priors(self) -> tuple[Values, Values]:
        """Return the prior means and covariances of the estimated sensor constants, by key."""
        sigmas = {self.keys[name]: c.sigmas for name, c in self.constants.items() if c.names}
        return {key: np.zeros(len(s)) for key, s in sigmas.items()}, {key: np.diag(s**2) for key, s in sigmas.items()}

    def new_block(self, new: NewVariable, covariance: Array) -> int:
        """Add the landmark or bias ``new`` as a variable, and return its key. ``covariance`` (3, 3): the body-frame
        covariance of the pose that observed it."""
        is_position = len(new.mean) > 1
        numbers = [index_of(key) for key in self.keys.values() if is_landmark(key) is is_position]
        first = 0 if is_position else len(self.constants)
        number = max((1 + number for number in numbers), default=0)
        key = self.keys[new.name] = (landmark_key if is_position else constants_key)(max(first, number))
        self.values[key], (_, self.covariances[key]) = new.mean, new.joint(covariance, {})
        return key

    def node(self, keyframe: Keyframe, term: Term, sensor: str) -> Node:
        """Return the factor ``term`` of an observation at ``keyframe`` as a node of the graph. ``sensor``: the sensor's
        name."""
        keys = (keyframe.key, *map(self.keys.__getitem__, term.blocks))
        return Node(keys, term.factor, term.rows, sensor=sensor)

    def odometry_factor(self, keyframe: Keyframe) -> tuple[Factor, tuple[int, ...]]:
        """Return the odometry factor from the previous keyframe to this one, and the keys of its variables. If the
        robot was carried in between, the factor does not depend on the odometry's constants."""
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
        """Remove observations in ``keyframes`` that do not fit the estimate of their point in ``values``. Also removes
        points with too few remaining observations. Returns True if any was removed."""
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
        """Remove points with too few remaining observations. Call this after keyframes were removed."""
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
            del self.values[key]  # the tilt of a removed keyframe

    def forget_landmarks(self, known: Collection[int]) -> None:
        """Remove landmarks and biases that no remaining keyframe observes. ``known``: keys of variables that are not
        removed, because marginalised keyframes observed them."""
        observed = {key for k in self.keyframes.values() for node in k.nodes for key in node.keys}
        for name, key in list(self.keys.items()):
            if name not in self.constants and key not in observed and key not in known:
                del self.keys[name], self.values[key], self.covariances[key]

    def report_damping(self, damping: float) -> None:
        """Add an event to the diagnostics if ``damping``, which was needed to compute covariances, is the largest so
        far."""
        if damping > self._damping:
            self._damping = damping
            self.diagnostics.event(self.t, "damped", DAMPED, damping=damping)

    def unsolved(self, error: Exception) -> RunFailedError:
        """Return an error with the message that the graph cannot be solved, and why. ``error``: the solver's
        exception."""
        return RunFailedError(f"the graph cannot be solved at {self.t:.3f} s: {self.reason(error)}")

    def reason(self, error: Exception) -> str:
        """Return one line that describes ``error``, an exception of this solver or of GTSAM."""
        key = blamed(error)
        if key is None:
            lines = str(error).strip().splitlines()
            return lines[0] if lines else "no step leads to a better solution"
        return f"the measurements do not determine {self._named(key)}"

    def _named(self, key: int) -> str:
        """Return a text that describes the variable ``key``, for messages."""
        if is_of_keyframe(key):
            return f"the {'pose' if is_pose(key) else 'tilt'} at {self.keyframes[index_of(key)].t:.3f} s"
        if is_point(key):
            return f"point {index_of(key)}"
        name = {number: name for name, number in self.keys.items()}[key]
        return f"the landmark {name.partition('/')[2]}" if is_landmark(key) else f"the constants of the {name}"
