"""Counts and consistency figures of a run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar


@dataclass(frozen=True)
class Mark:
    """The sizes of the lists and the counts of :class:`Diagnostics` at some time."""

    nis: Mapping[str, int]
    residuals: Mapping[str, int]
    ignored: Mapping[str, int]
    rejected: Mapping[str, int]


@dataclass(frozen=True)
class Written:
    """What was added to :class:`Diagnostics` since a mark: new rows, and the increases of counts."""

    nis: Mapping[str, Sequence[tuple[float, float, int]]]
    residuals: Mapping[str, Sequence[float]]
    ignored: Mapping[str, int]
    rejected: Mapping[str, int]


NOTHING_WRITTEN = Written({}, {}, {}, {})


@dataclass
class Diagnostics:
    """Counts and consistency figures of a run.

    ``residuals``: by sensor and quantity (``bearing_range.range`` in m), measurement minus prediction before the update. ``nis``:
    by sensor, rows of (t, normalised innovation squared, degrees of freedom). ``ignored``, ``rejected``, ``late``: counts by
    reason. ``events``: (t, description), for example a rebuilt graph. ``dead_tags``: tags of the map that were never read and
    are believed to be dead, or moved out of sight, with that probability; ``moved_tags``: tags that were read and are believed
    to be elsewhere.
    """

    nis: dict[str, list[tuple[float, float, int]]] = field(default_factory=dict)
    residuals: dict[str, list[float]] = field(default_factory=dict)
    ignored: dict[str, int] = field(default_factory=dict)
    rejected: dict[str, int] = field(default_factory=dict)
    late: dict[str, int] = field(default_factory=dict)
    events: list[tuple[float, str]] = field(default_factory=list)
    dead_tags: dict[str, float] = field(default_factory=dict)
    moved_tags: dict[str, float] = field(default_factory=dict)
    # the latest mark, valid while nothing is added
    _mark: Mark | None = field(default=None, init=False, repr=False, compare=False)

    def ignore(self, reason: str, count: int = 1) -> None:
        self._mark = None
        self.ignored[reason] = self.ignored.get(reason, 0) + count

    def reject(self, reason: str, count: int = 1) -> None:
        self._mark = None
        self.rejected[reason] = self.rejected.get(reason, 0) + count

    def drop_late(self, sensor: str, count: int = 1) -> None:
        self.late[sensor] = self.late.get(sensor, 0) + count

    def innovation(self, sensor: str, t: float, nis: float, dof: int) -> None:
        self._mark = None
        self.nis.setdefault(sensor, []).append((t, nis, dof))

    def add_residuals(self, name: str, values: Iterable[float]) -> None:
        self._mark = None
        self.residuals.setdefault(name, []).extend(values)

    def event(self, t: float, what: str) -> None:
        """Record an event; an event that is repeated after going back in time is recorded once."""
        if (t, what) not in self.events:
            self.events.append((t, what))

    def keep_last(self, rows: int) -> None:
        """Keep the last ``rows`` rows of each list only."""
        self._mark = None
        for innovations in self.nis.values():
            del innovations[:-rows]
        for residuals in self.residuals.values():
            del residuals[:-rows]
        del self.events[:-rows]

    def copy(self) -> Diagnostics:
        """A deep copy."""
        return Diagnostics(
            {name: list(rows) for name, rows in self.nis.items()},
            {name: list(values) for name, values in self.residuals.items()},
            dict(self.ignored),
            dict(self.rejected),
            dict(self.late),
            list(self.events),
            dict(self.dead_tags),
            dict(self.moved_tags),
        )

    def mark(self) -> Mark:
        """The current sizes, for :meth:`since`."""
        if self._mark is None:
            rows, values = ({name: len(found) for name, found in lists.items()} for lists in (self.nis, self.residuals))
            self._mark = Mark(rows, values, dict(self.ignored), dict(self.rejected))
        return self._mark

    def since(self, mark: Mark) -> Written:
        """What was added since ``mark``."""
        if mark is self._mark:
            return NOTHING_WRITTEN
        return Written(
            {name: rows[mark.nis.get(name, 0) :] for name, rows in self.nis.items()},
            {name: values[mark.residuals.get(name, 0) :] for name, values in self.residuals.items()},
            _risen(self.ignored, mark.ignored),
            _risen(self.rejected, mark.rejected),
        )

    def take_back(self, written: Written) -> None:
        """Remove what was added, before the same measurements are processed again. Rows that :meth:`keep_last` removed are
        skipped; ``late`` and ``events`` are kept."""
        self._mark = None
        _remove(self.nis, written.nis)
        _remove(self.residuals, written.residuals)
        for totals, counts in ((self.ignored, written.ignored), (self.rejected, written.rejected)):
            for name, count in counts.items():
                totals[name] -= count
                if not totals[name]:
                    del totals[name]


def _risen(counts: Mapping[str, int], before: Mapping[str, int]) -> dict[str, int]:
    """The counts that increased, and by how much."""
    rises = {name: count - before.get(name, 0) for name, count in counts.items()}
    return {name: rise for name, rise in rises.items() if rise}


_Row = TypeVar("_Row")


def _remove(lists: dict[str, list[_Row]], taken: Mapping[str, Sequence[_Row]]) -> None:
    """Remove the last occurrence of each row, and lists that become empty."""
    for name in taken.keys() & lists.keys():
        rows = lists[name]
        for row in reversed(taken[name]):
            found = next((i for i in reversed(range(len(rows))) if rows[i] is row or rows[i] == row), None)
            if found is not None:
                del rows[found]
        if not rows:
            del lists[name]
