"""Bags made by hand."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

READS = """\
std_msgs/Header header
Read[] reads
================================================================================
MSG: shop_msgs/Read
string epc
uint8[] raw
int32 antenna
float32 rssi
float64 phase_degrees
uint64 first_seen_us
"""


class BagMaker:
    """Writes a bag of ROS version 1 (``.bag``) or 2 (a folder, by its storage), with a custom message ``shop_msgs/msg/Reads``."""

    def __init__(self, path: Path, storage: str = "mcap", compression: tuple[object, ...] = ()) -> None:
        self.path, self.ros1 = path, path.suffix == ".bag"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        self.store.register(get_types_from_msg(READS, "shop_msgs/msg/Reads"))
        if self.ros1:
            frames = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(frames, "tf2_msgs/msg/TFMessage"))
            self.writer = rosbag1.Writer(path)
        else:
            self.writer = rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin[storage.upper()])
        if compression:
            self.writer.set_compression(*compression)
        self.writer.open()
        self.connections: dict[str, object] = {}

    def __enter__(self) -> "BagMaker":
        return self

    def __exit__(self, *error: object) -> None:
        self.writer.close()

    def topic(self, name: str, kind: str) -> None:
        if name not in self.connections:
            self.connections[name] = self.writer.add_connection(name, kind, typestore=self.store)

    def make(self, kind: str, **fields: object) -> object:
        return self.store.types[kind](**fields)

    def time(self, ns: int) -> object:
        return self.make("builtin_interfaces/msg/Time", sec=ns // 10**9, nanosec=ns % 10**9)

    def header(self, ns: int, frame: str = "") -> object:
        more = {"seq": 0} if self.ros1 else {}
        return self.make("std_msgs/msg/Header", stamp=self.time(ns), frame_id=frame, **more)

    def vector(self, kind: str, *values: float) -> object:
        return self.make(f"geometry_msgs/msg/{kind}", **dict(zip("xyzw", values, strict=False)))

    def pose_in_space(self, position: Sequence[float], quaternion: Sequence[float]) -> object:
        place, turn = self.vector("Point", *position), self.vector("Quaternion", *quaternion)
        return self.make("geometry_msgs/msg/Pose", position=place, orientation=turn)

    def pose(self, x: float, y: float, heading: float, z: float = 0.0) -> object:
        return self.pose_in_space((x, y, z), (0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2)))

    def twist(self, v: float, w: float) -> object:
        along, about = self.vector("Vector3", v, 0.0, 0.0), self.vector("Vector3", 0.0, 0.0, w)
        return self.make("geometry_msgs/msg/Twist", linear=along, angular=about)

    def write(self, topic: str, received: int, kind: str, **fields: object) -> None:
        self.topic(topic, kind)
        message = self.make(kind, **fields)
        raw = (self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr)(message, kind)
        self.writer.write(self.connections[topic], received, raw)

    def stamped(self, topic: str, ns: int, kind: str, frame: str = "", **fields: object) -> None:
        """Write a message with a header, which is received at the time of its stamp."""
        self.write(topic, ns, kind, header=self.header(ns, frame), **fields)

    def odometry(
        self,
        topic: str,
        ns: int,
        pose: tuple[float, float, float],
        delay: int = 0,
        v: float = 0.0,
        *,
        turned: bool = True,
    ) -> None:
        """Without ``turned`` the orientation is left at zeros."""
        spread = np.zeros(36)
        place = self.pose(*pose)
        if not turned:
            place.orientation.w = 0.0
        self.write(
            topic,
            ns + delay,
            "nav_msgs/msg/Odometry",
            header=self.header(ns, "odom"),
            child_frame_id="base_link",
            pose=self.make("geometry_msgs/msg/PoseWithCovariance", pose=place, covariance=spread),
            twist=self.make("geometry_msgs/msg/TwistWithCovariance", twist=self.twist(v, 0.0), covariance=spread),
        )

    def reads(self, topic: str, ns: int, reads: list[tuple[str, int, float, float, int]], delay: int = 0) -> None:
        """Reads as (EPC, antenna, RSSI, phase in degrees, stamp in ns) in one message."""
        rows = [
            self.make(
                "shop_msgs/msg/Read",
                epc=epc,
                raw=np.frombuffer(bytes.fromhex(epc), dtype=np.uint8),
                antenna=antenna,
                rssi=rssi,
                phase_degrees=phase,
                first_seen_us=t // 1000,
            )
            for epc, antenna, rssi, phase, t in reads
        ]
        self.write(topic, ns + delay, "shop_msgs/msg/Reads", header=self.header(ns), reads=rows)
