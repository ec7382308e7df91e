"""Trajectories as those of evo (https://github.com/MichaelGrupp/evo) and as ROS messages, and back.

Neither library is needed for anything else: they are imported where they are used.
"""

from collections.abc import Iterable
from importlib import import_module
from typing import Any

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.io.bags.file import require_rosbags
from factorgraph_loc.io.bags.poses import check_rotations, seven
from factorgraph_loc.model.planar import rotations_of
from factorgraph_loc.model.trajectory3 import PosePath, require_poses
from factorgraph_loc.text import quoted
from factors.se2 import Array

MESSAGES = "PoseStamped, PoseWithCovarianceStamped, Odometry, TransformStamped or PointStamped"


def to_evo(path: PosePath) -> Any:
    """The poses as evo's ``PoseTrajectory3D``. InputError if evo is not installed, or a pose is not finite."""
    try:
        from evo.core.trajectory import PoseTrajectory3D  # type: ignore[import-untyped] # noqa: PLC0415
    except ImportError as error:
        raise InputError("trajectories of evo need evo: pip install evo") from error
    require_poses(path)
    turns = path.in_space(0).quaternions()
    return PoseTrajectory3D(path.positions, np.roll(turns, 1, axis=1), path.seconds())  # evo has w first


def from_evo(trajectory: Any) -> PosePath:
    """The poses of a trajectory of evo, which has no times if it is a ``PosePath3D``. InputError if it is no trajectory."""
    try:
        turns = np.roll(np.asarray(trajectory.orientations_quat_wxyz, dtype=float), -1, axis=1)
        table = np.column_stack((trajectory.positions_xyz, turns))
        seconds = getattr(trajectory, "timestamps", None)
        t_ns = None if seconds is None else _nanoseconds(np.asarray(seconds, dtype=float))
    except (AttributeError, TypeError, ValueError) as error:
        raise InputError(f"the trajectory is {quoted(trajectory)}, expected one of evo") from error
    return _path("the trajectory of evo", table, t_ns)


def to_ros(path: PosePath, frame_id: str) -> Any:
    """The poses as a ``nav_msgs/Path``. InputError if neither ROS 2 nor rosbags is there, or a pose is not finite."""
    make = _messages()
    require_poses(path)
    trajectory = path.in_space(0)

    def header(t_ns: int) -> Any:
        stamp = make("builtin_interfaces", "Time", sec=t_ns // 10**9, nanosec=t_ns % 10**9)
        return make("std_msgs", "Header", stamp=stamp, frame_id=frame_id)

    poses = []
    assert path.t_ns is not None
    for t_ns, place, turn in zip(
        path.t_ns.tolist(), trajectory.positions.tolist(), trajectory.quaternions().tolist(), strict=True
    ):
        position = make("geometry_msgs", "Point", **dict(zip("xyz", place, strict=True)))
        orientation = make("geometry_msgs", "Quaternion", **dict(zip("xyzw", turn, strict=True)))
        pose = make("geometry_msgs", "Pose", position=position, orientation=orientation)
        poses.append(make("geometry_msgs", "PoseStamped", header=header(t_ns), pose=pose))
    return make("nav_msgs", "Path", header=header(int(path.t_ns[0])), poses=poses)


def from_ros(messages: Any) -> PosePath:
    """The poses of a ``nav_msgs/Path``, or of several stamped messages. InputError names the invalid message."""
    given: Iterable[Any] = getattr(messages, "poses", messages)
    rows, stamps, points = [], [], set()
    for i, message in enumerate(given, start=1):
        try:
            stamp = message.header.stamp
            stamps.append(stamp.sec * 10**9 + stamp.nanosec)
            rows.append(_seven(message))
        except AttributeError as error:
            told = f"message {i} is of type {type(message).__name__}"
            raise InputError(f"{told}, expected {MESSAGES} of ROS 2, or one nav_msgs/Path") from error
        points.add(hasattr(message, "point"))
    path = _path("the messages", np.array(rows, dtype=float).reshape(-1, 7), np.array(stamps, dtype=np.int64))
    return path if points != {True} else PosePath(path.name, path.positions, path.rotations, path.t_ns, False)


def _seven(message: Any) -> tuple[float, ...]:
    """x, y, z and the quaternion x, y, z, w."""
    if hasattr(message, "transform"):
        return seven(message.transform, "translation", "rotation")
    if hasattr(message, "point"):
        return message.point.x, message.point.y, message.point.z, 0.0, 0.0, 0.0, 1.0
    return seven(message.pose.pose if hasattr(message.pose, "pose") else message.pose)


def _messages() -> Any:
    """Makes messages of ROS 2, or of rosbags, by package, type and fields."""
    try:
        import nav_msgs.msg  # type: ignore[import-not-found] # noqa: F401, PLC0415
    except ImportError:
        require_rosbags()
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

        types = get_typestore(Stores.ROS2_HUMBLE).types
        return lambda package, kind, **fields: types[f"{package}/msg/{kind}"](**fields)
    return lambda package, kind, **fields: getattr(import_module(f"{package}.msg"), kind)(**fields)


def _path(name: str, table: Array, t_ns: Any) -> PosePath:
    """The path of rows (N, 7) with position and quaternion. InputError if one is not finite, or no unit quaternion."""
    rows = np.arange(1, len(table) + 1)
    check_rotations(name, rows, table)
    found = PosePath(name, table[:, :3], rotations_of(name, rows, table[:, 3:]), t_ns)
    require_poses(found)
    return found


def _nanoseconds(seconds: Array) -> Any:
    if not np.all(np.abs(seconds) < 2**63 / 1e9):
        raise ValueError("a time is beyond 64 bits of nanoseconds")
    return np.rint(seconds * 1e9).astype(np.int64)
