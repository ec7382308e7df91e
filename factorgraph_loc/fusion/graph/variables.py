"""The variables of a graph by GTSAM's keys, its keyframes, and the factors on them.

A variable is a pose (3,), or a vector: roll and pitch (2,) of the robot at a pose, constants of a sensor that are estimated, or the
position of a landmark (2,) or point (3,).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import gtsam
import numpy as np

from factors import positive, se2
from factors.graph import Factor, pose_array
from factors.motion import ChainState, Increment
from factors.se2 import Array

Values = dict[int, Array]
GTSAM_ERRORS = (RuntimeError, IndexError, ValueError)  # all that GTSAM raises

_POSE, _TILT, _POINT, _LANDMARK = ord("x"), ord("t"), ord("p"), ord("l")
_CHARACTER = 56  # bits of a key below its character


def pose_key(index: int) -> int:
    """The key of the pose of keyframe ``index``."""
    return int(gtsam.symbol("x", index))


def tilt_key(index: int) -> int:
    """The key of the tilt of the robot at keyframe ``index``."""
    return int(gtsam.symbol("t", index))


def constants_key(index: int) -> int:
    """The key of the constants of the sensor with number ``index``."""
    return int(gtsam.symbol("c", index))


def landmark_key(index: int) -> int:
    """The key of the landmark that was met as number ``index``."""
    return int(gtsam.symbol("l", index))


def point_key(index: int) -> int:
    """The key of the point in space that was taken in as number ``index``."""
    return int(gtsam.symbol("p", index))


def leaving_key(index: int) -> int:
    """The key of a variable that only serves to leave a window, with number ``index``."""
    return int(gtsam.symbol("q", index))


def is_point(key: int) -> bool:
    """Whether the variable is a point in space."""
    return key >> _CHARACTER == _POINT


def is_landmark(key: int) -> bool:
    """Whether the variable is a landmark."""
    return key >> _CHARACTER == _LANDMARK


def is_pose(key: int) -> bool:
    """Whether the variable is a pose."""
    return key >> _CHARACTER == _POSE


def is_place(key: int) -> bool:
    """Whether the variable begins with x and y in the frame of the world."""
    return key >> _CHARACTER in (_POSE, _POINT, _LANDMARK)


def is_of_keyframe(key: int) -> bool:
    """Whether the variable is a pose or a tilt, which a window loses with its keyframe."""
    return key >> _CHARACTER in (_POSE, _TILT)


def is_constant(key: int) -> bool:
    """Whether the variable is always there: constants, or a landmark."""
    return not is_of_keyframe(key) and not is_point(key)


def index_of(key: int) -> int:
    """The number of a pose, tilt, landmark or point."""
    return key & ((1 << _CHARACTER) - 1)


@dataclass(frozen=True)
class Node:
    """A factor of the graph on the variables ``keys``: one of ours with ``rows`` residuals, GTSAM's own (``native``),
    or both, which are the same. ``sensor``: the name of the sensor that it comes from."""

    keys: tuple[int, ...]
    factor: Factor | None = None
    rows: int = 0
    native: gtsam.NonlinearFactor | None = None
    sensor: str = ""

    @property
    def has_pose(self) -> bool:
        """Whether it is on a pose."""
        return any(is_pose(key) for key in self.keys)


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


def retract(key: int, value: Array, step: Array) -> Array:
    """A variable moved by a step of its tangent space."""
    return se2.moved(value, step) if is_pose(key) else value + step


def frame_motions(values: Values) -> tuple[Array, list[int]]:
    """The steps (n, 3) of the tangent spaces of all variables, one below the other, by which they move with the frame of the world
    in x, in y, and about its origin, and where that of each ends."""
    parts = []
    for key, value in values.items():
        part = np.zeros((len(value), 3))
        if is_place(key):
            part[:2] = (1.0, 0.0, -value[1]), (0.0, 1.0, value[0])
        if is_pose(key):
            c, s = math.cos(value[2]), math.sin(value[2])
            part[:2] = np.array(((c, s), (-s, c))) @ part[:2]
            part[2, 2] = 1.0
        parts.append(part)
    return np.vstack(parts), np.cumsum([len(part) for part in parts]).tolist()


def to_gtsam(values: Values) -> gtsam.Values:
    """The same as GTSAM holds them."""
    out = gtsam.Values()
    for key, value in values.items():
        out.insert(key, gtsam.Pose2(*value) if is_pose(key) else value)
    return out


def read(solver: gtsam.ISAM2 | gtsam.IncrementalFixedLagSmoother, key: int) -> Array:
    """The estimate of a variable."""
    if is_pose(key):
        return pose_array(solver.calculateEstimatePose2(key))
    return np.asarray(solver.calculateEstimateVector(key), dtype=float)


def gather(values: Values, keys: Sequence[int]) -> list[Array]:
    """The values of several variables."""
    return [values[key] for key in keys]
