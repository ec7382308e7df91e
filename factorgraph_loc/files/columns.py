"""What the tables of sensors hold: each column's unit, bounds, and what it is. Whatever takes measurements in goes by this.

Bounds are wide enough for any real recording and narrow enough that nothing within them overflows: what lies outside has another
unit, or is garbage. Readers and :class:`~factorgraph_loc.live.localizer.Localizer` refuse it in one line.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import bad_field
from factorgraph_loc.files.models import FARTHEST
from factors.se2 import Array

Integers = NDArray[np.int64]

LENGTH = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048, "in": 0.0254}
SPEED = {"m/s": 1.0, "cm/s": 0.01, "mm/s": 0.001, "km/h": 1.0 / 3.6, "ft/s": 0.3048}
ANGLE = {"rad": 1.0, "deg": math.pi / 180.0, "turn/4096": 2.0 * math.pi / 4096.0}
RATE = {"rad/s": 1.0, "deg/s": math.pi / 180.0, "rpm": 2.0 * math.pi / 60.0}
POWER = {"dBm": 1.0, "cdBm": 0.01}
FREQUENCY = {"Hz": 1.0, "kHz": 1e3, "MHz": 1e6}
DURATION = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
STAMPS = {"ns": 1.0, "us": 1e3, "ms": 1e6, "s": 1e9}
PIXELS = {"px": 1.0}
PURE = {"1": 1.0}

LATEST = 4_600_000_000_000_000_000  # ns, 145 years: a difference of two stamps has room in 64 bits
MAX_SPAN = 30 * 86_400.0  # s between two stamps of one log
FASTEST = 100.0  # m/s: a speed in mm/s is mostly above it
FASTEST_TURN = 100.0  # rad/s: gyros measure up to 70
LONGEST_WAY, MOST_TURNED = 1000.0, 100.0  # m and rad from one row to the next, a pause included
NEAREST, LONGEST_RANGE = 1e-3, 1e5  # m
FULL_TURN = 2.0 * math.pi
LARGEST_PIXEL = 1e5  # px


@dataclass(frozen=True)
class Column:
    """A column of a table. ``units``: by name, what to multiply with; the first is ours, in which ``low`` and ``high`` are, both
    included. ``may_lack``: whether a cell may be empty. ``doc``: what it is."""

    name: str
    kind: Literal["stamp", "number", "name", "whole", "file"]
    units: Mapping[str, float]
    low: float
    high: float
    may_lack: bool
    doc: str

    @property
    def expected(self) -> str:
        """What a value must be, as an error says it."""
        if self.kind in ("name", "file"):
            return self.doc
        what = "a whole number" if self.kind in ("whole", "stamp") else "a finite number"
        unit = next(iter(self.units), "1")
        of = {"rad": " of radians, not degrees,", "ns": " of nanoseconds", "s": " of seconds", "1": ""}.get(
            unit, f" of {unit}"
        )
        return f"{what}{of} in {self.low:.6g} to {self.high:.6g}"

    def in_unit(self, unit: str | float) -> tuple[Column, float]:
        """The same column in one of its units, or in one that is so many of ours; and what to multiply with. KeyError if it has
        no such unit."""
        factor = self.units[unit] if isinstance(unit, str) else unit
        name = unit if isinstance(unit, str) else f"{factor:g} {next(iter(self.units))}"
        low, high = sorted((self.low / factor, self.high / factor))
        return (self if factor == 1.0 else replace(self, units={name: 1.0}, low=low, high=high)), factor

    def outside(self, values: Array | Integers) -> NDArray[np.bool_]:
        """Which of ``values``, in our unit, cannot be; NaN cannot where no value may lack."""
        bad = ~((values >= self.low) & (values <= self.high))
        if self.kind == "whole":
            bad |= values != np.floor(values)
        return np.asarray(bad & ~np.isnan(values) if self.may_lack else bad)

    def require(
        self, source: object, rows: Sequence[int] | Integers, values: Array | Integers, name: str | None = None
    ) -> None:
        """InputError at the first of ``values`` (N,), in our unit, that cannot be; ``rows`` (N,): where they stand in ``source``;
        ``name``: the column's there."""
        bad = self.outside(values)
        if bad.any():
            i = int(np.argmax(bad))
            expected = self.expected + (", or nothing" if self.may_lack else "")
            raise bad_field(source, name or self.name, values[i].item(), expected, row=int(rows[i]))


@dataclass(frozen=True)
class Table:
    """A table of a sensor. ``rows_of_one_stamp``: whether they are one measurement together, or one each."""

    name: str
    columns: tuple[Column, ...]
    rows_of_one_stamp: Literal["one measurement", "one each"]

    def __getitem__(self, name: str) -> Column:
        return next(column for column in self.columns if column.name == name)


def require_span(tables: Iterable[tuple[object, Sequence[int] | Integers | None, Integers]]) -> None:
    """InputError if stamps of tables, (source, rows (N,) or None, stamps (N,) [ns]), lie more than :data:`MAX_SPAN` apart: it names
    that which is farthest from the middle one of all."""
    filled = [(source, rows, t_ns) for source, rows, t_ns in tables if len(t_ns)]
    first, last = min(int(t.min()) for _, _, t in filled), max(int(t.max()) for _, _, t in filled)
    if last - first <= MAX_SPAN * 1e9:
        return
    stamps = np.concatenate([t_ns for _, _, t_ns in filled])
    middle = int(np.sort(stamps)[len(stamps) // 2])
    far = [np.abs(t_ns - middle) for _, _, t_ns in filled]
    source, rows, t_ns = filled[int(np.argmax([distances.max() for distances in far]))]
    i = int(np.argmax(np.abs(t_ns - middle)))
    expected = f"one at most {MAX_SPAN / 86_400.0:g} days from all others of the log, most are near {middle} ns"
    raise bad_field(source, "stamp", f"{int(t_ns[i])} ns", expected, row=int(rows[i]) if rows is not None else None)


def _number(
    name: str, units: Mapping[str, float], low: float, high: float, doc: str, *, may_lack: bool = False
) -> Column:
    return Column(name, "number", units, low, high, may_lack, doc)


def _within(name: str, units: Mapping[str, float], most: float, doc: str) -> Column:
    return _number(name, units, -most, most, doc)


def _name(name: str, doc: str, kind: Literal["name", "file"] = "name") -> Column:
    return Column(name, kind, {}, 0.0, math.inf, False, doc)


STAMP = Column("t_ns", "stamp", STAMPS, -LATEST, LATEST, False, "when it was, by the sensor's clock")
SECONDS = replace(STAMP.in_unit("s")[0], name="t", kind="number")
LANDMARK = _name("landmark", "the name of a landmark")
ANTENNA = _name("antenna", "the name of an antenna")

VELOCITIES = Table(
    "odometry",
    (
        STAMP,
        _within("v", SPEED, FASTEST, "forward speed, held until the next row"),
        _within("w", RATE, FASTEST_TURN, "turn rate, held until the next row"),
    ),
    "one each",
)
INCREMENTS = Table(
    "odometry",
    (
        STAMP,
        _within("dx", LENGTH, LONGEST_WAY, "way ahead since the row before"),
        _within("dy", LENGTH, LONGEST_WAY, "way to the left since the row before"),
        _within("dtheta", ANGLE, MOST_TURNED, "turn since the row before"),
    ),
    "one each",
)
IMU = Table("imu", (STAMP, _within("w", RATE, FASTEST_TURN, "turn rate of a gyro")), "one each")
TWIST = Table(
    "twist",
    (
        STAMP,
        _within("v", SPEED, FASTEST, "speed along each axis of the robot"),
        _within("w", RATE, FASTEST_TURN, "turn rate about each axis of the robot"),
    ),
    "one each",
)
BEARING_RANGE = Table(
    "bearing_range",
    (
        STAMP,
        LANDMARK,
        _number("range", LENGTH, -LONGEST_RANGE, LONGEST_RANGE, "distance; below 0.001 it is left out", may_lack=True),
        _number("bearing", ANGLE, -FULL_TURN, FULL_TURN, "direction in the sensor's frame", may_lack=True),
    ),
    "one measurement",
)
# radios that got no answer say 0, and gross errors may lie below: no measurement then
MEASURED_RANGE = replace(BEARING_RANGE["range"], low=NEAREST)
AGE = _number("age", DURATION, 0.0, 3600.0, "how long before the end of its round a tag was read")
RFID = Table(
    "rfid",
    (
        STAMP,
        ANTENNA,
        _name("epc", "the EPC of a tag"),
        _number("rssi", POWER, -200.0, 200.0, "strength of the answer, by the reader's own zero", may_lack=True),
        _number("phase", ANGLE, -FULL_TURN, FULL_TURN, "phase as the reader reports it", may_lack=True),
        _number("frequency", FREQUENCY, 1e8, 1e10, "of the carrier", may_lack=True),
        Column("inventory", "whole", PURE, 1.0, 2.0**53, False, "the row of the round in inventories"),
    ),
    "one measurement",
)
INVENTORIES = Table(
    "inventories",
    (STAMP, ANTENNA, _number("duration", DURATION, 0.0, 3600.0, "how long the round lasted, which ends at the stamp")),
    "one measurement",
)
CAMERA = Table("camera", (STAMP, _name("file", "the name of an image", "file")), "one each")
SIGHTINGS = Table(
    "sightings",
    (
        STAMP,
        LANDMARK,
        _within("u", PIXELS, LARGEST_PIXEL, "to the right; beside the image too"),
        _within("v", PIXELS, LARGEST_PIXEL, "down"),
    ),
    "one measurement",
)
FEATURES = Table(
    "features",
    (
        STAMP,
        _within("pixels", PIXELS, LARGEST_PIXEL, "where it was found"),
        _number("sizes", PIXELS, 1e-3, LARGEST_PIXEL, "how large it is"),
        _within("descriptors", PURE, 1e6, "what it looks like"),
        Column("tracks", "whole", PURE, -(2.0**53), 2.0**53, False, "number that stays with what is followed"),
    ),
    "one measurement",
)
WAYS = Table(
    "odometry",
    (
        STAMP,
        *(_within(side, LENGTH, 1e9, "way of that wheel so far; counters hold 32 bits") for side in ("left", "right")),
    ),
    "one each",
)
POSES = Table(
    "poses",
    (
        STAMP,
        *(_within(name, LENGTH, FARTHEST, "position; of odometry in a frame of its own") for name in "xyz"),
        *(_within(name, PURE, 1e3, "of a quaternion, whose length must be 1") for name in ("qx", "qy", "qz", "qw")),
        _within("heading", ANGLE, 1e5, "direction of the robot's x axis, or the sum of its turns"),
    ),
    "one each",
)
TAGS = Table(
    "tags",
    (
        _name("epc", "the EPC of a tag"),
        _within("x", LENGTH, FARTHEST, "position in the frame of the survey"),
        _within("y", LENGTH, FARTHEST, "position in the frame of the survey"),
        _number("z", LENGTH, -FARTHEST, FARTHEST, "height; 0 where it is empty", may_lack=True),
        _number("facing", ANGLE, -FULL_TURN, FULL_TURN, "direction that its front faces", may_lack=True),
        _number("sigma", LENGTH, 0.0, 100.0, "standard deviation of its survey in x and y", may_lack=True),
    ),
    "one each",
)
POINTS = Table(
    "points",
    (
        _name("point", "the name of a point"),
        *(_within(name, LENGTH, FARTHEST, "position in the world") for name in "xyz"),
        *(_within(name, {"m^2": 1.0}, 1e8, "of its covariance") for name in ("xx", "xy", "xz", "yy", "yz", "zz")),
        *(_within(f"from_{name}", LENGTH, FARTHEST, "where the camera of a view was") for name in "xyz"),
        _number("size", PIXELS, 1e-3, LARGEST_PIXEL, "of the feature in that view"),
    ),
    "one each",
)
TABLES = (
    VELOCITIES,
    INCREMENTS,
    IMU,
    TWIST,
    BEARING_RANGE,
    RFID,
    INVENTORIES,
    CAMERA,
    SIGHTINGS,
    FEATURES,
    WAYS,
    POSES,
    TAGS,
    POINTS,
)
