"""The interface of measurements, and the rows of one sensor of a log.

Measurements are frozen values in SI units, with timestamps in seconds from the start of the log.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields, replace
from functools import partial
from itertools import compress, pairwise
from typing import Any, ClassVar, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.sections import kind_of
from factors.se2 import Array

GOING_BACK = 5.0  # s that an estimator goes back in time, at most, to process a late measurement
FLOOR, TURN, EXTEROCEPTIVE = 0, 1, 2  # ranks of streams: motion on the floor, rotation only, exteroceptive measurements


class Measurement(Protocol):
    """A measurement at ``t`` [s], the time of the event with the clock offset applied.

    ``sensor``: its channel, as in a log and in ``--sensors``. ``modality``: the kind of sensor; estimators
    declare the modalities that they use. ``source``: the name of the sensor, by default its modality. ``count``: number of
    detections. ``is_motion``: whether it measures the robot's motion.
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
    """The channel of a measurement in a log: its source if it comes from one of several sensors of a kind."""
    return m.source if kind_of(m.source) == m.sensor else m.sensor


def named(m: Measurement) -> str:
    """The measurement in an error: ``BearingRange at 1.500 s``."""
    return f"{type(m).__name__} at {m.t:.3f} s"


@dataclass(frozen=True, slots=True)
class Tick:
    """A time at which the causal trajectory is evaluated."""

    sensor: ClassVar[str] = "tick"
    modality: ClassVar[str] = "tick"
    source: ClassVar[str] = "tick"
    count: ClassVar[int] = 0
    is_motion: ClassVar[bool] = False
    t: float


@dataclass(frozen=True, slots=True)
class Rows:
    """Successive measurements of one ``kind`` as one, with the time of the last.

    ``times`` (N,) [s]; ``values``: an array (N,) of each field.
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
        """Those from ``first`` to before ``last``."""
        return Rows(self.kind, self.times[first:last], tuple([values[first:last] for values in self.values]))


@dataclass(frozen=True)
class Stream:
    """The rows of one channel as columns; ``t`` (N,) in seconds from the start of the log, by the sensor's clock.

    Rows are in order of arrival; a late row has an older timestamp than the one before. ``rank`` orders rows with equal
    timestamps. ``kind``: class of the measurements, constructed from a timestamp and the columns. ``source``: the name of the
    sensor, "" for its modality. ``joins``: whether consecutive rows, of numbers, can be one measurement
    (:class:`~factorgraph_loc.model.measurement.Rows`).
    """

    rank: ClassVar[int] = EXTEROCEPTIVE
    joins: ClassVar[bool] = False
    kind: ClassVar[type[Any]]
    t: Array
    source: str = field(default="", kw_only=True)

    def measurements(self, offset: float) -> Iterator[Measurement]:
        """One measurement per row; ``offset`` [s] is added to the timestamps."""
        return map(self._made, (self.t + offset).tolist(), *(np.asarray(column).tolist() for column in self._columns()))

    def rows(self, offset: float) -> Rows:
        """All rows as one measurement, if the stream ``joins``."""
        return Rows(self.kind, self.t + offset, tuple(np.array(column, dtype=float) for column in self._columns()))

    @property
    def _made(self) -> Callable[..., Measurement]:
        """Makes a measurement of a timestamp and the columns."""
        make: Callable[..., Measurement] = self.kind
        return partial(make, source=self.source) if self.source else make

    def _columns(self) -> Iterator[Any]:
        return (column for name, column in columns_of(self).items() if name != "t")

    def begun_anew(self) -> Self:
        """The stream of a robot that was placed at its first row, without any motion before it."""
        return self

    def scans(self) -> Iterator[tuple[int, int]]:
        """First and end row of each run of equal timestamps."""
        return pairwise([*np.flatnonzero(np.diff(self.t, prepend=np.nan) != 0.0).tolist(), len(self.t)])


@dataclass(frozen=True)
class ScanStream(Stream):
    """A stream whose rows with one timestamp form one measurement of names (K,) and arrays (K,)."""

    def measurements(self, offset: float) -> Iterator[Measurement]:
        """One measurement per timestamp; ``offset`` [s] is added to the timestamps."""
        for i, j in self.scans():
            parts = (column[i:j] for column in self._columns())
            values = (part if isinstance(part, np.ndarray) else tuple(part) for part in parts)
            yield self._made(float(self.t[i]) + offset, *values)


def of_sensor(stream: Stream, name: str) -> Stream:
    """The stream of a channel; the ``name`` of one of several sensors of a kind is its source."""
    return stream if kind_of(name) == name else replace(stream, source=name)


def columns_of(stream: Stream) -> dict[str, Any]:
    """The columns of a stream by name, the timestamps first."""
    return {f.name: getattr(stream, f.name) for f in fields(stream) if f.name != "source"}


def selected(stream: Stream, keep: NDArray[np.bool_]) -> Stream:
    kept: dict[str, Any] = {
        k: v[keep] if isinstance(v, np.ndarray) else list(compress(v, keep)) for k, v in columns_of(stream).items()
    }
    return replace(stream, **kept)


def are_alike(first: Stream, second: Stream) -> bool:
    """Whether two streams are of one kind."""
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
