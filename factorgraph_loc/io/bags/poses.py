"""Reads poses and coordinate frames (tf) from a bag.

The odometry, the reference and the start are read as poses. Static transforms give the mounting of sensors. A chain of
transforms gives a trajectory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import islice, pairwise
from typing import Any

import numpy as np

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files import checks
from factorgraph_loc.files.models import nearest
from factorgraph_loc.io.bags.file import Bag, Stamped
from factorgraph_loc.io.bags.topics import TF, Listeners, RowTopic, Stamper, TopicRows, TopicSettings, as_nanoseconds
from factorgraph_loc.model.log import StartPose
from factorgraph_loc.model.planar import Turned, are_null, not_unit, null_poses, rotations_of
from factorgraph_loc.model.pose_path import PosePath
from factorgraph_loc.text import Notice, error_text, listed, quoted
from factors.se2 import Array, Integers

SEVEN = ("x", "y", "z", "qx", "qy", "qz", "qw")
POINT = "geometry_msgs/msg/PointStamped"
WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
POSES = {  # path of the pose in a message, by message type
    "nav_msgs/msg/Odometry": "pose.pose",
    "geometry_msgs/msg/PoseStamped": "pose",
    WITH_COVARIANCE: "pose.pose",
    "geometry_msgs/msg/TransformStamped": "transform",
}
STATIC = "/tf_static"
SAMPLE = 2000  # number of messages of a topic that are read to propose a manifest
# common names of frames of the robot, of its odometry and of the world
ROBOT = ("base_link", "base_footprint", "base")
ODOMETRY = ("odom", "odom_combined", "odometry")
WORLD = ("mocap", "vicon", "optitrack", "world", "map")  # frames of measured poses first, then frames of estimates


class PoseTopic(RowTopic, Turned):
    """The settings of a topic of poses, or of tf with the poses of the frame ``child`` in the frame ``parent``."""

    parent: str | None = None
    """reference frame of the poses, if the topic is tf"""
    child: str | None = None
    """frame of the robot, if the topic is tf"""


class ReferenceTopic(PoseTopic):
    """The settings of the topic of the reference trajectory."""

    has_heading: bool = True
    """true if the reference measures the heading; false if its headings are meaningless"""


class StartTopic(TopicSettings, Turned):
    """The settings of a topic whose first message (PoseWithCovarianceStamped) is the known start of the log."""


class Start:
    """Collects the first pose with covariance of a topic. This pose is the known start of the log."""

    def __init__(self, bag: Bag, options: StartTopic) -> None:
        bag.topic(options.topic, WITH_COVARIANCE)
        self._turned = options
        self._source = f"{bag.path} {options.topic}"
        # timestamp [ns]; position [m] and quaternion (1, 7); variances (3,) of x, y [m^2] and heading [rad^2]
        self._found: tuple[int, Array, Array] | None = None

    def add(self, item: Stamped, t_ns: int) -> None:
        if self._found is None:
            stated = item.message.pose
            variances = np.asarray(stated.covariance, dtype=float)[[0, 7, 35]]
            self._found = (t_ns, np.array([numbers_of_pose(stated.pose)], dtype=float), variances)

    def pose(self, t0_ns: int, warnings: list[Notice]) -> StartPose:
        """Return the pose as the known start of a log: x, y, heading and their standard deviations.

        Its time [s] counts from ``t0_ns`` [ns]. If the robot is tilted, a warning is appended to ``warnings``. Raises
        InputError if a variance of x, y or heading is not positive.
        """
        assert self._found is not None
        t_ns, values, variances = self._found
        turns = checked_rotations(self._source, np.ones(1, dtype=np.int64), values)
        pose = PosePath(self._source, values[:, :3], turns, None).on_floor(warnings, self._turned)[0]
        for name, variance in zip(("xx", "yy", "yaw"), variances.tolist(), strict=True):
            if not 0.0 < variance < np.inf:
                raise bad_field(self._source, f"covariance {name}", variance, "more than 0", row=1)
        return StartPose((t_ns - t0_ns) / 1e9, pose, np.sqrt(variances))


def numbers_of_pose(pose: Any, position: str = "position", orientation: str = "orientation") -> tuple[float, ...]:
    """Return x, y, z [m] and the quaternion x, y, z, w of the message ``pose``.

    ``position``, ``orientation``: the names of the fields of the message that have the position and the quaternion.
    """
    p, q = getattr(pose, position), getattr(pose, orientation)
    return p.x, p.y, p.z, q.x, q.y, q.z, q.w


def checked_rotations(source: str, rows: Integers, table: Array) -> Array:
    """Return the rotations (N, 3, 3) of a ``table`` (N, 7) of positions x, y, z and quaternions x, y, z, w.

    Raises InputError if a number is not finite or a quaternion is not a unit quaternion. ``rows`` (N,): row numbers in
    ``source``, which the error names.
    """
    checks.require_finite(source, rows, SEVEN, table)
    return rotations_of(source, rows, table[:, 3:])


def path_of(rows: TopicRows, warnings: list[Notice], *, has_rotations: bool = True) -> PosePath:
    """Return the poses in ``rows``, the rows collected from a topic. Of rows with equal timestamps, the last is used.

    The columns are x, y, z [m], then the quaternion x, y, z, w, and optionally the variances of x and y.
    ``has_rotations``: False if there is no quaternion. A zero quaternion or a huge variance means that the device had
    lost its pose. Such rows are skipped, and a warning is appended to ``warnings``. Raises InputError, with the number
    of the message, at an invalid row.
    """
    source, values = rows.source, rows.values
    if not has_rotations:
        values = np.column_stack((values, np.tile((0.0, 0.0, 0.0, 1.0), (len(values), 1))))
    known = np.flatnonzero(~(null := are_null(values[:, 3:7], values[:, 7:9] if values.shape[1] > 7 else None)))
    if null.any():
        warnings.append(null_poses(source, int(rows.rows[null.argmax()]), int(np.count_nonzero(null))))
    faults = [*checks.not_finite(SEVEN, values[known, :7]), not_unit(values[known, 3:7])]
    keep = rows.kept(faults, warnings, known)
    rotations = rotations_of(source, rows.rows[keep], values[keep, 3:7])
    t_ns = rows.t_ns
    return PosePath(source, values[keep, :3], rotations, t_ns[keep], has_rotations, lost_ns=np.sort(t_ns[null]))


def frame_and_ancestors(parents: Mapping[str, str], frame: str) -> list[str]:
    """Return ``frame``, its parent, the parent of its parent, and so on. ``parents``: the parent of each frame.

    A cycle ends at the first repeated frame."""
    chain = [frame]
    while (parent := parents.get(chain[-1], frame)) not in chain:
        chain.append(parent)
    return chain


class StaticFrames:
    """Collects the static transforms between the coordinate frames of a bag.

    ``base``: the frame of the robot. ``parents``: the parent of each frame. ``poses``: the pose (4, 4) of each frame in its parent.
    """

    def __init__(self, base: str = ROBOT[0]) -> None:
        self.base = base
        self.parents: dict[str, str] = {}
        self.poses: dict[str, Array] = {}

    def add(self, item: Stamped, t_ns: int) -> None:
        for transform in item.message.transforms:
            values = np.array([numbers_of_pose(transform.transform, "translation", "rotation")])
            rotations = checked_rotations(item.topic, np.array([item.row]), values)
            child = plain(transform.child_frame_id)
            self.parents[child] = plain(transform.header.frame_id)
            self.poses[child] = matrices(values[:, :3], rotations)[0]

    def pose(self, frame: str) -> Array | None:
        """Return the pose (4, 4) of ``frame`` in the frame of the robot. Returns None if no transforms connect the two frames."""
        ours, theirs = self._poses_in_ancestors(plain(frame)), self._poses_in_ancestors(plain(self.base))
        common = next((name for name in ours if name in theirs), None)
        return None if common is None else np.linalg.inv(theirs[common]) @ ours[common]

    def known(self, source: str, frame: str) -> Array:
        """Return the pose (4, 4) of ``frame`` in the frame of the robot. ``source``: names the topic in the error.

        Raises InputError if no transforms connect the two frames.
        """
        pose = self.pose(frame)
        if pose is None:
            frames = listed(sorted(self.parents)) or "none"
            raise InputError(f"{source}: tf_static has no pose of {frame} on {self.base}, only the frames: {frames}")
        return pose

    def _poses_in_ancestors(self, frame: str) -> dict[str, Array]:
        """Return the poses (4, 4) of ``frame`` in itself and in its ancestors, by the name of the ancestor."""
        out = {frame: np.eye(4)}
        for child, parent in pairwise(frame_and_ancestors(self.parents, frame)):
            out[parent] = self.poses[child] @ out[child]
        return out


class FrameReference:
    """Collects the transforms of a tf topic, and composes the trajectory of one frame in another.

    ``topic``: the settings. The frame ``topic.child`` moves in the frame ``topic.parent``. Raises InputError if one of
    the two frames is not set.
    """

    def __init__(self, bag: Bag, topic: PoseTopic, stamper: Stamper, static: StaticFrames) -> None:
        self._source = f"{bag.path} {topic.topic}"
        if topic.parent is None or topic.child is None:
            raise InputError(f"{self._source}: parent or child is missing: give two frames, such as map and base_link")
        self._parent, self._child = plain(topic.parent), plain(topic.child)
        self._stamper, self._static, self._rules = stamper, static, topic
        self._edges: dict[str, TopicRows] = {}  # by frame: its poses in its parent, in order of arrival
        self._parents: dict[str, str] = {}

    def add(self, item: Stamped, t_ns: int) -> None:
        for transform in item.message.transforms:
            child, parent = plain(transform.child_frame_id), plain(transform.header.frame_id)
            self._parents[child] = parent
            edge = self._edges.setdefault(child, TopicRows(f"{self._source} {parent} to {child}", 7, rules=self._rules))
            stamp = self._stamper.choose(as_nanoseconds(transform.header.stamp, 1), t_ns)
            edge.append(item, stamp, numbers_of_pose(transform.transform, "translation", "rotation"))

    def path(self, warnings: list[Notice]) -> PosePath:
        """Return the poses of the child frame in the parent frame.

        The chain between them may have several transforms. The poses are at the timestamps of the most frequent
        transform; the others are interpolated. If rows are skipped, warnings are appended to ``warnings``. Raises
        InputError if the transforms have no time in common, or if none of them changes.
        """
        edges = [
            path_of(self._edges[name], warnings) if name in self._edges else self._static.poses[name]
            for name in self._chain()
        ]
        moving = [edge for edge in edges if isinstance(edge, PosePath)]
        if not moving:
            raise InputError(
                f"{self._source}: {self._child} does not move in {self._parent}, expected two frames in relative motion"
            )
        t_ns = max(moving, key=len).stamps()
        t_ns = t_ns[(t_ns >= max(m.stamps()[0] for m in moving)) & (t_ns <= min(m.stamps()[-1] for m in moving))]
        if not len(t_ns):
            raise InputError(f"{self._source}: the transforms from {self._child} to {self._parent} have no common time")
        poses = np.broadcast_to(np.eye(4), (len(t_ns), 4, 4))
        for edge in edges:
            if isinstance(edge, PosePath):
                at = edge.at(t_ns)
                poses = matrices(at.positions, at.rotations) @ poses
            else:
                poses = edge @ poses
        lost_ns = np.unique(np.concatenate([edge.lost_ns for edge in moving]))
        return PosePath(self._source, poses[:, :3, 3], poses[:, :3, :3], t_ns, lost_ns=lost_ns)

    def _chain(self) -> list[str]:
        """Return the frames from the child (included) to the parent (excluded). Raises InputError if they are not connected."""
        parents = self._static.parents | self._parents
        chain = frame_and_ancestors(parents, self._child)
        if self._parent in chain:
            return chain[: chain.index(self._parent)]
        known = sorted({*parents, *parents.values()})
        wrong = next((name for name in (self._parent, self._child) if name not in known), None)
        hint = (
            f"there is no frame {quoted(wrong)}{nearest(wrong, known)}"
            if wrong
            else f"the frames above {self._child} end at {quoted(chain[-1])}"
        )
        raise InputError(f"{self._source}: no transforms connect {self._child} to {self._parent}: {hint}")


def static_frames(listeners: Listeners, base: str) -> StaticFrames:
    """Return a collector of static transforms, registered at ``listeners`` if the bag has any. ``base``: robot frame."""
    bag, frames = listeners.bag, StaticFrames(base)
    if STATIC in bag.topics and bag.topics[STATIC].type in TF and bag.topics[STATIC].count:
        listeners.add(STATIC, frames)
    return frames


def poses_of_topic(
    listeners: Listeners, options: PoseTopic, frames: StaticFrames
) -> Callable[[list[Notice]], PosePath]:
    """Register a collector for a topic of poses, points or tf transforms. Return a function that makes the poses.

    Call the function after the bag is read, with a list; it appends warnings to the list. ``listeners``: the collectors
    of the bag. ``options``: the topic. ``frames``: the static transforms of the bag.
    """
    bag, stamper = listeners.bag, listeners.stamper(options.topic, options.clock)
    kind = bag.topic(options.topic).type
    if kind in TF:
        reference = FrameReference(bag, options, stamper, frames)
        listeners.add(options.topic, reference, stamper)
        return reference.path
    pose = POSES.get(bag.topic(options.topic, *sorted({*POSES, POINT})).type, "point")
    # a transform has the fields translation and rotation, a pose has position and orientation
    position, rotation = ("translation", "rotation") if pose == "transform" else ("position", "orientation")
    paths = [f"{pose}.{position}.{axis}" for axis in "xyz"] + [f"{pose}.{rotation}.{axis}" for axis in "xyzw"]
    if kind == POINT:
        paths = [f"{pose}.{axis}" for axis in "xyz"]
    if pose == "pose.pose":
        paths += [f"pose.covariance[{i}]" for i in (0, 7)]
    rows = TopicRows(f"{bag.path} {options.topic}", len(paths), paths, options)
    listeners.add(options.topic, rows, stamper)
    return partial(path_of, rows, has_rotations=kind != POINT)


def plain(frame: str) -> str:
    """Return the name of a frame without the leading slash that some bags of ROS 1 have."""
    return frame.lstrip("/")


def matrices(positions: Array, rotations: Array) -> Array:
    """Return homogeneous matrices (N, 4, 4) of positions (N, 3) and rotations (N, 3, 3)."""
    out = np.tile(np.eye(4), (len(positions), 1, 1))
    out[:, :3, 3], out[:, :3, :3] = positions, rotations
    return out


@dataclass(frozen=True)
class Tree:
    """The tree of coordinate frames in a bag.

    ``parents``: the parent of each frame. ``topic``: the topic with the moving frames, "" if no frame moves.
    ``moving``: the frames that move in their parents.
    """

    parents: Mapping[str, str]
    topic: str
    moving: frozenset[str]

    def robot(self) -> str | None:
        """Return the frame of the robot, recognised by common names. Returns None if the tree has no such frame."""
        return next((name for name in ROBOT if name in self.parents), None)

    def above(self, frame: str, names: tuple[str, ...]) -> str | None:
        """Return the first of ``names`` that is an ancestor of ``frame`` and not rigidly connected to it, or None."""
        chain = frame_and_ancestors(self.parents, frame)
        first = next((i for i, name in enumerate(chain) if name in self.moving), len(chain))
        return next((name for name in names if name in chain[first + 1 :]), None)


def tree_of(bag: Bag, remarks: list[str]) -> Tree:
    """Return the tree of the frames in a bag, from the first messages of each tf topic.

    A remark about each topic that cannot be read is appended to ``remarks``.
    """
    parents: dict[str, str] = {}
    moving: set[str] = set()
    topic = ""
    for candidate in bag.topics.values():
        if candidate.type not in TF or not candidate.count:
            continue
        edges: dict[str, str] = {}
        try:
            edges.update(_edges(bag, candidate.name))
        except InputError as error:
            remarks.append(str(error))
        except (AttributeError, TypeError, ValueError) as error:
            remarks.append(
                f"{bag.path}: topic {candidate.name}: the definition of its type differs from that of ROS: {error_text(error)}"
            )
        parents |= edges
        if candidate.name != STATIC:
            moving |= edges.keys()
            topic = topic or candidate.name
    return Tree(parents, topic, frozenset(moving))


def _edges(bag: Bag, topic: str) -> Iterator[tuple[str, str]]:
    for item in islice(bag.messages([topic]), SAMPLE):
        transforms: Any = item.message.transforms
        for transform in transforms:
            yield plain(transform.child_frame_id), plain(transform.header.frame_id)
