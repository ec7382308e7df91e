"""A graph as data: its keyframes and other variables, the factors on them, the whole as one problem, and the trajectory between."""

from __future__ import annotations

import bisect
import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from factorgraph_loc.errors import RunFailedError
from factorgraph_loc.fusion.changes import Change, is_known
from factorgraph_loc.fusion.graph.graph_parts import Keyframe, TickAt
from factorgraph_loc.fusion.graph.kept import Kept
from factorgraph_loc.fusion.graph.marginals import IndeterminateError, blamed, damped
from factorgraph_loc.fusion.graph.problem import Problem
from factorgraph_loc.fusion.graph.variables import (
    Node,
    Values,
    constants_key,
    gather,
    index_of,
    is_landmark,
    is_of_keyframe,
    is_point,
    is_pose,
    landmark_key,
    pose_key,
)
from factorgraph_loc.fusion.layout import MOTION
from factorgraph_loc.fusion.mapping import Mapper
from factorgraph_loc.model.belief import Learnt, PosePrior, learnt_landmarks
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.settings import Estimated
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.base import NewVariable, Sensor, Term
from factorgraph_loc.sensors.motion import Motion
from factors import se2, se2_kernels
from factors.between import between
from factors.graph import Factor, PriorFactor, VectorPriorFactor
from factors.motion import ChainState, Increment
from factors.se2 import Array

STATE = len(ChainState._fields)
NOTHING_KNOWN = np.zeros(0)  # of constants, where none are estimated


class Graph:
    """Keyframes, and the other variables by key: ``values`` with covariances ``spreads``. ``pose`` (3,) with body-frame
    ``covariance`` (3, 3): of the newest keyframe.

    ``keys``: of blocks by name; ``departed``: estimates and covariances of points that have left the graph; ``t``: the newest time.
    """

    def __init__(
        self, motion: Motion, sensors: Mapping[str, Sensor], mappers: Sequence[Mapper], diagnostics: Diagnostics
    ) -> None:
        self.motion, self.sensors, self.mappers, self.diagnostics = motion, sensors, mappers, diagnostics
        self._constants: dict[str, Estimated] = {MOTION: motion.constants}
        self._constants |= {name: sensor.constants for name, sensor in sensors.items()}
        self.keys = {n: constants_key(i) for i, (n, c) in enumerate(self._constants.items()) if c.names}
        self.values, self.spreads = self.constant_priors()
        self.departed: tuple[Values, Values] = {}, {}
        self.keyframes: Kept[Keyframe] = Kept()
        self.times: Kept[float] = Kept()
        self.ticks: list[TickAt] = []
        self.changes: tuple[Change, ...] = ()  # when the robot was carried elsewhere
        self._anchored = False  # whether the odometry of the first keyframe counts: rows of before it may still come
        self._damping = 0.0  # the largest that covariances were computed with
        self.t = -math.inf
        self.prior: PosePrior | None = None
        self.pose, self.covariance = np.full(3, np.nan), np.full((3, 3), np.nan)

    def begin(self, prior: PosePrior) -> Keyframe:
        """Start from a Gaussian, at a first keyframe."""
        self.prior, self.t = prior, prior.t
        self.pose = np.array(prior.pose, dtype=float)
        self.covariance = se2.world_to_body(prior.pose, prior.covariance)
        first = Keyframe(0, prior.t, self.motion.state(prior.t), None)
        self.keyframes, self.times, self._anchored = Kept([first]), Kept([prior.t]), False
        return first

    def copy(self) -> Graph:
        """One of its own with the same content, to be solved beside this one."""
        graph = object.__new__(Graph)
        vars(graph).update(vars(self))
        graph.diagnostics, graph.keyframes = self.diagnostics.copy(), self.keyframes.copy()
        for place, keyframe in enumerate(self.keyframes, start=self.keyframes.first):
            graph.keyframes[place] = replace(keyframe, nodes=list(keyframe.nodes))
        graph.values, graph.spreads = dict(self.values), dict(self.spreads)
        return graph

    def anchor(self) -> None:
        """At the first measurement after a start: the odometry there is what has come by now."""
        if not self._anchored:
            first = self.keyframes[-1]
            first.odometry, self._anchored = self.motion.state(first.t), True

    @property
    def newest(self) -> Keyframe:
        """The newest keyframe."""
        return self.keyframes.last

    def append(self, keyframe: Keyframe) -> None:
        """Add a keyframe after all others."""
        self.keyframes.append(keyframe)
        self.times.append(keyframe.t)

    def before(self, t: float) -> Keyframe:
        """The last keyframe at or before ``t``."""
        if self.newest.t <= t:
            return self.newest
        return self.keyframes[bisect.bisect_right(self.times, t, self.times.first) - 1]

    def since(self, keyframe: Keyframe, t: float) -> Increment:
        """The motion from a keyframe to ``t``, as the constants have it."""
        start = keyframe.odometry if self._anchored else self.motion.state(keyframe.t)
        return self.recalibrated(self.motion.relative(start, self.motion.state(t)))

    def part_of_step(self, keyframe: Keyframe, t: float) -> Increment:
        """The motion from a keyframe to ``t``, before the next one, of which the odometry may be forgotten: the part of the step to
        that by time, along its arc."""
        after = self.keyframes[keyframe.index + 1]
        assert after.from_previous is not None
        step, share = self.recalibrated(after.from_previous), (t - keyframe.t) / (after.t - keyframe.t)
        delta = se2.exp(share * se2.log(step.delta))
        return Increment(delta, share * step.covariance, share * step.duration, share * step.still)

    def moved(self, t: float) -> tuple[Array, Array, Array]:
        """The newest pose (3,), moved along the odometry to ``t`` if that is later, with its covariance (3, 3) in the body frame
        and in the world frame."""
        newest = self.newest
        if t <= newest.t:
            return self.pose, self.covariance, se2_kernels.body_to_world(self.pose, self.covariance)
        start = newest.odometry if self._anchored else self.motion.state(newest.t)
        return self.motion.moved(start, t, self.pose, self.covariance, self.value(MOTION, NOTHING_KNOWN))

    def recalibrated(self, increment: Increment) -> Increment:
        """An increment under the constants of the odometry."""
        key = self.keys.get(MOTION)
        return increment if key is None else self.motion.recalibrated(increment, self.values[key])

    def value(self, name: str, default: Array | None = None) -> Array:
        """The estimate of a block, ``default`` where there is none; KeyError where that is None."""
        if default is not None and name not in self.keys:
            return default
        return self.values[self.keys[name]]

    def constant_priors(self) -> tuple[Values, Values]:
        """Means and covariances of the sensors' constants before any measurement."""
        held = [(self.keys[name], c) for name, c in self._constants.items() if c.names]
        return {key: np.zeros(len(c.names)) for key, c in held}, {key: np.diag(c.sigmas**2) for key, c in held}

    def new_block(self, new: NewVariable, covariance: Array) -> int:
        """A landmark that becomes a variable, as seen from a pose with this body-frame ``covariance`` (3, 3); its key."""
        numbers = [index_of(key) for key in self.keys.values() if is_landmark(key)]
        key = self.keys[new.name] = landmark_key(1 + max(numbers, default=-1))
        self.values[key], (_, self.spreads[key]) = new.mean, new.joint(covariance, {})
        return key

    def node(self, keyframe: Keyframe, term: Term, sensor: str) -> Node:
        """A term of an observation as a factor on a keyframe."""
        keys = (keyframe.key, *(self.keys[name] for name in term.blocks))
        return Node(keys, term.factor, term.rows, sensor=sensor)

    def odometry_factor(self, keyframe: Keyframe) -> tuple[Factor, tuple[int, ...]]:
        """The factor from the keyframe before, and its keys. The constants of the odometry do not tell how a robot is carried."""
        assert keyframe.from_previous is not None
        keys: tuple[int, ...] = (pose_key(keyframe.index - 1), keyframe.key)
        if MOTION in self.keys and not keyframe.is_elsewhere:
            keys = (*keys, self.keys[MOTION])
        if keyframe.factor is None:
            increment = keyframe.from_previous
            if keyframe.is_elsewhere:
                keyframe.factor = self.motion.exact_factor(increment)
            else:
                scale_known = all(mapper.knows_scale for mapper in self.mappers)
                keyframe.factor = self.motion.factor(increment, scale_known=scale_known)
        return keyframe.factor, keys

    def learnt(self, poses: Iterable[Array] = (), covariances: Iterable[Array] = ()) -> Learnt:
        """The constants and landmarks that are estimated; points at final ``poses`` of all keyframes, with their body-frame
        ``covariances``."""
        values: dict[str, tuple[float, float]] = {}
        blocks = [(name, self.values[key], self.spreads[key]) for name, key in self.keys.items() if is_landmark(key)]
        landmarks = learnt_landmarks(blocks)
        for name, key in self.keys.items():
            if is_landmark(key):
                continue
            prefix = "" if name == MOTION else f"{name}."
            sigmas = np.sqrt(np.diag(self.spreads[key]))
            for label, value, sigma in zip(self._constants[name].names, self.values[key], sigmas, strict=True):
                values[prefix + label] = (float(value), float(sigma))
        at, spreads = ({k.key: v for k, v in zip(self.keyframes, part)} for part in (poses, covariances))  # noqa: B905
        for mapper in self.mappers:
            found = mapper.learnt(self.departed[0] | self.values | at, self.departed[1] | self.spreads | spreads)
            if found is not None:
                return Learnt(values, landmarks, found)
        return Learnt(values, landmarks)

    def convex_width(self, values: Values) -> float:
        """How many times as wide the losses of links must be for all of them to be convex at ``values``, at least 1."""
        linked = {name: sensor for name, sensor in self.sensors.items() if sensor.links}
        nodes = (node for k in self.keyframes for node in k.nodes if linked and node.sensor in linked)
        return max(
            (linked[n.sensor].convex_width(n.factor, gather(values, n.keys)) for n in nodes if n.factor is not None),
            default=1.0,
        )

    def problem(self, width: float = 1.0, link_width: float = 1.0) -> Problem:
        """All that is known as one problem; the robust losses ``width`` times as wide as they are, and those of links
        ``link_width`` times."""
        assert self.prior is not None
        body = se2.world_to_body(self.prior.pose, self.prior.covariance)
        factors: list[tuple[Factor, tuple[int, ...]]] = [(PriorFactor(self.prior.pose, body), (pose_key(0),))]
        means, spreads = self.constant_priors()
        factors += [(VectorPriorFactor(means[key], np.sqrt(np.diag(spreads[key]))), (key,)) for key in means]
        factors += [self.odometry_factor(k) for k in self.keyframes[1:]]
        for keyframe in self.keyframes:
            for node in keyframe.nodes:
                assert node.factor is not None
                factor = node.factor
                if node.sensor in self.sensors:
                    sensor = self.sensors[node.sensor]
                    final = sensor.at_end(factor, link_width if sensor.links else width)
                    if final is None:
                        continue
                    factor = final
                factors.append((factor, node.keys))
        return Problem(factors)

    def drop_astray(self, keyframes: Sequence[Keyframe], values: Values) -> bool:
        """Take sightings out of the graph that cannot be of their points, as these are estimated, and points of which too few are
        left. Returns whether there were any."""
        dropped = False
        for mapper in self.mappers:
            astray = {id(n) for k in keyframes for n in k.nodes if mapper.is_astray(n, values)}
            if not astray:
                continue
            dropped = True
            left = Counter(mapper.point(n) for k in self.keyframes for n in k.nodes if id(n) not in astray)
            for keyframe in keyframes:
                kept = [
                    n
                    for n in keyframe.nodes
                    if id(n) not in astray and (mapper.point(n) is None or left[mapper.point(n)] >= mapper.fewest)
                ]
                if len(kept) < len(keyframe.nodes):
                    self.diagnostics.reject(mapper.rejected, len(keyframe.nodes) - len(kept))
                    keyframe.nodes[:] = kept
        return dropped

    def forget_points(self) -> None:
        """Give up the points that the keyframes that are left do not tell."""
        seen = Counter(key for k in self.keyframes for node in k.nodes for key in node.keys if is_point(key))
        for mapper in self.mappers:
            kept = {key for key, count in seen.items() if count >= mapper.fewest}
            for k in self.keyframes:
                k.nodes = [node for node in k.nodes if all(key in kept or not is_point(key) for key in node.keys)]
            for key in [key for key in self.values if is_point(key) and key not in kept]:
                del self.values[key], self.spreads[key]
            mapper.keep_only(kept)
        for key in [k for k in self.values if is_of_keyframe(k) and index_of(k) >= self.newest.index]:
            del self.values[key]  # the tilt of a keyframe that was taken back

    def forget_landmarks(self, known: Collection[int]) -> None:
        """Give up the landmarks that neither the keyframes that are left tell, nor a summary of what has left the graph, whose
        variables are ``known``."""
        told = {key for k in self.keyframes for node in k.nodes for key in node.keys}
        for name, key in list(self.keys.items()):
            if is_landmark(key) and key not in told and key not in known:
                del self.keys[name], self.values[key], self.spreads[key]

    def settle(self, problem: Problem, values: Values) -> Array:
        """Take over a solution of the whole problem: the constants, and the body-frame covariances (M, 3, 3) that are returned."""
        try:
            found = problem.covariances(values, [k for k in values if is_pose(k) or not is_of_keyframe(k)])
        except IndeterminateError as error:
            raise self.unsolved(error) from error
        self.report_damping(found.damping)
        for key in self.values:
            self.values[key] = values[key]
            if not is_of_keyframe(key):
                self.spreads[key] = found.by_key[key]
        return np.array([found.by_key[k.key] for k in self.keyframes])

    def report_damping(self, damping: float) -> None:
        if damping > self._damping:
            self._damping = damping
            self.diagnostics.events.append((self.t, damped(damping)))

    def unsolved(self, error: RuntimeError) -> RunFailedError:
        """What a user is told where the graph cannot be solved: when, and which variable is to blame."""
        return RunFailedError(f"the graph cannot be solved at {self.t:.3f} s: {self.reason(error)}")

    def reason(self, error: RuntimeError) -> str:
        """An error of the solver, or of GTSAM's, in one line."""
        key = blamed(error)
        if key is None:
            lines = str(error).strip().splitlines()
            return lines[0] if lines else "no step leads to a better solution"
        return f"the measurements do not determine {self._named(key)}"

    def _named(self, key: int) -> str:
        """A variable in words."""
        if is_of_keyframe(key):
            return f"the {'pose' if is_pose(key) else 'tilt'} at {self.times[index_of(key)]:.3f} s"
        if is_point(key):
            return f"point {index_of(key)}"
        name = {number: name for name, number in self.keys.items()}[key]
        return f"the landmark {name.partition('/')[2]}" if is_landmark(key) else f"the constants of the {name}"

    def between(self, poses: Array, covariances: Array) -> Trajectory:
        """The trajectory from all keyframes, ``poses`` (M, 3) and body-frame ``covariances`` (M, 3, 3), at the ticks, but for those
        at which nobody knows where the robot was; see :func:`factors.between.between`."""
        newest = {tick.t: tick for tick in self.ticks}
        stamps = np.array(sorted(newest))
        ticks = [newest[t] for t in stamps[is_known(stamps, self.changes)].tolist()]
        keyframes, first = list(self.keyframes), self.keyframes.first
        before = np.array([tick.keyframe - first for tick in ticks], dtype=np.int64)
        ends = np.array([tick.odometry for tick in ticks]).reshape(-1, STATE)
        starts = np.array([k.odometry for k in keyframes]).reshape(-1, STATE)[before]
        deltas, noises = self.motion.relatives(starts, ends, self.value(MOTION, NOTHING_KNOWN))
        steps = [self.recalibrated(k.from_previous) for k in keyframes[1:] if k.from_previous is not None]
        later = (
            np.array([step.delta for step in steps]).reshape(-1, 3),
            np.array([step.covariance for step in steps]).reshape(-1, 3, 3),
            np.array([step.duration for step in steps]),
            np.array([k.is_elsewhere for k in keyframes[1:]], dtype=np.bool_),
        )
        at, spread = between(before, deltas, noises, np.abs(ends[:, 0] - starts[:, 0]), *later, poses, covariances)
        return Trajectory(np.array([tick.t for tick in ticks]), at, se2.body_to_world(at, spread))
