"""The interface of measurements, and streams: all measurements of one sensor in a log.

Measurements are immutable values in SI units, with timestamps in seconds from the start of the log.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields, replace
from functools import partial
from itertools import compress, pairwise
from typing import Any, ClassVar, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.sections import kind_of
from factors.se2 import Array

GOING_BACK = 5.0  # s: maximum delay of a late measurement that an estimator still processes
FLOOR, TURN, EXTEROCEPTIVE = 0, 1, 2  # ranks of streams: motion on the floor, rotation only, exteroceptive measurements


class Measurement(Protocol):
    """A measurement of a sensor.

    ``t``: time of the event [s], with the time offset of the sensor added. ``sensor``: the name of its stream in a log
    and in the option ``--sensors``. ``modality``: the kind of sensor. An estimator uses or ignores all measurements of
    a kind. ``source``: the name of the sensor if there are several of a kind, by default the modality. ``count``:
    number of detections in the measurement. ``is_motion``: True if it measures the robot's motion.
    """

    @property
    def t(self) -> float: ...
    @property
    def sensor(self) -> str: ...
    @property
    def modality(self) -> str: ...
    @property
    def source(self) -> str: ...
    @property
    def count(self) -> int: ...
    @property
    def is_motion(self) -> bool: ...


def channel_of(m: Measurement) -> str:
    """Return the name of a measurement's stream in a log. If there are several sensors of its kind, this is the
    sensor's name."""
    return m.source if kind_of(m.source) == m.sensor else m.sensor


def named(m: Measurement) -> str:
    """Return a name of the measurement ``m`` for error messages, such as ``BearingRange at 1.500 s``."""
    return f"{type(m).__name__} at {m.t:.3f} s"


@dataclass(frozen=True, slots=True)
class Tick:
    """A time ``t`` [s] at which a run records the estimate. Estimators process it like a measurement."""

    sensor: ClassVar[str] = "tick"
    modality: ClassVar[str] = "tick"
    source: ClassVar[str] = "tick"
    count: ClassVar[int] = 0
    is_motion: ClassVar[bool] = False
    t: float


@dataclass(frozen=True, slots=True)
class Rows:
    """N successive measurements of one stream in arrays, which an estimator can process in one call.

    ``kind``: the class of a measurement. ``times`` (N,): their times [s]. ``values``: an array (N,) for each further
    field of ``kind``. The attribute ``t`` is the last of ``times``.
    """

    kind: type[Any]
    times: Array
    values: tuple[Array, ...]

    @property
    def t(self) -> float:
        return float(self.times[-1])

    @property
    def sensor(self) -> str:
        return str(self.kind.sensor)

    @property
    def modality(self) -> str:
        return str(self.kind.modality)

    @property
    def source(self) -> str:
        return str(self.kind.source)

    @property
    def count(self) -> int:
        return len(self.times)

    @property
    def is_motion(self) -> bool:
        return bool(self.kind.is_motion)

    def part(self, first: int, last: int) -> Rows:
        """Return the measurements from index ``first`` to before ``last``."""
        return Rows(self.kind, self.times[first:last], tuple([values[first:last] for values in self.values]))


@dataclass(frozen=True)
class Stream:
    """All measurements of one sensor in a log, stored as columns of N rows. Subclasses add the columns of a sensor.

    Rows are in order of arrival. A late row has an older timestamp than the row before. ``t`` (N,): times from the
    start of the log by the clock of the sensor [s]. ``source``: the name of the sensor if there are several of its
    kind, else "". ``rank``: of measurements with equal timestamps, those of a stream with a lower rank are processed
    first. ``joins``: True if estimators may process several rows in one
    :class:`~factorgraph_loc.model.measurement.Rows` object. ``kind``: the class of a measurement. Its arguments are the
    timestamp and the columns.
    """

    rank: ClassVar[int] = EXTEROCEPTIVE
    joins: ClassVar[bool] = False
    kind: ClassVar[type[Any]]
    t: Array
    source: str = field(default="", kw_only=True)

    def measurements(self, offset: float) -> Iterator[Measurement]:
        """Yield one measurement per row. ``offset`` [s] is added to the timestamps."""
        return map(self._made, (self.t + offset).tolist(), *(np.asarray(column).tolist() for column in self._columns()))

    def rows(self, offset: float) -> Rows:
        """Return all N rows as one :class:`Rows` object of N measurements. ``offset`` [s] is added to the timestamps.
        Call this only if ``joins`` is True, as for odometry."""
        return Rows(self.kind, self.t + offset, tuple(np.array(column, dtype=float) for column in self._columns()))

    @property
    def _made(self) -> Callable[..., Measurement]:
        """The function that makes a measurement from a timestamp and the values of a row."""
        make: Callable[..., Measurement] = self.kind
        return partial(make, source=self.source) if self.source else make

    def _columns(self) -> Iterator[Any]:
        return (column for name, column in columns_of(self).items() if name != "t")

    def without_first_motion(self) -> Self:
        """Return the stream with a motion of zero in its first row. Use it if the robot was carried before that row. A
        stream that does not measure motion is returned unchanged."""
        return self

    def scans(self) -> Iterator[tuple[int, int]]:
        """Yield (begin, end) for each sequence of rows with equal timestamps: the indices of its rows, end excluded."""
        return pairwise([*np.flatnonzero(np.diff(self.t, prepend=np.nan) != 0.0).tolist(), len(self.t)])


@dataclass(frozen=True)
class ScanStream(Stream):
    """A stream with one measurement per group of successive rows with equal timestamps. A measurement's fields are
    arrays with one value per row."""

    def measurements(self, offset: float) -> Iterator[Measurement]:
        """Yield one measurement per timestamp. ``offset`` [s] is added to the timestamps."""
        columns = tuple(self._columns())
        for i, j in self.scans():
            parts = (column[i:j] for column in columns)
            values = (part if isinstance(part, np.ndarray) else tuple(part) for part in parts)
            yield self._made(float(self.t[i]) + offset, *values)


S = TypeVar("S", bound=Stream)


def of_sensor(stream: Stream, name: str) -> Stream:
    """Return the stream with ``name``, the name of its sensor, in the field ``source``. A name without a dot belongs to
    the only sensor of its kind. The stream is then returned unchanged."""
    return stream if kind_of(name) == name else replace(stream, source=name)


def columns_of(stream: Stream) -> dict[str, Any]:
    """Return the columns of a stream by name. The timestamps ``t`` are first."""
    return {f.name: getattr(stream, f.name) for f in fields(stream) if f.name != "source"}


def selected(stream: S, keep: NDArray[np.bool_]) -> S:
    kept: dict[str, Any] = {
        k: v[keep] if isinstance(v, np.ndarray) else list(compress(v, keep)) for k, v in columns_of(stream).items()
    }
    return replace(stream, **kept)


def are_alike(first: Stream, second: Stream) -> bool:
    """Return True if two streams have the same class."""
    return type(first) is type(second)


def joined(first: Stream, second: Stream) -> Stream:
    if not are_alike(first, second):
        kinds = f"{type(first).__name__} and one with {type(second).__name__}"
        raise InputError(f"a log with {kinds} cannot be joined, expected tables of the same kind")
    second_columns = columns_of(second)
    both: dict[str, Any] = {
        k: np.concatenate((v, second_columns[k])) if isinstance(v, np.ndarray) else [*v, *second_columns[k]]
        for k, v in columns_of(first).items()
    }
    return replace(first, **both)
