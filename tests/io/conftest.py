"""Small hand-made logs, one folder per format."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mapped_hall import hall, with_options  # noqa: F401 - fixtures
from rosbag_drive import maker, read_drive, refuse_drive  # noqa: F401 - fixtures
from rosbag_reads import bag, mcap, read, refuse  # noqa: F401 - fixtures
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from factorgraph_loc.errors import InputError
from factorgraph_loc.io.readers import load
from factorgraph_loc.model.log import Log

RUN = """\
name = "hall"
[rig]
name = "cart"
bearing_range = { range_sigma = 0.1, bearing_sigma = 0.02 }
[world.landmarks]
A = { x = 1.0, y = 2.0 }
B = { x = 3.0, y = 0.0 }
"""
ODOMETRY = "t_ns,v,w\n1000000000,0.5,0.1\n1500000000,0.5,0.0\n2000000000,0.0,0.0\n"
SIGHTINGS = "t_ns,landmark,range,bearing\n1200000000,A,2.5,0.3\n1200000000,B,,-0.2\n1600000000,A,2.25,\n"
REFERENCE = "# t x y z qx qy qz qw\n1.0 0 0 0 0 0 0 1\n1.5 0.25 0 0 0 0 0 1\n"

DAT = {
    "Barcodes.dat": "# comment\n  1 \t 5\n  2 \t 14\n  6 \t 63\n  7 \t 81\n",
    "Landmark_Groundtruth.dat": "# comment\n  6 \t 0.5 \t -4.2 \t 0.0001 \t 0.0002\n 7 1.5 2.0 0.0003 0.0001\n",
    "Robot1_Odometry.dat": "# comment\n1248444187.156 \t 0.086 \t -0.398\n1248444187.186 0.1 0.0\n1248444187.197 0.1 0.2\n",
    "Robot1_Measurement.dat": (
        "# comment\n1248444187.160 \t 63 \t 3.787 \t -0.257\n1248444187.160 81 2.0 0.1\n"
        "1248444187.190 14 1.0 0.0\n1248444187.195 99 1.0 0.0\n"
    ),
    "Robot1_Groundtruth.dat": "# comment\n1248444187.100 1.0 -3.0 2.25\n1248444187.200 1.1 -3.0 2.25\n",
}


@pytest.fixture
def native(tmp_path: Path) -> Path:
    """A log in the native format: three rows of odometry, three sightings, two poses."""
    folder = tmp_path / "hall"
    folder.mkdir()
    (folder / "run.toml").write_text(RUN)
    (folder / "odometry.csv").write_text(ODOMETRY)
    (folder / "bearing_range.csv").write_text(SIGHTINGS)
    (folder / "reference.tum").write_text(REFERENCE)
    return folder


@pytest.fixture
def mrclam(tmp_path: Path) -> Path:
    """A MRCLAM folder: three rows of odometry; two landmarks, a robot and an unknown barcode seen."""
    folder = tmp_path / "set"
    folder.mkdir()
    for name, text in DAT.items():
        (folder / name).write_text(text)
    return folder


@pytest.fixture
def one() -> Callable[..., Log]:
    """``load`` of what must be one log."""

    def call(path: Path | str, **kwargs: object) -> Log:
        (log,) = load(str(path), **kwargs)
        return log

    return call


@pytest.fixture
def refused() -> Callable[..., str]:
    """The message, of one line, with which ``load`` refuses; it must hold all ``fragments``."""

    def call(path: Path | str, *fragments: str, **kwargs: object) -> str:
        with pytest.raises(InputError) as caught:
            load(str(path), **kwargs)
        message = str(caught.value)
        assert "\n" not in message
        for fragment in fragments:
            assert fragment in message
        return message

    return call


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

    def pose(self, x: float, y: float, heading: float, z: float = 0.0) -> object:
        q = (0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))
        position = self.make("geometry_msgs/msg/Point", x=x, y=y, z=z)
        turn = self.make("geometry_msgs/msg/Quaternion", x=q[0], y=q[1], z=q[2], w=q[3])
        return self.make("geometry_msgs/msg/Pose", position=position, orientation=turn)

    def twist(self, v: float, w: float) -> object:
        vectors = [self.make("geometry_msgs/msg/Vector3", x=x, y=0.0, z=z) for x, z in ((v, 0.0), (0.0, w))]
        return self.make("geometry_msgs/msg/Twist", linear=vectors[0], angular=vectors[1])

    def write(self, topic: str, received: int, kind: str, **fields: object) -> None:
        self.topic(topic, kind)
        message = self.make(kind, **fields)
        raw = (self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr)(message, kind)
        self.writer.write(self.connections[topic], received, raw)

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


@pytest.fixture
def bag_maker() -> type[BagMaker]:
    return BagMaker
