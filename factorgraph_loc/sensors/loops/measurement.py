"""Measurements of loop closures, their stream, settings and tables.

A table gives the earlier pose of a loop by its age, or by its timestamp.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.columns import (
    ANGLE,
    DURATION,
    FULL_TURN,
    LATEST,
    LENGTH,
    LONGEST_RANGE,
    MAX_SPAN,
    PURE,
    STAMP,
    STAMPS,
    Table,
    number,
)
from factorgraph_loc.files.models import InUnit
from factorgraph_loc.files.values import numbers, within
from factorgraph_loc.model.measurement import ScanStream, Stream
from factorgraph_loc.model.settings import SensorSettings
from factorgraph_loc.sensors.tables import Reading, stream_of
from factors.se2 import Array

if TYPE_CHECKING:
    from factorgraph_loc.files.tables import TableRows


class LoopSettings(SensorSettings):
    """Noise of loop closures that another program has detected. If the rig lacks this section, the defaults apply.

    A loop closure has a score, its confidence from 0 to 1. The standard deviations and ``robust`` apply to the score 1.
    For a score s, the standard deviations are divided by s. The residual [m, rad] above which a loop closure is
    rejected is multiplied by sqrt(s).
    """

    sigma_position: Annotated[float, Field(ge=1e-4, le=10.0), InUnit("m")] = 0.1
    """standard deviation of a relative position, in each coordinate"""
    sigma_heading: Annotated[float, Field(ge=1e-4, le=3.0), InUnit("rad")] = 0.05
    """standard deviation of a relative heading"""
    sigma_place: Annotated[float, Field(ge=1e-3, le=100.0), InUnit("m")] = 0.5
    """standard deviation, in each coordinate, of the distance between the two poses of a loop without a relative pose"""
    least_score: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """loops with a lower score are not used"""
    robust: Annotated[float, Field(ge=0.01, le=100.0)] = 3.0
    """scale of the Geman-McClure loss of a loop of score 1, in standard deviations"""


LEAST_AGE = 1e-6  # s; the earlier pose of a loop must be older by at least this
_TOLD = (
    *(
        number(name, LENGTH, -LONGEST_RANGE, LONGEST_RANGE, "position in the frame of the earlier pose", may_lack=True)
        for name in "xy"
    ),
    number("heading", ANGLE, -FULL_TURN, FULL_TURN, "heading in the frame of the earlier pose", may_lack=True),
    number("score", PURE, 0.0, 1.0, "confidence that the loop is correct; 1 if empty", may_lack=True),
)
_OPTIONAL = (("x", "y", "heading"), ("score",))

LOOPS = Table(
    "loops",
    (STAMP, number("age", DURATION, LEAST_AGE, MAX_SPAN, "time since the earlier pose"), *_TOLD),
    stream="factorgraph_loc.sensors.loops.measurement:LoopStream",
    is_scan=True,
    optional=_OPTIONAL,
)
LOOPS_BY_STAMP = Table(
    "loops",
    (STAMP, number("before_ns", STAMPS, -LATEST, LATEST, "time of the earlier pose, by the same clock"), *_TOLD),
    is_scan=True,
    optional=_OPTIONAL,
)


@dataclass(frozen=True, slots=True)
class Loops:
    """K loop closures at the time ``t`` [s]. Each states that the robot is near an earlier pose.

    ``age`` (K,): the time [s] since the earlier pose. ``x``, ``y`` (K,) [m], ``heading`` (K,) [rad]: the pose at ``t``
    in the frame of the earlier pose, NaN if unknown. ``score`` (K,): confidence from 0 to 1, NaN if unknown.
    """

    sensor: ClassVar[str] = "loops"
    modality: ClassVar[str] = "loops"
    is_motion: ClassVar[bool] = False
    t: float
    age: Array
    x: Array
    y: Array
    heading: Array
    score: Array
    source: str = modality

    @property
    def count(self) -> int:
        """The number K of loop closures."""
        return len(self.age)


@dataclass(frozen=True)
class LoopStream(ScanStream):
    """All N loop closures of a log, one per row. Rows with the same timestamp form one measurement. ``age`` (N,): the
    time [s] since the earlier pose. ``x``, ``y`` (N,) [m], ``heading`` (N,) [rad]: the pose in the frame of the earlier
    pose, NaN if unknown. ``score`` (N,): confidence from 0 to 1, NaN if unknown."""

    kind: ClassVar[type[Any]] = Loops
    age: Array
    x: Array
    y: Array
    heading: Array
    score: Array


POSE = ("x", "y", "heading")


def assemble(rows: Mapping[str, TableRows], reading: Reading) -> Stream:
    """Return the loop closures of a log as a stream. ``rows``: the rows by table name. ``reading``: the time origin,
    and a list to append warnings to. Raises InputError if a relative pose is incomplete, or if the earlier pose of a
    loop closure is not earlier."""
    (table,) = rows.values()
    columns = dict(table.numbers)
    if "before_ns" in columns:
        stamps = columns.pop("before_ns")
        LOOPS_BY_STAMP["before_ns"].require(table.path, table.rows, stamps)
        columns["age"] = (table.t_ns - np.rint(stamps).astype(np.int64)) / 1e9
        if len(bad := np.flatnonzero(columns["age"] < LEAST_AGE)):
            i = int(bad[0])
            expected = f"an earlier time than that of the row, {int(table.t_ns[i])} ns"
            raise bad_field(table.path, "before_ns", f"{stamps[i]:.0f} ns", expected, row=int(table.rows[i]))
    for name in (*POSE, "score"):
        columns.setdefault(name, np.full(len(table.rows), np.nan))
    known = np.isfinite([columns[name] for name in POSE])
    if len(bad := np.flatnonzero(known.any(axis=0) & ~known.all(axis=0))):
        i = int(bad[0])
        lacking = next(name for name in POSE if np.isnan(columns[name][i]))
        raise bad_field(table.path, lacking, "", "x, y and heading, or none of them", row=int(table.rows[i]))
    return stream_of(LOOPS, replace(table, numbers=columns), reading.t0_ns, reading.warnings)


def check(m: Loops, where: str) -> dict[str, Any]:
    """Return the validated fields of ``m`` by name. Raises InputError for the first invalid field. ``where``: the name
    of the measurement in error messages."""
    count = numbers(where, "age", m.age).size
    values = {name: within(where, LOOPS[name], getattr(m, name), (count,)) for name in ("age", *POSE, "score")}
    known = np.isfinite([values[name] for name in POSE])
    if (known.any(axis=0) & ~known.all(axis=0)).any():
        raise InputError(
            f"{where}: the relative pose of a loop is incomplete, expected x, y and heading, or none of them"
        )
    return values
