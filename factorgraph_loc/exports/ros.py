"""Exports a log and its runs as an MCAP file (https://mcap.dev) with standard messages of ROS 2.

Foxglove, RViz and ``ros2 bag play`` read such files. Poses are in the frame ``map``, with absolute timestamps. The
library ``rosbags`` is optional and imported only where it is used.
"""

import heapq
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.exports import scene
from factorgraph_loc.exports.runs import StoredRun
from factorgraph_loc.exports.scene import DARK, Colour, colours
from factorgraph_loc.files.checks import absolute
from factorgraph_loc.files.temporary import temporary_folder, writing
from factorgraph_loc.io.bags.file import require_rosbags
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.camera import summary as pictures_of
from factors.se2 import Array

MAP, BASE, CAMERA, REFERENCE = "map", "base_link", "camera", "reference"
PLANAR = np.array((0, 1, 5))  # indices of x, y and the rotation about z in the covariances of ROS
NO_ESTIMATE = np.array([-1.0, *[0.0] * 35])  # covariance of a value that is not estimated, as in sensor_msgs
LATEST = 2**31 * 10**9  # ns: timestamps of ROS have 32 bits for seconds
DOT, POINT, LINE, LETTERS = 0.12, 0.03, 0.02, 0.15  # m: diameters, width of a line, height of letters
LINES, SPHERES, TEXT = 5, 7, 9  # types of a marker: LINE_LIST, SPHERE_LIST, TEXT_VIEW_FACING

Message = tuple[int, str, str, Any]  # time [ns], topic, type, content


def write_mcap(log: Log, runs: Sequence[StoredRun], path: Path) -> None:
    """Write a log and its runs to an MCAP file with these topics:

    - ``/NAME/odometry``, ``/NAME/path``, ``/NAME/markers`` for the run NAME: causal estimates with covariances, the final
      trajectory, and estimated landmarks
    - ``/reference/odometry`` and ``/reference/path``
    - ``/tf``: the poses of robots as frames ``base_link`` (``NAME/base_link`` for several runs) and ``reference/base_link``
    - ``/markers``: walls, tags, landmarks and points of the map
    - ``/camera/image/compressed``

    Raises InputError if ``rosbags`` is not installed, a timestamp is not between 1970 and 2038, or an image cannot be read.
    """
    require_rosbags()
    from rosbags.rosbag2 import StoragePlugin, Writer  # noqa: PLC0415 - an optional library
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    store = get_typestore(Stores.ROS2_HUMBLE)
    connections: dict[str, Any] = {}
    with writing(path), temporary_folder(path) as folder:
        with Writer(folder / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            for t_ns, topic, kind, content in heapq.merge(
                *_sources(log, runs, _Maker(store.types)), key=lambda m: m[0]
            ):
                if not 0 <= t_ns < LATEST:
                    raise InputError(f"{log.name}: {topic} has the timestamp {t_ns} ns, expected one from 1970 to 2038")
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=store)
                writer.write(connections[topic], t_ns, store.serialize_cdr(content, kind))
        (folder / "bag/bag.mcap").replace(path)


def _sources(log: Log, runs: Sequence[StoredRun], make: "_Maker") -> Iterator[Iterator[Message]]:
    """Yield iterators over all messages of the log and its runs. The messages of an iterator are in order of time.

    ``make``: makes the ROS messages."""
    moving = [(run.name, BASE if len(runs) == 1 else f"{run.name}/{BASE}", run.played(), run.final) for run in runs]
    if log.reference is not None:
        moving.append((REFERENCE, f"{REFERENCE}/{BASE}", log.reference, log.reference))
    firsts = [float(t.t[0]) for _, _, played, final in moving for t in (played, final) if len(t)]
    start_ns = int(absolute(np.array([min([log.span()[0], *firsts])]), log.t0_ns)[0])
    yield iter([make.markers(start_ns, "/markers", _map(log, make))])
    for name, frame, played, final in moving:
        yield _poses(f"/{name}/odometry", frame, played, log.t0_ns, make)
        yield iter([make.path(start_ns, f"/{name}/path", final, log.t0_ns)])
    for run, colour in zip(runs, colours(), strict=False):
        learnt = {name: np.array((*point.position, 0.0)) for name, point in run.landmarks.items()}
        known = {name: position for name, position in learnt.items() if np.isfinite(position).all()}
        if known:
            yield iter([make.markers(start_ns, f"/{run.name}/markers", make.dots("learnt", known, colour))])
    yield _images(log, make)


def _map(log: Log, make: "_Maker") -> list[dict[str, Any]]:
    """Return the walls, landmarks, tags and points of the map as fields of ``visualization_msgs/Marker`` messages."""
    ends = [(x, y, 0.0) for x, y in np.array(log.world.walls).reshape(-1, 2).tolist()]
    shapes = [make.shape("walls", LINES, LINE, DARK, ends)] if ends else []
    for marks, positions, _ in scene.layers(log):
        if marks.dense and len(marks.positions):
            shapes.append(make.shape(marks.layer, SPHERES, POINT, DARK, marks.positions.tolist()))
        elif positions:
            shapes += make.dots(marks.layer, positions, DARK)
    return shapes


def _poses(topic: str, frame: str, trajectory: Trajectory, t0_ns: int, make: "_Maker") -> Iterator[Message]:
    """Yield two messages per pose of a trajectory: the transform of ``frame`` on ``/tf``, and odometry on ``topic``.

    Odometry has the covariance of the pose, zero if it is unknown. ``t0_ns``: the absolute time [ns] of t = 0."""
    covariances = np.zeros((len(trajectory), 6, 6))
    if trajectory.covariances is not None:
        known = np.isfinite(trajectory.covariances).all(axis=(1, 2))
        covariances[np.ix_(known, PLANAR, PLANAR)] = trajectory.covariances[known]
    still = make("geometry_msgs/Twist", linear=make.vector(0.0, 0.0, 0.0), angular=make.vector(0.0, 0.0, 0.0))
    no_twist = make("geometry_msgs/TwistWithCovariance", twist=still, covariance=NO_ESTIMATE)
    stamps = absolute(trajectory.t, t0_ns).tolist()
    for t_ns, (x, y, heading), covariance in zip(stamps, _planar(trajectory), covariances, strict=True):
        header = make.header(t_ns, MAP)
        place = make.pose(x, y, 0.0, heading)
        move = make("geometry_msgs/Transform", translation=make.vector(x, y, 0.0), rotation=place.orientation)
        transform = make("geometry_msgs/TransformStamped", header=header, child_frame_id=frame, transform=move)
        yield make.message(t_ns, "/tf", "tf2_msgs/TFMessage", transforms=[transform])
        pose = make("geometry_msgs/PoseWithCovariance", pose=place, covariance=covariance.ravel())
        fields = {"header": header, "child_frame_id": frame, "pose": pose, "twist": no_twist}
        yield make.message(t_ns, topic, "nav_msgs/Odometry", **fields)


def _planar(trajectory: Trajectory) -> list[list[float]]:
    """Return x, y and heading of each pose. The heading is 0 if the trajectory has no headings."""
    return np.where((True, True, trajectory.has_heading), trajectory.poses, 0.0).tolist()  # type: ignore[no-any-return]


def _images(log: Log, make: "_Maker") -> Iterator[Message]:
    for t, jpeg in pictures_of.images(log):
        t_ns = log.t0_ns + round(t * 1e9)
        content = {"format": "jpeg", "data": np.frombuffer(jpeg, dtype=np.uint8)}
        content["header"] = make.header(t_ns, CAMERA)
        yield make.message(t_ns, "/camera/image/compressed", "sensor_msgs/CompressedImage", **content)


class _Maker:
    """Makes ROS messages from their types and fields. ``types``: the classes of messages by the name of their type."""

    def __init__(self, types: Mapping[str, Any]) -> None:
        self._types = types

    def __call__(self, kind: str, **fields: Any) -> Any:
        return self._types[kind.replace("/", "/msg/")](**fields)

    def message(self, t_ns: int, topic: str, kind: str, **fields: Any) -> Message:
        """Return (time ``t_ns`` [ns], topic, type, ROS message). ``kind``: the type. ``fields``: its values."""
        return t_ns, topic, kind.replace("/", "/msg/"), self(kind, **fields)

    def header(self, t_ns: int, frame: str) -> Any:
        stamp = self("builtin_interfaces/Time", sec=t_ns // 10**9, nanosec=t_ns % 10**9)
        return self("std_msgs/Header", stamp=stamp, frame_id=frame)

    def vector(self, x: float, y: float, z: float) -> Any:
        return self("geometry_msgs/Vector3", x=x, y=y, z=z)

    def point(self, x: float, y: float, z: float) -> Any:
        return self("geometry_msgs/Point", x=x, y=y, z=z)

    def pose(self, x: float, y: float, z: float, heading: float) -> Any:
        half = heading / 2.0
        turn = self("geometry_msgs/Quaternion", x=0.0, y=0.0, z=math.sin(half), w=math.cos(half))
        return self("geometry_msgs/Pose", position=self.point(x, y, z), orientation=turn)

    def path(self, start_ns: int, topic: str, trajectory: Trajectory, t0_ns: int) -> Message:
        poses = [
            self("geometry_msgs/PoseStamped", header=self.header(t_ns, MAP), pose=self.pose(x, y, 0.0, heading))
            for t_ns, (x, y, heading) in zip(absolute(trajectory.t, t0_ns).tolist(), _planar(trajectory), strict=True)
        ]
        return self.message(start_ns, topic, "nav_msgs/Path", header=self.header(start_ns, MAP), poses=poses)

    def markers(self, t_ns: int, topic: str, shapes: Sequence[Mapping[str, Any]]) -> Message:
        """Return (time [ns], topic, type, MarkerArray). ``shapes``: the fields of each marker, see :meth:`shape`."""
        empty = {
            "header": self.header(t_ns, MAP),
            "action": 0,  # ADD
            "lifetime": self("builtin_interfaces/Duration", sec=0, nanosec=0),  # for ever
            "frame_locked": False,
            "colors": [],
            "texture_resource": "",
            "texture": self(
                "sensor_msgs/CompressedImage", header=self.header(0, ""), format="", data=np.empty(0, dtype=np.uint8)
            ),
            "uv_coordinates": [],
            "mesh_resource": "",
            "mesh_file": self("visualization_msgs/MeshFile", filename="", data=np.empty(0, dtype=np.uint8)),
            "mesh_use_embedded_materials": False,
        }
        made = [self("visualization_msgs/Marker", id=i, **empty, **shape) for i, shape in enumerate(shapes)]
        return self.message(t_ns, topic, "visualization_msgs/MarkerArray", markers=made)

    def dots(self, name: str, positions: Mapping[str, Array], colour: Colour) -> list[dict[str, Any]]:
        """Return fields of ``visualization_msgs/Marker`` for labelled spheres, for :meth:`markers`.

        ``name``: namespace of the markers. ``positions``: the centre (3,) [m] of each sphere by label.
        """
        places = {label: position.tolist() for label, position in positions.items()}
        labels = [
            self.shape(f"{name}: names", TEXT, LETTERS, colour, [], text=label, at=(x, y, z + DOT))
            for label, (x, y, z) in places.items()
        ]
        return [self.shape(name, SPHERES, DOT, colour, list(places.values())), *labels]

    def shape(
        self,
        name: str,
        kind: int,
        size: float,
        colour: Colour,
        points: Sequence[Sequence[float]],
        *,
        text: str = "",
        at: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> dict[str, Any]:
        """Return the fields of a ``visualization_msgs/Marker`` that describe its shape, for :meth:`markers`.

        ``name``: namespace. ``kind``: type of the marker. ``size``: diameter, width or height [m]. ``points``: its
        points [m]. ``text``: its text, at the position ``at`` [m].
        """
        red, green, blue = (value / 255.0 for value in colour)
        return {
            "ns": name,
            "type": kind,
            "pose": self.pose(*at, 0.0),
            "scale": self.vector(size, size, size),
            "color": self("std_msgs/ColorRGBA", r=red, g=green, b=blue, a=1.0),
            "points": [self.point(*point) for point in points],
            "text": text,
        }
