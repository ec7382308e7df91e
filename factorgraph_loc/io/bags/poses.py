"""Poses in a bag: odometry, and the reference for scoring."""

from collections.abc import Callable
from operator import attrgetter
from typing import Any

import numpy as np

from factorgraph_loc.errors import bad_field
from factorgraph_loc.files import checks
from factorgraph_loc.io.bags.fields import TopicSettings
from factorgraph_loc.io.bags.file import Bag, Stamped, TopicRows
from factorgraph_loc.model.log import StartPose
from factorgraph_loc.model.planar import Turned, require_unit, rotations_of
from factorgraph_loc.model.pose_path import PosePath
from factors.se2 import Array, Integers

POINT = "geometry_msgs/msg/PointStamped"
WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
POSES: dict[str, Callable[[Any], Any]] = {
    "nav_msgs/msg/Odometry": attrgetter("pose.pose"),
    "geometry_msgs/msg/PoseStamped": attrgetter("pose"),
    WITH_COVARIANCE: attrgetter("pose.pose"),
    "geometry_msgs/msg/TransformStamped": attrgetter("transform"),
}


class PoseTopic(TopicSettings, Turned):
    """A topic of poses, or of tf with two frames."""

    parent: str | None = None
    """frame in which the poses are, for tf"""
    child: str | None = None
    """frame of the robot, for tf"""


class ReferenceTopic(PoseTopic):
    """The topic of the reference."""

    has_heading: bool = True
    """whether the heading means anything"""


class StartTopic(TopicSettings, Turned):
    """A topic whose first pose with covariance is the known start."""


class Poses:
    """Collects the poses of a topic; points are poses without heading."""

    def __init__(self, bag: Bag, name: str) -> None:
        topic = bag.topic(name, *sorted({*POSES, POINT}))
        self._are_points = topic.type == POINT
        self._pose = POSES.get(topic.type, attrgetter("point"))
        # transforms have translation and rotation, poses position and orientation
        self._parts = (
            ("translation", "rotation") if topic.type.endswith("TransformStamped") else ("position", "orientation")
        )
        self._rows = TopicRows(f"{bag.path} {name}", 7)

    def add(self, item: Stamped, t_ns: int) -> None:
        pose = self._pose(item.message)
        if self._are_points:
            self._rows.append(item, t_ns, (pose.x, pose.y, pose.z, 0.0, 0.0, 0.0, 1.0))
        else:
            self._rows.append(item, t_ns, seven(pose, *self._parts))

    def path(self, warnings: list[str], t0_ns: int = 0) -> PosePath:
        """The poses, the last one of equal timestamps; InputError names the invalid message."""
        source, rows, t_ns, values = self._rows.source, self._rows.rows, self._rows.t_ns, self._rows.values
        check_rotations(source, rows, values)
        rotations = rotations_of(source, rows, values[:, 3:])
        path = PosePath(source, values[:, :3], rotations, t_ns, not self._are_points)
        return path.rows(checks.in_order(source, rows, t_ns, warnings))


class Start:
    """Collects the first pose with covariance of a topic, the known start."""

    def __init__(self, bag: Bag, options: StartTopic) -> None:
        bag.topic(options.topic, WITH_COVARIANCE)
        self._turned = options
        self._source = f"{bag.path} {options.topic}"
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
        pose = PosePath(self._source, values[:, :3], turns, None).on_floor(warnings, self._turned)[0]
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
    checks.require_finite(source, rows, ("x", "y", "z", "qx", "qy", "qz", "qw"), table)
    require_unit(source, rows, table[:, 3:])
