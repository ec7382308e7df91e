"""Reads trajectories from files of poses, topics of bags, results of runs, or references of logs, and writes trajectories.

Also converts trajectories to and from those of evo (https://github.com/MichaelGrupp/evo) and messages of ROS. The
libraries evo and rosbags are imported only when these functions are called.
"""

from collections.abc import Iterable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import checks
from factorgraph_loc.files.models import write_text
from factorgraph_loc.files.temporary import writing
from factorgraph_loc.io.bags import rosbag
from factorgraph_loc.io.bags.file import is_bag, require_rosbags
from factorgraph_loc.io.bags.poses import checked_rotations, numbers_of_pose
from factorgraph_loc.io.readers import read_log
from factorgraph_loc.io.readers.pose_file import read_pose_file
from factorgraph_loc.io.results import FINAL
from factorgraph_loc.model.pose_path import PosePath, require_poses
from factorgraph_loc.model.trajectory import Trajectory, write_tum
from factorgraph_loc.text import quoted
from factors.se2 import Array

TOPIC = ":"  # separates a bag and a topic
LOG = ".toml"
MESSAGES = "PoseStamped, PoseWithCovarianceStamped, Odometry, TransformStamped or PointStamped"


def read_trajectory(source: str | Path) -> PosePath:
    """Return the trajectory that ``source`` names. ``source`` is one of:

    - a file in TUM, KITTI or EuRoC format, recognized by its first row
    - a topic of a bag, as ``BAG:TOPIC`` or ``BAG:/tf:PARENT.CHILD``
    - the folder of a run, for its final trajectory
    - a log, for its reference

    Raises InputError with a message of one line.
    """
    path, text = Path(source), str(source)
    if (bag := _in_bag(text)) is not None:
        return replace(rosbag.read_trajectory(*bag), name=text)
    if path.is_file() and path.suffix != LOG:
        return read_pose_file(path)
    if (path / FINAL).is_file():
        return replace(read_pose_file(path / FINAL), name=text)
    if path.is_dir() and (runs := sorted(path.glob(f"runs/*/*/seed*/{FINAL}"))):
        raise InputError(f"{path}: contains {len(runs)} runs, expected the folder of one run, such as {runs[0].parent}")
    return _reference(text)


def _in_bag(text: str) -> tuple[Path, str] | None:
    """Return the path and the topic in ``BAG:TOPIC``. The topic may be "". Returns None if ``text`` names no bag."""
    parts = text.split(TOPIC)
    for i in range(len(parts), 0, -1):
        path = Path(TOPIC.join(parts[:i]))
        if is_bag(path) and (i < len(parts) or path.exists()):
            return path, TOPIC.join(parts[i:])
    return None


def _reference(log: str) -> PosePath:
    loaded = read_log(log)
    if loaded.reference is None:
        raise InputError(f"{log}: is a log without a reference, expected a log with a reference, or a trajectory")
    return loaded.reference.path(log, loaded.t0_ns)


def write_trajectory(trajectory: Trajectory | PosePath, path: str | Path, t0_ns: int = 0) -> list[Path]:
    """Write a trajectory in TUM format, or in KITTI format if ``path`` ends with .kitti. Returns the written files.

    ``t0_ns``: the absolute time [ns] of t = 0 of a planar trajectory, for TUM format. For KITTI format, times [s] since
    t = 0 are written to ``NAME.times.txt``. The written KITTI poses are those of the robot (x forward, z up), not of a
    camera. They are in the frame of ``trajectory``.
    """
    path = Path(path)
    if path.suffix != ".kitti":
        write_tum(trajectory, path, t0_ns)
        return [path]
    poses = trajectory.path("trajectory") if isinstance(trajectory, Trajectory) else trajectory
    rows = np.concatenate((poses.rotations, poses.positions[:, :, None]), axis=2).reshape(-1, 12)
    t = trajectory.t if isinstance(trajectory, Trajectory) else trajectory.seconds()
    times = path.with_name(path.stem + ".times.txt")
    with writing(path):
        write_text(path, "".join(" ".join(f"{value:.12g}" for value in row) + "\n" for row in rows.tolist()))
        write_text(times, "".join(f"{seconds:.9f}\n" for seconds in t.tolist()))
    return [path, times]


def to_evo(trajectory: Trajectory | PosePath, t0_ns: int = 0) -> Any:
    """Return a trajectory as evo's ``PoseTrajectory3D``. ``t0_ns``: the absolute time [ns] of t = 0 of a planar trajectory.

    Raises InputError if evo is not installed, or if a pose is not finite.
    """
    try:
        from evo.core.trajectory import PoseTrajectory3D  # type: ignore[import-untyped] # noqa: PLC0415
    except ImportError as error:
        raise InputError("conversion to evo needs the library evo: pip install evo") from error
    path = _posed(trajectory, t0_ns)
    return PoseTrajectory3D(path.positions, np.roll(path.quaternions(), 1, axis=1), path.seconds())  # evo has w first


def from_evo(trajectory: Any) -> PosePath:
    """Return the poses of a trajectory of evo. A ``PosePath3D`` gives poses without times.

    Raises InputError if ``trajectory`` is not a trajectory of evo.
    """
    try:
        turns = np.roll(np.asarray(trajectory.orientations_quat_wxyz, dtype=float), -1, axis=1)
        table = np.column_stack((trajectory.positions_xyz, turns))
        seconds = getattr(trajectory, "timestamps", None)
        times = None if seconds is None else np.asarray(seconds, dtype=float)
    except (AttributeError, TypeError, ValueError) as error:
        raise InputError(f"the trajectory is {quoted(trajectory)}, expected a trajectory of evo") from error
    name = "the trajectory of evo"
    return _path(name, table, None if times is None else checks.stamps(name, np.arange(1, len(times) + 1), times))


def to_ros(trajectory: Trajectory | PosePath, frame_id: str = "map", t0_ns: int = 0) -> Any:
    """Return a trajectory as a ``nav_msgs/Path`` message: of ROS 2 if its environment is sourced, else of the library rosbags.

    ``frame_id``: the frame of the poses. ``t0_ns``: the absolute time [ns] of t = 0 of a planar trajectory. Raises
    InputError if neither ROS 2 nor rosbags is available, or if a pose is not finite.
    """
    make = _messages()
    path = _posed(trajectory, t0_ns)
    stamps, turns = path.stamps().tolist(), path.quaternions().tolist()

    def header(t_ns: int) -> Any:
        stamp = make("builtin_interfaces", "Time", sec=t_ns // 10**9, nanosec=t_ns % 10**9)
        return make("std_msgs", "Header", stamp=stamp, frame_id=frame_id)

    poses = []
    for t_ns, place, turn in zip(stamps, path.positions.tolist(), turns, strict=True):
        position = make("geometry_msgs", "Point", **dict(zip("xyz", place, strict=True)))
        orientation = make("geometry_msgs", "Quaternion", **dict(zip("xyzw", turn, strict=True)))
        pose = make("geometry_msgs", "Pose", position=position, orientation=orientation)
        poses.append(make("geometry_msgs", "PoseStamped", header=header(t_ns), pose=pose))
    return make("nav_msgs", "Path", header=header(stamps[0]), poses=poses)


def from_ros(messages: Any) -> PosePath:
    """Return the poses of a ``nav_msgs/Path`` message, or of a sequence of messages.

    The messages may be ``PoseStamped``, ``PoseWithCovarianceStamped``, ``Odometry``, ``TransformStamped`` or
    ``PointStamped``, which has no rotation. Messages of rclpy and of rosbags are accepted. Times are from the
    headers. Raises InputError with the number of an invalid message.
    """
    given: Iterable[Any] = getattr(messages, "poses", messages)
    rows, stamps, points = [], [], set()
    for i, message in enumerate(given, start=1):
        try:
            stamp = message.header.stamp
            stamps.append(stamp.sec * 10**9 + stamp.nanosec)
            rows.append(_numbers_of_pose(message))
        except AttributeError as error:
            problem = f"message {i} is of type {type(message).__name__}"
            raise InputError(f"{problem}, expected {MESSAGES} of ROS 2, or one nav_msgs/Path") from error
        points.add(hasattr(message, "point"))
    path = _path("the messages", np.array(rows, dtype=float).reshape(-1, 7), np.array(stamps, dtype=np.int64))
    return path if points != {True} else PosePath(path.name, path.positions, path.rotations, path.t_ns, False)


def _posed(trajectory: Trajectory | PosePath, t0_ns: int) -> PosePath:
    """Return the poses of a trajectory. ``t0_ns``: the absolute time [ns] of t = 0 of a planar trajectory.

    Raises InputError if there is no pose, or if a pose is not finite."""
    path = trajectory.path("the trajectory", t0_ns) if isinstance(trajectory, Trajectory) else trajectory
    require_poses(path)
    return path


def _numbers_of_pose(message: Any) -> tuple[float, ...]:
    """Return x, y, z [m] and the quaternion x, y, z, w of a message. A point has the identity quaternion."""
    if hasattr(message, "transform"):
        return numbers_of_pose(message.transform, "translation", "rotation")
    if hasattr(message, "point"):
        return message.point.x, message.point.y, message.point.z, 0.0, 0.0, 0.0, 1.0
    return numbers_of_pose(message.pose.pose if hasattr(message.pose, "pose") else message.pose)


def _messages() -> Any:
    """Return a function that makes a ROS message from its package, type and fields, with ROS 2 or else rosbags."""
    try:
        import nav_msgs.msg  # type: ignore[import-not-found] # noqa: F401, PLC0415
    except ImportError:
        require_rosbags()
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

        types = get_typestore(Stores.ROS2_HUMBLE).types
        return lambda package, kind, **fields: types[f"{package}/msg/{kind}"](**fields)
    return lambda package, kind, **fields: getattr(import_module(f"{package}.msg"), kind)(**fields)


def _path(name: str, table: Array, t_ns: Any) -> PosePath:
    """Return the poses in ``table`` (N, 7): positions x, y, z and quaternions x, y, z, w. ``name``: for messages.

    ``t_ns`` (N,): the timestamps, None for poses without times. Raises InputError if a number is not finite, or if a
    quaternion is not a unit quaternion."""
    rows = np.arange(1, len(table) + 1)
    path = PosePath(name, table[:, :3], checked_rotations(name, rows, table), t_ns)
    require_poses(path)
    return path
