"""Poses in a bag: odometry, and the reference for scoring."""

from collections.abc import Callable
from operator import attrgetter
from typing import Any

import numpy as np

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files import checks
from factorgraph_loc.io.bags.fields import Clock
from factorgraph_loc.io.bags.file import Bag, Stamped, TopicRows
from factorgraph_loc.model.log import StartPose
from factorgraph_loc.model.planar import AS_IT_IS, Turned, on_floor, require_unit, rotations_of
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.trajectory3 import PosePath
from factors.se2 import Array, Integers

POINT = "geometry_msgs/msg/PointStamped"
WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
POSES: dict[str, Callable[[Any], Any]] = {
    "nav_msgs/msg/Odometry": attrgetter("pose.pose"),
    "geometry_msgs/msg/PoseStamped": attrgetter("pose"),
    WITH_COVARIANCE: attrgetter("pose.pose"),
    "geometry_msgs/msg/TransformStamped": attrgetter("transform"),
}


class ReferenceTopic(Turned):
    """A topic of poses, or of tf with two frames."""

    topic: str
    """name of the topic"""
    parent: str | None = None
    """frame of the world, for tf"""
    child: str | None = None
    """frame of the robot, for tf"""
    has_heading: bool = True
    """whether the heading means anything"""
    clock: Clock | None = None
    """timestamps of message headers or of receipt; by default as for the bag"""


class StartTopic(Turned):
    """A topic whose first pose with covariance is the known start."""

    topic: str
    """name of the topic"""
    clock: Clock | None = None
    """timestamps of message headers or of receipt; by default as for the bag"""


class Poses:
    """Collects the poses of a topic; points are poses without heading."""

    def __init__(self, bag: Bag, name: str, turned: Turned = AS_IT_IS) -> None:
        topic = bag.topic(name)
        self._turned = turned
        self._are_points = topic.type == POINT
        if topic.type not in POSES and not self._are_points:
            known = ", ".join(sorted({*POSES, POINT}))
            raise InputError(f"{bag.path}: topic {name} is of type {topic.type}, expected one of {known}")
        self._pose = POSES.get(topic.type, attrgetter("point"))
        # transforms have translation and rotation, poses position and orientation
        self._parts = (
            ("translation", "rotation") if topic.type.endswith("TransformStamped") else ("position", "orientation")
        )
        self.rows = TopicRows(f"{bag.path} {name}", 7)

    def add(self, item: Stamped, t_ns: int) -> None:
        pose = self._pose(item.message)
        if self._are_points:
            self.rows.append(item, t_ns, (pose.x, pose.y, pose.z, 0.0, 0.0, 0.0, 1.0))
        else:
            self.rows.append(item, t_ns, seven(pose, *self._parts))

    def in_order(self, warnings: list[str]) -> tuple[Integers, Array]:
        """Timestamps (N,) and planar poses (N, 3), the last one of equal timestamps; InputError names the invalid message."""
        places = self._checked()[:, :3]
        turns = None if self._are_points else self._rotations()
        poses = on_floor(self.rows.source, places, turns, warnings, self._turned)
        keep = self._kept(warnings)
        return self.rows.t_ns[keep], poses[keep]

    def in_space(self, warnings: list[str]) -> PosePath:
        """The poses as they are; InputError names the invalid message."""
        places = self._checked()[:, :3]
        path = PosePath(self.rows.source, places, self._rotations(), self.rows.t_ns, not self._are_points)
        return path.rows(self._kept(warnings))

    def _checked(self) -> Array:
        values = self.rows.values
        check_rotations(self.rows.source, self.rows.rows, values)
        return values

    def _rotations(self) -> Array:
        return rotations_of(self.rows.source, self.rows.rows, self.rows.values[:, 3:])

    def _kept(self, warnings: list[str]) -> Integers:
        return checks.in_order(self.rows.source, self.rows.rows, self.rows.t_ns, warnings)

    def trajectory(self, t0_ns: int, has_heading: bool, warnings: list[str]) -> Trajectory:
        t_ns, poses = self.in_order(warnings)
        return Trajectory(checks.seconds(t_ns, t0_ns), poses, has_heading=has_heading and not self._are_points)


class Start:
    """Collects the first pose with covariance of a topic, the known start."""

    def __init__(self, bag: Bag, name: str, turned: Turned = AS_IT_IS) -> None:
        topic = bag.topic(name)
        self._turned = turned
        if topic.type != WITH_COVARIANCE:
            raise InputError(f"{bag.path}: topic {name} is of type {topic.type}, expected {WITH_COVARIANCE}")
        self._source = f"{bag.path} {name}"
        self._found: tuple[int, Array, Array] | None = None  # timestamp [ns], pose (1, 7), variances (3,)

    def add(self, item: Stamped, t_ns: int) -> None:
        if self._found is None:
            told = item.message.pose
            variances = np.asarray(told.covariance, dtype=float)[[0, 7, 35]]
            self._found = (t_ns, np.array([seven(told.pose)], dtype=float), variances)

    def pose(self, t0_ns: int, warnings: list[str]) -> StartPose:
        """The start; InputError if a variance of x, y or heading is not positive."""
        assert self._found is not None
        t_ns, values, variances = self._found
        first = np.ones(1, dtype=np.int64)
        check_rotations(self._source, first, values)
        turns = rotations_of(self._source, first, values[:, 3:])
        pose = on_floor(self._source, values[:, :3], turns, warnings, self._turned)[0]
        for name, variance in zip(("xx", "yy", "yaw"), variances.tolist(), strict=True):
            if not 0.0 < variance < np.inf:
                raise bad_field(self._source, f"covariance {name}", variance, "more than 0", row=1)
        return StartPose((t_ns - t0_ns) / 1e9, pose, np.sqrt(variances))


def seven(pose: Any, position: str = "position", orientation: str = "orientation") -> tuple[float, ...]:
    """x, y, z [m] and the quaternion x, y, z, w of a pose or transform."""
    p, q = getattr(pose, position), getattr(pose, orientation)
    return p.x, p.y, p.z, q.x, q.y, q.z, q.w


def check_rotations(source: str, rows: Integers, table: Array) -> None:
    """InputError if positions and quaternions (N, 7) are not finite, or a quaternion is not a unit quaternion."""
    for i, name in enumerate(("x", "y", "z", "qx", "qy", "qz", "qw")):
        checks.require_finite(source, rows, name, table[:, i])
    require_unit(source, rows, table[:, 3:])
