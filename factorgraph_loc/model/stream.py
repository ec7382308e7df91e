"""The rows of one sensor of a log."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace
from itertools import compress
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.measurement import Measurement
from factors.se2 import Array


class Stream(Protocol):
    """The rows of one sensor: a dataclass of columns; ``t`` (N,) in seconds from the log's start, by the sensor's own clock.

    Rows stand in the order in which they arrived; a stamp may be a little older than the one before (a late measurement).
    """

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def t(self) -> Array: ...

    def measurements(self, offset: float) -> Iterator[Measurement]: ...


def selected(stream: Stream, keep: NDArray[np.bool_]) -> Stream:
    columns = {f.name: getattr(stream, f.name) for f in fields(stream)}
    kept = {k: v[keep] if isinstance(v, np.ndarray) else list(compress(v, keep)) for k, v in columns.items()}
    return replace(stream, **kept)


def joined(first: Stream, second: Stream) -> Stream:
    if type(first) is not type(second):
        kinds = f"{type(first).__name__} and one with {type(second).__name__}"
        raise InputError(f"a log with {kinds} cannot be joined, expected tables of one kind")
    columns = {f.name: (getattr(first, f.name), getattr(second, f.name)) for f in fields(first)}
    both = {k: np.concatenate((a, b)) if isinstance(a, np.ndarray) else [*a, *b] for k, (a, b) in columns.items()}
    return replace(first, **both)
