"""Identified landmarks in a bag: poses or corners of detected markers, or any message by a mapping of fields."""

from dataclasses import replace
from typing import Any, Literal

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import checks
from factorgraph_loc.files.columns import POSES, Table
from factorgraph_loc.io.bags.fields import TopicSettings, leaves
from factorgraph_loc.io.bags.file import Bag, Stamped
from factorgraph_loc.io.bags.frames import StaticFrames
from factorgraph_loc.io.bags.tables import DescribedRows, RowsOfTopic, TableTopic
from factorgraph_loc.maps.markers import corner_names
from factorgraph_loc.model.measurement import Stream
from factorgraph_loc.model.planar import Axes, Turned
from factorgraph_loc.sensors.camera.tables import SIGHTINGS
from factorgraph_loc.sensors.landmarks.measurement import BEARING_RANGE
from factorgraph_loc.sensors.tables import stream_of
from factorgraph_loc.text import listed
from factors.se2 import Array

LandmarkField = Literal["landmark", "range", "bearing", "x", "y", "z"]
CORNERS = "apriltag_msgs/msg/AprilTagDetectionArray"  # detections as pixels: centre and four corners

CORNER_FIELDS = ("detections[].family", "detections[].id", "detections[].corners[].x", "detections[].corners[].y")

_POSE = "pose.position"
# messages of marker detectors: the marker's name, and its position in the camera's optical frame
DETECTIONS: dict[str, tuple[str, str]] = {
    "apriltag_ros/msg/AprilTagDetectionArray": ("detections[].id", f"detections[].pose.pose.{_POSE}"),
    "aruco_msgs/msg/MarkerArray": ("markers[].id", f"markers[].pose.{_POSE}"),
    "aruco_opencv_msgs/msg/ArucoDetection": ("markers[].marker_id", f"markers[].{_POSE}"),
    "ros2_aruco_interfaces/msg/ArucoMarkers": ("marker_ids[]", "poses[].position"),
    "fiducial_msgs/msg/FiducialTransformArray": ("transforms[].fiducial_id", "transforms[].transform.translation"),
}


PLACES = tuple(replace(POSES[axis], may_lack=True) for axis in "xyz")  # in the sensor frame


class LandmarkTopic(TopicSettings, Turned):
    """A topic of landmarks, such as those of common marker detectors."""

    fields: dict[LandmarkField, str] | None = None
    """paths of the landmark's name, and of its range and bearing, or of its position x, y, z in the sensor frame; known for
    common marker detectors"""
    axes: Axes = "optical"
    """axes of the sensor that point forward, left and up: body (x, y, z), optical (z, -x, -y), or such a list"""
    frame: str | None = None
    """frame of the sensor, whose pose is in tf_static; without it use axes and mounting"""


class Landmarks(RowsOfTopic):
    """Collects ranges and bearings of a topic, or the positions from which they are computed."""

    def __init__(self, bag: Bag, options: LandmarkTopic, frames: StaticFrames) -> None:
        topic = bag.topic(options.topic)
        self._options, self._frames = options, frames
        fields: dict[Any, str] = dict(options.fields or {})
        if not fields:
            if topic.type not in DETECTIONS:
                known = ", ".join(DETECTIONS)
                raise InputError(
                    f"{bag.path}: topic {topic.name} is of type {topic.type}: give its fields; known without: {known}"
                )
            name, place = DETECTIONS[topic.type]
            fields = {"landmark": name} | {axis: f"{place}.{axis}" for axis in "xyz"}
        self._places = "x" in fields
        wanted = {"landmark", "x", "y", "z"} if self._places else {"landmark", "range", "bearing"}
        if "landmark" not in fields or not set(fields) <= wanted or len(fields) < (4 if self._places else 2):
            expected = "landmark with x, y and z, or with range, bearing or both"
            raise InputError(f"{bag.path} {topic.name}: fields are {listed(fields)}, expected {expected}")
        columns = (BEARING_RANGE["landmark"], *PLACES) if self._places else BEARING_RANGE.columns[1:]
        super().__init__(bag, options.topic, fields, columns, {})

    def stream(self, t0_ns: int, warnings: list[str]) -> Stream:
        """Ranges along the floor and bearings, in the robot frame if the sensor's pose is known."""
        rows = self.rows_of(self._polar() if self._places else None)
        return stream_of(BEARING_RANGE, rows, t0_ns, warnings)

    def _polar(self) -> dict[str, Array]:
        places = self._rows.values
        checks.require_finite(self._rows.source, self._rows.rows, "xyz", places)
        pose = np.eye(4)
        if self._options.frame is not None:
            pose = self._frames.known(self._rows.source, self._options.frame)
        else:
            pose[:3, :3] = self._options.turned()
        x, y, _ = (places @ pose[:3, :3].T + pose[:3, 3]).T
        return {"range": np.hypot(x, y), "bearing": np.arctan2(y, x)}


class Corners(RowsOfTopic):
    """Collects the corners of AprilTags as pixels of named points. The names are ``FAMILY-NUMBER/0`` to ``/3``, see
    :func:`factorgraph_loc.maps.markers.corner_names`."""

    def __init__(self, bag: Bag, name: str) -> None:
        topic = bag.topic(name, CORNERS)
        known = leaves(bag.store(name), topic.type)
        if lacking := [path for path in CORNER_FIELDS if path not in known]:
            raise InputError(f"{bag.path}: topic {name} ({topic.type}) lacks {listed(lacking)}")
        super().__init__(bag, name, {}, SIGHTINGS.columns[1:], {})

    def add(self, item: Stamped, t_ns: int) -> None:
        """Add the pixels of a message."""
        for found in item.message.detections:
            names = corner_names(f"{found.family}-{found.id}")
            # apriltag starts at the lower left corner and continues with the lower right one
            for name, corner in zip(reversed(names), found.corners, strict=True):
                self._names["landmark"].append(name)
                self._rows.append(item, t_ns, (corner.x, corner.y))

    def stream(self, t0_ns: int, warnings: list[str]) -> Stream:
        """The pixels as a stream; problems are an InputError or a warning."""
        return stream_of(SIGHTINGS, self.rows_of(), t0_ns, warnings)


def rows_of_table(bag: Bag, options: TableTopic, table: Table) -> Corners | DescribedRows:
    """The collector of a topic of rows of ``table``; the corners of AprilTags need no fields."""
    if table.name == SIGHTINGS.name and not options.fields and bag.topic(options.topic).type == CORNERS:
        return Corners(bag, options.topic)
    return DescribedRows(bag, options, table)
