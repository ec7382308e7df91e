"""Reads tables of sensors from a bag. The manifest maps fields of messages to the columns of a table.

A row is a message, or an element of a list in a message. RFID reads are grouped into inventory rounds. Landmarks may be
poses or corners of detected markers.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files import checks
from factorgraph_loc.files.cells import NAMES, NUMBERS, Cells
from factorgraph_loc.files.column_mapping import ReadNames, in_case
from factorgraph_loc.files.columns import LATEST, POSES, STAMP, Column, Table
from factorgraph_loc.files.models import InUnit
from factorgraph_loc.files.row_rules import Fault, RowRules
from factorgraph_loc.files.tables import TableRows
from factorgraph_loc.io.bags.file import Bag, Stamped
from factorgraph_loc.io.bags.poses import StaticFrames
from factorgraph_loc.io.bags.topics import LIST, Fields, RowTopic, TopicRows, as_nanoseconds, as_text, leaves
from factorgraph_loc.maps.markers import corner_names
from factorgraph_loc.model.measurement import Stream
from factorgraph_loc.model.planar import Axes, Turned
from factorgraph_loc.sensors.camera.measurement import SIGHTINGS
from factorgraph_loc.sensors.landmarks.measurement import BEARING_RANGE
from factorgraph_loc.sensors.rfid import tables as native_rfid
from factorgraph_loc.sensors.rfid.stream import RFID, RfidStream
from factorgraph_loc.sensors.tables import Reading, assemble, native_tables, stream_of
from factorgraph_loc.text import Notice, listed
from factors.se2 import Integers

LandmarkField = Literal["landmark", "range", "bearing", "x", "y", "z"]
CORNERS = "apriltag_msgs/msg/AprilTagDetectionArray"  # detections as pixels: centre and four corners

CORNER_FIELDS = ("detections[].family", "detections[].id", "detections[].corners[].x", "detections[].corners[].y")

_POSE = "pose.position"
# by message type of marker detectors: fields of the marker's name, and of its position in the optical frame of the camera
DETECTIONS: dict[str, tuple[str, str]] = {
    "apriltag_ros/msg/AprilTagDetectionArray": ("detections[].id", f"detections[].pose.pose.{_POSE}"),
    "aruco_msgs/msg/MarkerArray": ("markers[].id", f"markers[].pose.{_POSE}"),
    "aruco_opencv_msgs/msg/ArucoDetection": ("markers[].marker_id", f"markers[].{_POSE}"),
    "ros2_aruco_interfaces/msg/ArucoMarkers": ("marker_ids[]", "poses[].position"),
    "fiducial_msgs/msg/FiducialTransformArray": ("transforms[].fiducial_id", "transforms[].transform.translation"),
}
PLACES = tuple(replace(POSES[axis], may_lack=True) for axis in "xyz")  # in the sensor frame
ReadField = Literal["epc", "antenna", "rssi", "phase", "frequency", "stamp"]
READ = [RFID[name] for name in ("epc", "antenna", *native_rfid.SIGNALS)]
INDEX = "number of the row"
STAMP_OF_READ = replace(STAMP, name="stamp")


class TableTopic(RowTopic):
    """The settings of a topic with the measurements of a sensor, such as positions."""

    fields: dict[str, str] = Field(default_factory=dict)
    """path of the message field for each column of the table; by default the field with the name of the column"""
    units: dict[str, str | float] = Field(default_factory=dict)
    """unit of each column, or a factor that converts its values to the default unit"""


class RowsOfTopic:
    """Collects the measurements of a sensor from the messages of a topic, as rows of a table.

    ``fields``: the path of the message field for each column. ``table``: the description of all columns that the sensor
    has. ``columns``: the columns to collect, by default all except the first, which is the time. ``units``: the unit of
    a column, or a factor that converts its values to the default unit. ``rules``: whether invalid rows are skipped, and
    rows sorted by time. By default an invalid row and a decreasing timestamp are errors. A missing number becomes NaN.
    An empty name raises InputError.
    """

    def __init__(
        self,
        bag: Bag,
        topic: str,
        fields: Mapping[Any, str],
        table: Table,
        columns: Sequence[Column] | None = None,
        units: Mapping[Any, str | float] | None = None,
        rules: RowRules | None = None,
    ) -> None:
        self._fields, self._rules = Fields(bag, bag.topic(topic), fields), rules or RowRules()
        self._unread: list[tuple[int, str]] = []
        self._table, self._columns, self._units = table, columns or table.columns[1:], units or {}
        self._named = [column for column in self._columns if column.kind in NAMES]
        self._numbered = [column.name for column in self._columns if column.kind in NUMBERS]
        self._names: dict[str, list[str]] = {column.name: [] for column in self._named}
        self._rows = TopicRows(f"{bag.path} {topic}", len(self._numbered))

    def add(self, item: Stamped, t_ns: int) -> None:
        """Add the rows of the message ``item`` with the timestamp ``t_ns``."""
        for values in self._fields.rows(item.message, item.row):
            row = dict(zip(self._fields.names, values, strict=True))
            try:
                stamp = self._stamp(row, t_ns, item.row)
                names = {column.name: self._name(column, row, item.row) for column in self._named}
            except InputError as error:
                if self._rules.bad_rows == "refuse":
                    raise InputError(f"{error}{self._rules.skipping}") from error
                self._unread.append((item.row, str(error)))
                continue
            for name, text in names.items():
                self._names[name].append(text)
            self._rows.append(item, stamp, [row.get(name, math.nan) for name in self._numbered])

    def _stamp(self, values: Mapping[Any, Any], t_ns: int, row: int) -> int:
        """Return the timestamp [ns] of a row. ``values``: its values by field. ``t_ns``: the timestamp of its message."""
        return t_ns

    def _name(self, column: Column, values: Mapping[Any, Any], row: int) -> str:
        """Return the name in ``column`` of a row with these ``values`` by field. Raises InputError if the name is empty.

        ``row``: the number of the message."""
        if text := as_text(values[column.name]):
            return text
        raise bad_field(self._rows.source, column.name, text, column.doc, row=row)

    def rows_of(self, warnings: list[Notice], faults: Sequence[Fault] = ()) -> tuple[TableRows, Integers]:
        """Return the M valid rows, and their indices (M,) among all collected rows.

        ``faults``: invalid cells that the caller has detected, in addition to values that are missing or out of bounds.
        Raises InputError at an invalid row, unless ``rules`` skip it. Then a warning is appended to ``warnings``.
        """
        cells = {**self._names, **dict(zip(self._numbered, self._rows.values.T, strict=True))}
        cells |= {STAMP.name: self._rows.t_ns, INDEX: np.arange(len(self._rows))}
        source, unread = Path(self._rows.source), tuple(self._unread)
        read = Cells(source, self._rows.rows, cells, units=self._units, rules=self._rules, unread=unread)
        columns = {column.name: column for column in (STAMP, *self._columns)}
        if self._rules.bad_rows == "refuse":
            read.require(faults)
        read = read.usable(columns, warnings, more=faults)
        return TableRows.of(read, self._columns, read.nanoseconds()), np.asarray(read.columns[INDEX])

    def stream(self, reading: Reading) -> Stream:
        """Return the valid rows as the measurements of a sensor, with times [s] since ``reading.t0_ns``.

        ``reading.warnings`` receives warnings. Raises InputError at an invalid row.
        """
        channel, _ = native_tables()[self._table.name]
        if channel.assemble:
            rows = {self._table.name: self.rows_of(reading.warnings)[0]}
            return assemble(channel, rows, reading)
        return stream_of(self._table, self.rows_of(reading.warnings)[0], reading.t0_ns, reading.warnings)


class RfidTopic(RowTopic, ReadNames):
    """The settings of a topic of RFID reads."""

    fields: dict[ReadField, str]
    """paths of the EPC, the antenna and other values in a message"""
    units: dict[Literal["rssi", "phase", "frequency", "stamp"], str | float] = Field(default_factory=dict)
    """units of rssi, phase, frequency and stamp, or factors that convert to dBm, rad, Hz and us, the default units"""
    frames: dict[str, str] = Field(default_factory=dict)
    """frame in tf_static of each antenna that is not named like its frame"""
    rounds: Literal["gaps", "message"] = "gaps"
    """message if a message has the reads of one inventory round, gaps if rounds are separated by round_gap"""
    round_gap: Annotated[float, Field(gt=0.0, le=10.0), InUnit("s")] = 0.05
    """gap between reads that ends an inventory round"""


class Reads(RowsOfTopic):
    """Collects the RFID reads of a topic."""

    def __init__(self, bag: Bag, options: RfidTopic) -> None:
        self._options = options
        source = f"{bag.path} {options.topic}"
        if "epc" not in options.fields:
            raise InputError(f"{source}: fields.epc is missing")
        if ("antenna" in options.fields) == (options.antenna is not None):
            raise InputError(
                f"{source}: needs either fields.antenna, or antenna, the name of the only antenna: set one of the two"
            )
        super().__init__(bag, options.topic, options.fields, RFID, READ, options.units, options)
        self._stamp_unit = round(STAMP_OF_READ.in_unit(options.units.get("stamp", "us"), source)[1])
        self._antenna_of_message = None  # extracts the antenna name of a message without reads
        if options.antenna is None and LIST not in options.fields["antenna"]:
            self._antenna_of_message = Fields(bag, bag.topic(options.topic), {"antenna": options.fields["antenna"]})
        self._number: list[int] = []  # the index of the round of each read
        self._rounds: list[tuple[int, slice, str]] = []  # timestamp of the message [ns], rows of its reads, antenna

    def add(self, item: Stamped, t_ns: int) -> None:
        """Add the reads of a message, and its inventory rounds if the option ``rounds`` is "message"."""
        first = len(self._rows)
        super().add(item, t_ns)
        if self._options.rounds == "message":
            self._add_rounds(item, t_ns, slice(first, len(self._rows)))

    def _add_rounds(self, item: Stamped, t_ns: int, reads: slice) -> None:
        """Add the inventory rounds of a message, one for each antenna. ``reads``: the rows of the reads of the message.

        A message without reads is one round of the antenna that the message or the options name."""
        of_reads = self._names["antenna"][reads]
        antennas = list(dict.fromkeys(of_reads))
        if not antennas and self._options.antenna:
            antennas = [self._options.antenna]
        elif not antennas and self._antenna_of_message is not None:
            values = {"antenna": self._antenna_of_message.rows(item.message, item.row)[0][0]}
            antennas = [self._name(RFID["antenna"], values, item.row)]
        numbers = {name: len(self._rounds) + i for i, name in enumerate(antennas)}
        self._number += [numbers[name] for name in of_reads]
        self._rounds += [(t_ns, reads, name) for name in antennas]

    def stream(self, reading: Reading) -> RfidStream:
        """Return all RFID reads, grouped into inventory rounds, with times [s] since ``reading.t0_ns``.

        ``reading.warnings`` receives warnings. Raises InputError with the number of an invalid message.
        """
        all_ns = self._rows.t_ns
        table, which = self.rows_of(reading.warnings)
        table = replace(table, names=table.names | {"epc": in_case(table.names["epc"], self._options.epc_case)})
        if self._options.rounds == "gaps":
            return native_rfid.read_rounds(table, None, self._options.round_gap, reading.warnings).stream(reading.t0_ns)
        ends = [max([t_ns, *all_ns[reads].tolist()]) for t_ns, reads, _ in self._rounds]
        number, end_ns = (np.array(column, dtype=np.int64) for column in (self._number, ends))
        number = number[which]
        signals = (table.numbers["rssi"], table.numbers["phase"], table.numbers["frequency"])
        antennas = [antenna for *_, antenna in self._rounds]
        reads = native_rfid.ReadsByRound(table.t_ns, number, table.names["epc"], signals, end_ns, antennas)
        return reads.stream(reading.t0_ns)

    def _stamp(self, values: Mapping[Any, Any], t_ns: int, row: int) -> int:
        if "stamp" not in values:
            return t_ns
        try:
            stamp = as_nanoseconds(values["stamp"], self._stamp_unit)
            if abs(stamp) > LATEST:
                raise OverflowError
            return stamp
        except (ValueError, OverflowError):
            raise bad_field(self._rows.source, "stamp", values["stamp"], "a time, or a number", row=row) from None

    def _name(self, column: Column, values: Mapping[Any, Any], row: int) -> str:
        if column.name != "antenna":
            return super()._name(column, values, row)
        if self._options.antenna is not None:
            return self._options.antenna
        name = super()._name(column, values, row)
        return self._options.antennas.get(name, name)


class LandmarkTopic(RowTopic, Turned):
    """The settings of a topic with observations of landmarks, such as the topic of a marker detector."""

    fields: dict[LandmarkField, str] | None = None
    """paths of the landmark's name, and of its range and bearing, or of its position x, y, z in the sensor frame; not
    needed for the messages of common marker detectors"""
    axes: Axes = "optical"
    """axes of the sensor that point forward, left and up: body (x, y, z), optical (z, -x, -y), or a list of three axes"""
    frame: str | None = None
    """frame of the sensor in tf_static, which gives its pose; if tf_static lacks it, use axes and mounting instead"""


class Landmarks(RowsOfTopic):
    """Collects the ranges and bearings of landmarks from a topic, or computes them from positions of landmarks."""

    def __init__(self, bag: Bag, options: LandmarkTopic, frames: StaticFrames) -> None:
        topic = bag.topic(options.topic)
        self._options, self._frames = options, frames
        fields: dict[Any, str] = dict(options.fields or {})
        if not fields:
            if topic.type not in DETECTIONS:
                known = ", ".join(DETECTIONS)
                raise InputError(
                    f"{bag.path}: topic {topic.name} is of type {topic.type}: set fields in its options, or use a type {known}"
                )
            name, place = DETECTIONS[topic.type]
            fields = {"landmark": name} | {axis: f"{place}.{axis}" for axis in "xyz"}
        self._places = "x" in fields
        wanted = {"landmark", "x", "y", "z"} if self._places else {"landmark", "range", "bearing"}
        if "landmark" not in fields or not set(fields) <= wanted or len(fields) < (4 if self._places else 2):
            expected = "landmark with x, y and z, or with range, bearing or both"
            raise InputError(f"{bag.path} {topic.name}: fields are {listed(fields)}, expected {expected}")
        columns = (BEARING_RANGE["landmark"], *PLACES) if self._places else None
        super().__init__(bag, options.topic, fields, BEARING_RANGE, columns, rules=options)

    def rows_of(self, warnings: list[Notice], faults: Sequence[Fault] = ()) -> tuple[TableRows, Integers]:
        """Return M rows with ranges along the floor [m] and bearings [rad] of landmarks, and their indices (M,).

        The indices count all collected rows. Ranges and bearings computed from positions are in the robot frame if
        ``tf_static`` has the frame of the sensor. ``faults``: invalid cells that the caller has detected. If rows are
        skipped, a warning is appended to ``warnings``.
        """
        places = self._rows.values
        more = checks.not_finite("xyz", places) if self._places else ()
        rows, which = super().rows_of(warnings, [*faults, *more])
        if not self._places:
            return rows, which
        places = places[which]
        pose = np.eye(4)
        if self._options.frame is not None:
            pose = self._frames.known(self._rows.source, self._options.frame)
        else:
            pose[:3, :3] = self._options.turned()
        x, y, _ = (places @ pose[:3, :3].T + pose[:3, 3]).T
        return replace(rows, numbers={"range": np.hypot(x, y), "bearing": np.arctan2(y, x)}), which


class Corners(RowsOfTopic):
    """Collects the corners [px] of detected AprilTags. Each corner is an observation of a named point of the map.

    The names are ``FAMILY-NUMBER/0`` to ``FAMILY-NUMBER/3``, see :func:`factorgraph_loc.maps.markers.corner_names`.
    """

    def __init__(self, bag: Bag, options: TableTopic) -> None:
        name = options.topic
        topic = bag.topic(name, CORNERS)
        known = leaves(bag.store(name), topic.type)
        if lacking := [path for path in CORNER_FIELDS if path not in known]:
            raise InputError(f"{bag.path}: topic {name} ({topic.type}) lacks the fields {listed(lacking)}")
        super().__init__(bag, name, {}, SIGHTINGS, rules=options)

    def add(self, item: Stamped, t_ns: int) -> None:
        """Add the four corners of each detection of a message."""
        for detection in item.message.detections:
            names = corner_names(f"{detection.family}-{detection.id}")
            # apriltag starts at the lower left corner and continues with the lower right one
            for name, corner in zip(reversed(names), detection.corners, strict=True):
                self._names["landmark"].append(name)
                self._rows.append(item, t_ns, (corner.x, corner.y))


def rows_of_table(bag: Bag, options: TableTopic, tables: Sequence[Table]) -> RowsOfTopic:
    """Return a collector of the measurements of a sensor from a topic. ``options``: the topic and its message fields.

    ``tables``: the possible kinds of rows. The first that has default fields for the message type is used, or else
    ``tables[0]``. Corners of AprilTags need no fields. Raises InputError if the fields do not fit the table.
    """
    kind = bag.topic(options.topic).type
    if tables[0].name == SIGHTINGS.name and not options.fields and kind == CORNERS:
        return Corners(bag, options)
    table = next((table for table in tables if kind in table.messages), tables[0])
    columns = {column.name: column for column in table.columns[1:]}
    fields = options.fields or table.messages.get(kind) or {name: name for name in columns}
    needed = {name for name, column in columns.items() if not column.may_lack}
    if not needed <= set(fields) <= set(columns):
        raise InputError(f"{bag.path} {options.topic}: fields are {listed(fields)}, expected {listed(columns)}")
    return RowsOfTopic(bag, options.topic, fields, table, units=options.units, rules=options)
