"""Counts and consistency figures of a run, which an estimator records while it processes measurements."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from factorgraph_loc.text import Notice

# one addition to the diagnostics: the dictionary, the key in it, and the rows or the number that was added
Addition = tuple[dict[str, Any], str, Any]


@dataclass(frozen=True)
class Event(Notice):
    """A message about an event during a run. ``t`` [s]: the time of the event."""

    t: float


@dataclass
class Diagnostics:
    """Counts and consistency statistics of a run.

    ``residuals``: by sensor and quantity (``bearing_range.range`` in m), a list of measurement minus prediction.
    ``nis``: by sensor, a list of (t [s], normalised innovation squared, degrees of freedom) per update. ``ignored``,
    ``rejected``: counts of unused detections by reason, and of outliers by reason. ``late``: by sensor, the number of
    measurements that arrived too late to be used. ``events``: events of the estimator, for example a rebuilt graph.
    ``doubted``: by kind of map error (``moved_tags``), {name of a map element: probability}. ``added``: the list that
    :meth:`record` returned, None while nothing is recorded.
    """

    nis: dict[str, list[tuple[float, float, int]]] = field(default_factory=dict)
    residuals: dict[str, list[float]] = field(default_factory=dict)
    ignored: dict[str, int] = field(default_factory=dict)
    rejected: dict[str, int] = field(default_factory=dict)
    late: dict[str, int] = field(default_factory=dict)
    events: list[Event] = field(default_factory=list)
    doubted: dict[str, dict[str, float]] = field(default_factory=dict)
    # all additions since the call of :meth:`record`; None if it was not called
    added: list[Addition] | None = field(default=None, init=False, repr=False, compare=False)

    def __str__(self) -> str:
        """Return a summary as text, one line per entry: sensors, counts of unused measurements, and events. The line of
        a sensor has the number of updates, and the mean normalised innovation squared per degree of freedom. This mean
        is ideally 1."""
        lines = [
            f"{sensor}: {len(rows)} updates, NIS {sum(nis for _, nis, _ in rows) / max(1, sum(n for *_, n in rows)):.2f} per "
            "degree of freedom"
            for sensor, rows in self.nis.items()
        ]
        counts = {"ignored": self.ignored, "rejected": self.rejected, "late": self.late}
        lines += [f"{what}: {count} {reason}" for what, reasons in counts.items() for reason, count in reasons.items()]
        lines += [f"{event.t:.1f} s: {event}" for event in self.events]
        return "\n".join([*lines, *(f"{kind}: {', '.join(names)}" for kind, names in self.doubted.items())])

    def ignore(self, reason: str, count: int = 1) -> None:
        """Add ``count`` to the number of detections that are ignored for the same ``reason``, a short text. A negative
        ``count`` cancels an earlier call, if the detections are used after all."""
        self.ignored[reason] = self.ignored.get(reason, 0) + count
        if not self.ignored[reason]:
            del self.ignored[reason]
        if self.added is not None:
            self.added.append((self.ignored, reason, count))

    def reject(self, reason: str, count: int = 1) -> None:
        self.rejected[reason] = self.rejected.get(reason, 0) + count
        if self.added is not None:
            self.added.append((self.rejected, reason, count))

    def drop_late(self, sensor: str, count: int = 1) -> None:
        self.late[sensor] = self.late.get(sensor, 0) + count

    def innovation(self, sensor: str, t: float, nis: float, dof: int) -> None:
        row = (t, nis, dof)
        self.nis.setdefault(sensor, []).append(row)
        if self.added is not None:
            self.added.append((self.nis, sensor, (row,)))

    def add_residuals(self, name: str, values: Iterable[float]) -> None:
        rows = tuple(values)
        self.residuals.setdefault(name, []).extend(rows)
        if self.added is not None:
            self.added.append((self.residuals, name, rows))

    def event(self, t: float, kind: str, sentence: str, **fields: Any) -> None:
        """Append an event at time ``t`` [s] to the list ``events``. An event that is already in the list is not
        appended.

        ``kind``: an identifier of the type of event. ``sentence``: the text of the event, with names of ``fields`` in
        braces. For example ``"rebuilt: {why}", why="singular"`` has the text "rebuilt: singular".
        """
        event = Event(kind, sentence, fields, t)
        if event not in self.events:
            self.events.append(event)

    def keep_last(self, rows: int) -> None:
        """Delete all but the last ``rows`` innovations of each sensor, residuals of each quantity, and events."""
        for innovations in self.nis.values():
            del innovations[:-rows]
        for residuals in self.residuals.values():
            del residuals[:-rows]
        del self.events[:-rows]

    def copy(self) -> Diagnostics:
        """Return a deep copy that is not recording."""
        return Diagnostics(
            {name: list(rows) for name, rows in self.nis.items()},
            {name: list(values) for name, values in self.residuals.items()},
            dict(self.ignored),
            dict(self.rejected),
            dict(self.late),
            list(self.events),
            {kind: dict(probabilities) for kind, probabilities in self.doubted.items()},
        )

    def record(self) -> list[Addition]:
        """Start to record additions to these diagnostics, and return the list of them. Later additions are appended to
        it. Pass this list to :meth:`take_back` to undo the additions. Recording ends when ``added`` is set to None.
        Limitation: late measurements and events are not recorded."""
        self.added = []
        return self.added

    def take_back(self, added: Sequence[Addition]) -> None:
        """Remove the additions in the list ``added``, which :meth:`record` returned, from these diagnostics. Call this
        before the same measurements are processed again. Additions that :meth:`keep_last` has deleted are skipped."""
        for totals, name, rows in reversed(added):
            if isinstance(rows, int):
                totals[name] = totals.get(name, 0) - rows
            elif name in totals:
                _remove(totals[name], rows)
            if name in totals and not totals[name]:
                del totals[name]


def _remove(rows: list[Any], taken: Sequence[Any]) -> None:
    """Remove the last occurrence in ``rows`` of each of the rows ``taken``."""
    for row in reversed(taken):
        index = next((i for i in reversed(range(len(rows))) if rows[i] is row or rows[i] == row), None)
        if index is not None:
            del rows[index]
