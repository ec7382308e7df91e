"""The rows of one sensor of a log."""

from abc import ABC, abstractmethod
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
class Stream(ABC):
    """The rows of one sensor, as columns; ``t`` (N,) in seconds from the log's start, by the sensor's own clock.

    Rows stand in the order in which they arrived; a stamp may be a little older than the one before (a late measurement).
    ``rank``: of rows of one time, those of the stream with the lowest come first: 0 of wheel odometry, 1 of other motion.
    """

    rank: ClassVar[int] = SEEN
    t: Array

    @abstractmethod
    def measurements(self, offset: float) -> Iterator[Measurement]:
        """What the rows tell, in their order; ``offset`` [s] is added to their stamps."""

    def begun_anew(self) -> Self:
        """The same of a robot that was put down at its first row, wherever it was before."""
        return self

    def scans(self) -> Iterator[tuple[int, int]]:
        """The first row of each run of equal stamps, and the one after its last."""
        return pairwise([*np.flatnonzero(np.diff(self.t, prepend=np.nan) != 0.0).tolist(), len(self.t)])


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
