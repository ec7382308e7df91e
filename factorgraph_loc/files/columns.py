"""Descriptions of the tables of sensors: columns with unit, bounds and meaning, used for all input of measurements.

Bounds are wide enough for any real recording and narrow enough to avoid overflow. A value outside has a wrong unit or
is damaged. Readers of logs and :class:`~factorgraph_loc.live.localizer.Localizer` reject such values.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError, bad_field, require
from factorgraph_loc.files.models import FARTHEST
from factorgraph_loc.files.settings import bound_text
from factorgraph_loc.plugins import Place
from factorgraph_loc.text import quoted
from factors.se2 import Array, Integers

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
LEAST_UNIT = 1e-12  # minimum factor from a unit of a file to ``Column.unit``; the maximum is its reciprocal

LATEST = 4_600_000_000_000_000_000  # ns, 145 years: differences of two timestamps fit into 64 bits
MAX_SPAN = 30 * 86_400.0  # s; maximum time between two timestamps of one log
FASTEST = 100.0  # m/s; most speeds that are in mm/s by mistake exceed this bound
FASTEST_TURN = 100.0  # rad/s: gyros measure up to 70
LONGEST_WAY, MOST_TURNED = 1000.0, 100.0  # m, rad; maximum motion between two rows of odometry, also after a pause
NEAREST, LONGEST_RANGE = 1e-3, 1e5  # m; bounds of measured ranges
FULL_TURN = 2.0 * math.pi
LARGEST_PIXEL = 1e5  # px; bound of pixel coordinates

UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # entries on and above the diagonal
# columns of tables: entries of a covariance of (x, y, heading)
COVARIANCES = dict(zip(("cov_xx", "cov_xy", "cov_xh", "cov_yy", "cov_yh", "cov_hh"), UPPER, strict=True))


def symmetric(upper: Sequence[Array]) -> Array:
    """Return symmetric matrices (N, 3, 3). ``upper``: their entries xx, xy, xz, yy, yz, zz, each an array (N,)."""
    full = np.empty((len(upper[0]), 3, 3))
    for values, (i, j) in zip(upper, UPPER, strict=True):
        full[:, i, j] = full[:, j, i] = values
    return full


@dataclass(frozen=True)
class Column:
    """Description of a column of a table.

    ``units``: the units that a file may use, with the factors that convert values to the first unit. ``low``, ``high``:
    inclusive bounds of converted values. ``may_lack``: whether a cell may be empty. ``doc``: meaning of the column.
    ``field``: attribute of a ``Stream``, the measurements of a sensor, that has the values; "" if it is ``name``.
    ``left_out_below``: smaller values are treated as empty cells, with a warning.
    """

    name: str
    kind: Literal["stamp", "number", "name", "whole", "file"]
    units: Mapping[str, float]
    low: float
    high: float
    may_lack: bool
    doc: str
    field: str = ""
    left_out_below: float = -math.inf

    @cached_property
    def measured(self) -> Column:
        """The description of the same quantity as an attribute of a ``Stream``.

        Its ``name`` is the name of the attribute. Its lower bound ``low`` is at least ``left_out_below``."""
        return replace(self, name=self.field or self.name, low=max(self.low, self.left_out_below))

    @property
    def unit(self) -> str:
        """The unit of values after conversion, "" for dimensionless numbers and names."""
        return "" if self.units is PURE else next(iter(self.units), "")

    @property
    def values(self) -> str:
        """The valid values as a short text, such as ``-200 to 200 dBm, or empty``."""
        between = f"{bound_text(self.low)} to {bound_text(self.high)} {self.unit}".strip() if self.units else "text"
        return between + (", or empty" if self.may_lack else "")

    @property
    def expected(self) -> str:
        """The valid values as a text for error messages."""
        if self.kind in ("name", "file"):
            return self.doc
        what = "a whole number" if self.kind in ("whole", "stamp") else "a finite number"
        unit = next(iter(self.units), "1")
        of = {"rad": " of radians, not degrees,", "ns": " of nanoseconds", "s": " of seconds", "1": ""}.get(
            unit, f" of {unit}"
        )
        return f"{what}{of} in {self.low:.6g} to {self.high:.6g}"

    def in_unit(self, unit: str | float, source: object = "") -> tuple[Column, float]:
        """Return the column with bounds in another unit, and the factor that converts from that unit to :attr:`unit`.

        ``unit``: a name in ``units``, or the factor. Raises InputError with the file ``source`` if the unit is unknown.
        """
        factor = self.units.get(unit, 0.0) if isinstance(unit, str) else float(unit)
        if not LEAST_UNIT <= abs(factor) <= 1.0 / LEAST_UNIT:
            expected = (
                f"one of {', '.join(self.units)}, or its size in {next(iter(self.units))}, at least {LEAST_UNIT:g}"
            )
            raise InputError(f"{source}: the unit of {self.name} is {quoted(unit)}, expected {expected}")
        name = unit if isinstance(unit, str) else f"{factor:g} {next(iter(self.units))}"
        low, high = sorted((self.low / factor, self.high / factor))
        return (self if factor == 1.0 else replace(self, units={name: 1.0}, low=low, high=high)), factor

    def outside(self, values: Array | Integers) -> NDArray[np.bool_]:
        """Return a mask of the invalid ``values``, which are in :attr:`unit`. NaN is invalid unless ``may_lack`` is
        set."""
        bad = ~((values >= self.low) & (values <= self.high))
        if self.kind == "whole":
            bad |= values != np.floor(values)
        return np.asarray(bad & ~np.isnan(values) if self.may_lack else bad)

    def require(
        self, source: object, rows: Sequence[int] | Integers, values: Array | Integers, name: str | None = None
    ) -> None:
        """Raise InputError if any of the ``values`` (N,) is invalid. The message names the first one.

        ``rows`` (N,): row numbers in the file ``source``. ``values`` are given in :attr:`unit`, which may differ from
        the unit in the file. ``name``: name of the column in the file, None for ``self.name``.
        """
        expected = self.expected + (", or nothing" if self.may_lack else "")
        require(~self.outside(values), source, rows, name or self.name, values, expected)


@dataclass(frozen=True)
class Table:
    """Description of a table of a sensor.

    ``stream``: import path of the class that contains the parsed table, "" for none.
    ``is_scan``: whether all rows with the same timestamp form one measurement.
    ``optional``: groups of columns. A file must have either all columns of a group or none.
    ``messages``: for each type of ROS message, the path in the message to the value of each column.
    """

    name: str
    columns: tuple[Column, ...]
    stream: Place = ""
    is_scan: bool = False
    optional: tuple[tuple[str, ...], ...] = ()
    messages: Mapping[str, Mapping[str, str]] = field(default_factory=dict)

    def __getitem__(self, name: str) -> Column:
        return next(column for column in self.columns if column.name == name)

    @property
    def header(self) -> str:
        """The names of the columns of a file, with optional groups in brackets: ``epc,x,y[,sigma]``."""
        optional = [f"[,{','.join(group)}]" for group in self.optional]
        return ",".join(column.name for column in self.in_file(())) + "".join(optional)

    def in_file(self, header: Collection[str]) -> tuple[Column, ...]:
        """Return the columns that a file must have. ``header``: the columns that the file has. An optional group is
        required if ``header`` has any of its columns."""
        omitted = {name for group in self.optional if not set(group) & set(header) for name in group}
        return tuple(column for column in self.columns if column.name not in omitted)


def find_outlier(tables: Sequence[Array | Integers], most: float) -> tuple[int, int, float] | None:
    """Return the timestamp that is farthest from the median, as (index of its table, row in the table, median).

    ``tables``: arrays of timestamps. Returns None if no two timestamps differ by more than ``most``, in the same unit.
    """
    stamps = np.sort(np.concatenate(tables))
    if not len(stamps) or stamps[-1] - stamps[0] <= most:
        return None
    middle = stamps[len(stamps) // 2]
    table = int(np.argmax([np.abs(t - middle).max(initial=0) for t in tables]))
    return table, int(np.argmax(np.abs(tables[table] - middle))), middle.item()


def require_span(tables: Sequence[tuple[object, Sequence[int] | Integers, Integers]]) -> None:
    """Raise InputError, at the largest outlier, if timestamps of a log are more than :data:`MAX_SPAN` apart.

    ``tables``: for each table the file, the row numbers (N,) in the file, and the timestamps (N,) [ns].
    """
    if outlier := find_outlier([t_ns for _, _, t_ns in tables], MAX_SPAN * 1e9):
        table, i, middle = outlier
        source, rows, t_ns = tables[table]
        expected = f"one at most {MAX_SPAN / 86_400.0:g} days from all others of the log, most are near {middle} ns"
        raise bad_field(source, "stamp", f"{int(t_ns[i])} ns", expected, row=int(rows[i]))


# minimum timestamp since 1970 in each unit, finest unit first; timestamps after 1973 exceed it
SINCE_1970 = {"ns": 1e17, "us": 1e14, "ms": 1e11, "s": 1e8}


def unit_since_1970(stamp: float) -> str | None:
    """Return the unit of a timestamp since 1970, guessed from its size, or None if it is too small for any unit."""
    return next((unit for unit, least in SINCE_1970.items() if abs(stamp) > least), None)


def number(
    name: str,
    units: Mapping[str, float],
    low: float,
    high: float,
    doc: str,
    *,
    may_lack: bool = False,
    left_out_below: float = -math.inf,
) -> Column:
    """Return the :class:`Column` ``name`` of numbers. ``units``: {unit: factor that converts it to the first unit}.

    ``low``, ``high``: inclusive bounds. ``doc``: its meaning. ``may_lack``: True if a cell may be empty. Values below
    ``left_out_below`` are treated as empty cells."""
    return Column(name, "number", units, low, high, may_lack, doc, left_out_below=left_out_below)


def within(name: str, units: Mapping[str, float], most: float, doc: str) -> Column:
    """Return the :class:`Column` ``name`` of numbers from ``-most`` to ``most``. ``doc``: its meaning.

    ``units``: {unit: factor that converts it to the first unit}."""
    return number(name, units, -most, most, doc)


def named(name: str, doc: str, kind: Literal["name", "file"] = "name", *, field: str = "") -> Column:
    """Return the :class:`Column` ``name`` of names, or of paths if ``kind`` is "file". ``doc``: its meaning.

    ``field``: the attribute of a ``Stream`` with its values, by default ``name``."""
    return Column(name, kind, {}, 0.0, math.inf, False, doc, field)


STAMP = Column("t_ns", "stamp", STAMPS, -LATEST, LATEST, False, "time of the measurement, by the sensor's clock")
SECONDS = replace(STAMP.in_unit("s")[0], name="t", kind="number")
POSES = Table(
    "poses",
    (
        STAMP,
        *(
            within(name, LENGTH, FARTHEST, "position; that of odometry is in the frame of the odometry")
            for name in "xyz"
        ),
        *(within(name, PURE, 1e3, "component of a quaternion of length 1") for name in ("qx", "qy", "qz", "qw")),
        within("heading", ANGLE, 1e5, "direction of the robot's x axis, or accumulated rotation"),
    ),
)
POINTS = Table(
    "points",
    (
        named("point", "the name of a point"),
        *(within(name, LENGTH, FARTHEST, "position in the world") for name in "xyz"),
        *(
            within(name, {"m^2": 1.0}, 1e8, "entry of the covariance of the position")
            for name in ("xx", "xy", "xz", "yy", "yz", "zz")
        ),
        *(within(f"from_{name}", LENGTH, FARTHEST, "position of the camera of a view") for name in "xyz"),
        *(
            within(
                f"cov_{name}", {unit: 1.0}, 1e8, "entry of the covariance of an error that all points of a view share"
            )
            for name, unit in zip(
                ("xx", "xy", "yy", "xh", "yh", "hh"), 3 * ["m^2"] + 2 * ["m rad"] + ["rad^2"], strict=True
            )
        ),
    ),
)
