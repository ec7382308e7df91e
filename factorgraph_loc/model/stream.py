"""The rows of one sensor of a log."""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from itertools import compress, pairwise
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.measurement import Measurement
from factors.se2 import Array

SEEN = 2  # the rank of streams of what is seen; lower ones tell how the robot moves


@dataclass(frozen=True)
class Stream:
    """The rows of one sensor, as columns; ``t`` (N,) in seconds from the log's start, by the sensor's own clock.

    Rows stand in the order in which they arrived; a stamp may be a little older than the one before (a late measurement).
    ``rank``: of rows of one time, those of the stream with the lowest come first: 0 of wheel odometry, 1 of other motion. ``kind``:
    the class of its measurements, made of a stamp and a value of each column.
    """

    rank: ClassVar[int] = SEEN
    kind: ClassVar[type[Any]]
    t: Array

    def measurements(self, offset: float) -> Iterator[Measurement]:
        """What the rows tell, in their order, each a measurement of its own; ``offset`` [s] is added to their stamps."""
        return map(self.kind, (self.t + offset).tolist(), *(np.asarray(column).tolist() for column in self._columns()))

    def _columns(self) -> Iterator[Any]:
        return (getattr(self, field.name) for field in fields(self)[1:])

    def begun_anew(self) -> Self:
        """The same of a robot that was put down at its first row, wherever it was before."""
        return self

    def scans(self) -> Iterator[tuple[int, int]]:
        """The first row of each run of equal stamps, and the one after its last."""
        return pairwise([*np.flatnonzero(np.diff(self.t, prepend=np.nan) != 0.0).tolist(), len(self.t)])


@dataclass(frozen=True)
class ScanStream(Stream):
    """Rows of which those of one stamp are one measurement, made of names (K,) and arrays (K,)."""

    def measurements(self, offset: float) -> Iterator[Measurement]:
        """What the rows tell, in their order; ``offset`` [s] is added to their stamps."""
        for i, j in self.scans():
            parts = (column[i:j] for column in self._columns())
            values = (part if isinstance(part, np.ndarray) else tuple(part) for part in parts)
            yield self.kind(float(self.t[i]) + offset, *values)


def selected(stream: Stream, keep: NDArray[np.bool_]) -> Stream:
    columns = {f.name: getattr(stream, f.name) for f in fields(stream)}
    kept: dict[str, Any] = {
        k: v[keep] if isinstance(v, np.ndarray) else list(compress(v, keep)) for k, v in columns.items()
    }
    return replace(stream, **kept)


def joined(first: Stream, second: Stream) -> Stream:
    if type(first) is not type(second):
        kinds = f"{type(first).__name__} and one with {type(second).__name__}"
        raise InputError(f"a log with {kinds} cannot be joined, expected tables of one kind")
    columns = {f.name: (getattr(first, f.name), getattr(second, f.name)) for f in fields(first)}
    both: dict[str, Any] = {
        k: np.concatenate((a, b)) if isinstance(a, np.ndarray) else [*a, *b] for k, (a, b) in columns.items()
    }
    return replace(first, **both)
