"""Compact storage of timestamps and numbers from the messages of a topic."""

from array import array

import numpy as np

from factorgraph_loc.io.bags.file import Stamped
from factors.se2 import Array, Integers


class TopicRows:
    """N rows of ``width`` numbers with timestamps, and the numbers of their messages, counted from 1 within the topic."""

    def __init__(self, source: str, width: int) -> None:
        self.source = source
        self._width = width
        self._row = array("q")
        self._t_ns = array("q")
        self._values = array("d")

    def append(self, item: Stamped, t_ns: int, values: tuple[float, ...]) -> None:
        self._row.append(item.row)
        self._t_ns.append(t_ns)
        self._values.extend(values)

    def __len__(self) -> int:
        return len(self._row)

    @property
    def rows(self) -> Integers:
        return np.array(self._row, dtype=np.int64)

    @property
    def t_ns(self) -> Integers:
        return np.array(self._t_ns, dtype=np.int64)

    @property
    def values(self) -> Array:
        """The numbers (N, width)."""
        return np.array(self._values, dtype=float).reshape(-1, self._width)
