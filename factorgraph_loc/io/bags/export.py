"""Export of a log as a ROS bag: ``.bag`` of version 1, ``.mcap`` or ``.db3`` of version 2. The manifest that ``fgloc manifest``
proposes for it reads the same log; rig and map are written to files next to the bag."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.bounded import IMAGE, read_bytes
from factorgraph_loc.files.checks import absolute
from factorgraph_loc.files.temporary import sweep, temporary_folder
from factorgraph_loc.io.bags.camera import COMPRESSED
from factorgraph_loc.io.bags.fields import INITIAL_POSE, READ, ROUND, definitions, tables_of_messages
from factorgraph_loc.io.bags.file import ROS1, SUFFIXES, require_rosbags
from factorgraph_loc.io.bags.poses import POINT
from factorgraph_loc.io.native.rig_file import write_rig
from factorgraph_loc.io.native.world_file import write_world
from factorgraph_loc.model.log import Log, StartPose
from factorgraph_loc.model.measurement import Stream
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.camera.stream import ImageStream
from factorgraph_loc.sensors.odometry.measurement import IncrementStream, VelocityStream, YawRateStream
from factorgraph_loc.sensors.rfid.stream import RfidStream
from factorgraph_loc.sensors.rfid.tables import tables_of
from factorgraph_loc.sensors.tables import rows_of
from factors import se2
from factors.se2 import Array

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

MAP, ODOM, BASE, CAMERA = "map", "odom", "base_link", "camera"
FRAMES = {"sightings": CAMERA}  # frames of tables, if not the robot frame
PNG_OR_JPEG = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg"}
LATEST = 2**31 * 10**9  # ns; maximum of 32-bit seconds

Message = tuple[int, str, str, Any]  # time of receipt [ns], topic, type, content


def write_bag(log: Log, path: Path, *, overwrite: bool = False) -> list[Path]:
    """Write a log as a bag atomically, with its rig and map next to it; returns the files.

    InputError if a file exists that is not to ``overwrite``, and for what a bag cannot hold: timestamps before 1970, and features.
    Covariances of a reference are not written.
    """
    require_rosbags()
    if path.suffix not in SUFFIXES:
        raise InputError(f"{path}: is not the name of a bag, expected one that ends with {', '.join(SUFFIXES)}")
    rig, world = path.with_suffix(".rig.toml"), path.with_suffix(".world.toml")
    sweep(path.parent)
    for file in (path, rig, world):
        if file.exists() and not (overwrite and file.is_file()):
            raise InputError(f"{file}: exists, expected a new file")
    path.parent.mkdir(parents=True, exist_ok=True)
    with temporary_folder(path) as temporary:
        made = _write(log, temporary, path.suffix)
        write_rig(log.rig, rig)
        write_world(log.world, world)
        made.replace(path)
    return [path, rig, world]


def _write(log: Log, folder: Path, suffix: str) -> Path:
    """Write the bag's file in ``folder``."""
    from rosbags import rosbag1, rosbag2  # noqa: PLC0415 - an optional library
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: PLC0415

    is_ros1 = suffix == ROS1
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    for kind, text in definitions().items():
        store.register(get_types_from_msg(text.format(time="time" if is_ros1 else "builtin_interfaces/Time"), kind))
    writer: Any
    if is_ros1:
        made = folder / f"log{suffix}"
        writer = rosbag1.Writer(made)
    else:
        made = folder / "log" / f"log{suffix}"
        plugin = rosbag2.StoragePlugin.MCAP if suffix == ".mcap" else rosbag2.StoragePlugin.SQLITE3
        writer = rosbag2.Writer(folder / "log", version=9, storage_plugin=plugin)
    build = _Builder(store, is_ros1)
    serialize = store.serialize_ros1 if is_ros1 else store.serialize_cdr
    connections: dict[str, Any] = {}
    with writer:
        for received, topic, kind, message in heapq.merge(*_sources(log, build), key=lambda entry: entry[0]):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], received, serialize(message, kind))
    return made


def _sources(log: Log, build: _Builder) -> list[Iterator[Message]]:
    """The messages of each stream in order of arrival."""
    sources = [_arriving(_of_stream(name, stream, log, build)) for name, stream in log.streams.items()]
    if log.reference is not None:
        sources.append(_arriving(_of_reference(log.reference, log.t0_ns, build)))
    if log.start is not None:
        sources.append(_arriving(_of_start(log.start, log.t0_ns, build)))
    return sources


def _arriving(messages: Iterator[Message]) -> Iterator[Message]:
    """Messages with times of receipt that do not decrease."""
    latest = 0
    for t_ns, topic, kind, message in messages:
        if not 0 <= t_ns < LATEST:
            raise InputError(f"{topic}: a timestamp is {t_ns} ns, expected one from 1970 to 2038, as a bag requires")
        latest = max(latest, t_ns)
        yield latest, topic, kind, message


class _Builder:
    """Creates messages from fields by name."""

    def __init__(self, store: Typestore, is_ros1: bool) -> None:
        self._types = store.types
        self._more = {"seq": 0} if is_ros1 else {}

    def __call__(self, kind: str, **fields: Any) -> Any:
        return self._types[kind](**fields)

    def time(self, t_ns: int) -> Any:
        return self("builtin_interfaces/msg/Time", sec=t_ns // 10**9, nanosec=t_ns % 10**9)

    def header(self, t_ns: int, frame: str) -> Any:
        return self("std_msgs/msg/Header", stamp=self.time(t_ns), frame_id=frame, **self._more)

    def vector(self, x: float, y: float, z: float) -> Any:
        return self("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def twist(self, v: float, w: float) -> Any:
        return self("geometry_msgs/msg/Twist", linear=self.vector(v, 0.0, 0.0), angular=self.vector(0.0, 0.0, w))

    def turn(self, heading: float) -> Any:
        z, w = float(np.sin(heading / 2.0)), float(np.cos(heading / 2.0))
        return self("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=z, w=w)

    def pose(self, x: float, y: float, heading: float) -> Any:
        position = self("geometry_msgs/msg/Point", x=x, y=y, z=0.0)
        return self("geometry_msgs/msg/Pose", position=position, orientation=self.turn(heading))

    def uncertain_pose(self, pose: list[float], covariance: Array) -> Any:
        return self("geometry_msgs/msg/PoseWithCovariance", pose=self.pose(*pose), covariance=covariance)


def _of_stream(name: str, stream: Stream, log: Log, build: _Builder) -> Iterator[Message]:
    if isinstance(stream, RfidStream):
        return _of_rounds(stream, log.t0_ns, build)
    topic, frame = f"/{name}", BASE
    rows: Iterator[dict[str, Any]]
    match stream:
        case VelocityStream():
            kind = "geometry_msgs/msg/TwistStamped"
            rows = ({"twist": build.twist(v, w)} for v, w in zip(stream.v.tolist(), stream.w.tolist(), strict=True))
        case IncrementStream():
            kind, frame, rows = "nav_msgs/msg/Odometry", ODOM, _odometry(stream, build)
        case YawRateStream():
            kind, rows = "sensor_msgs/msg/Imu", _imu(stream, build)
        case ImageStream():
            topic = f"/{name}/image/compressed"
            kind, frame, rows = COMPRESSED, CAMERA, _images(stream.file)
        case _:
            table = next(((k, t) for k, t in tables_of_messages().items() if t.name == name), None)
            if table is None:
                what = type(stream).__name__
                raise InputError(f"{log.name}: {name} cannot be written to a bag, which has no message for {what}")
            kind, rows = table[0], rows_of(table[1], stream)
            frame = FRAMES.get(name, BASE)
    return _stamped(topic, kind, absolute(stream.t, log.t0_ns).tolist(), rows, frame, build)


def _stamped(
    topic: str, kind: str, t_ns: list[int], rows: Iterator[dict[str, Any]], frame: str, build: _Builder
) -> Iterator[Message]:
    for t, row in zip(t_ns, rows, strict=True):
        yield t, topic, kind, build(kind, header=build.header(t, frame), **row)


def _odometry(stream: IncrementStream, build: _Builder) -> Iterator[dict[str, Any]]:
    """The increments, integrated to a path that starts at the first row."""
    heading = np.cumsum(stream.dtheta) - stream.dtheta[0]
    before = np.concatenate(([0.0], heading[:-1]))
    moves = np.column_stack((stream.dx, stream.dy))
    moves[0] = 0.0
    turned = np.column_stack(
        (
            np.cos(before) * moves[:, 0] - np.sin(before) * moves[:, 1],
            np.sin(before) * moves[:, 0] + np.cos(before) * moves[:, 1],
        )
    )
    nothing = np.zeros(36)
    still = build("geometry_msgs/msg/TwistWithCovariance", twist=build.twist(0.0, 0.0), covariance=nothing)
    for (x, y), angle in zip(np.cumsum(turned, axis=0).tolist(), se2.wrap(heading).tolist(), strict=True):
        pose = build.uncertain_pose([x, y, angle], nothing)
        yield {"child_frame_id": BASE, "pose": pose, "twist": still}


def _imu(stream: YawRateStream, build: _Builder) -> Iterator[dict[str, Any]]:
    unknown = np.array([-1.0, *[0.0] * 8])  # ROS convention for a missing measurement
    for w in stream.w.tolist():
        yield {
            "orientation": build.turn(0.0),
            "orientation_covariance": unknown,
            "angular_velocity": build.vector(0.0, 0.0, w),
            "angular_velocity_covariance": np.zeros(9),
            "linear_acceleration": build.vector(0.0, 0.0, 0.0),
            "linear_acceleration_covariance": unknown,
        }


def _images(files: Iterable[Path]) -> Iterator[dict[str, Any]]:
    for file in files:
        content = read_bytes(file, IMAGE)
        kind = PNG_OR_JPEG.get(file.suffix.lower(), file.suffix.lstrip("."))
        yield {"format": kind, "data": np.frombuffer(content, dtype=np.uint8)}


def _of_rounds(stream: RfidStream, t0_ns: int, build: _Builder) -> Iterator[Message]:
    reads, rounds = tables_of(stream, t0_ns)
    columns: list[Any] = [np.asarray(reads[name]).tolist() for name in ("t_ns", "epc", "rssi", "phase", "frequency")]
    rows = list(zip(*columns, strict=True))
    bounds = np.searchsorted(np.asarray(reads["inventory"]), np.arange(1, len(rounds["t_ns"]) + 2)).tolist()
    for t, antenna, (i, j) in zip(
        np.asarray(rounds["t_ns"]).tolist(), rounds["antenna"], pairwise(bounds), strict=True
    ):
        content = [
            build(READ, stamp=build.time(at), epc=epc, rssi=rssi, phase=phase, frequency=frequency)
            for at, epc, rssi, phase, frequency in rows[i:j]
        ]
        yield t, "/rfid", ROUND, build(ROUND, header=build.header(t, BASE), antenna=antenna, reads=content)


def _of_reference(reference: Trajectory, t0_ns: int, build: _Builder) -> Iterator[Message]:
    t_ns = absolute(reference.t, t0_ns).tolist()
    if not reference.has_heading:
        points = ({"point": build("geometry_msgs/msg/Point", x=x, y=y, z=0.0)} for x, y, _ in reference.poses.tolist())
        return _stamped("/reference", POINT, t_ns, points, MAP, build)
    rows = ({"pose": build.pose(*pose)} for pose in reference.poses.tolist())
    return _stamped("/reference", "geometry_msgs/msg/PoseStamped", t_ns, rows, MAP, build)


def _of_start(start: StartPose, t0_ns: int, build: _Builder) -> Iterator[Message]:
    topic, kind = INITIAL_POSE
    covariance = np.zeros((6, 6))  # of x, y, z and rotations about these axes
    covariance[[0, 1, 5], [0, 1, 5]] = start.sigmas**2
    row = {"pose": build.uncertain_pose(start.pose.tolist(), covariance.ravel())}
    return _stamped(topic, kind, [t0_ns + round(start.t * 1e9)], iter([row]), MAP, build)
