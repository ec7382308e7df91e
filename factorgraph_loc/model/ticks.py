"""When a run tells its estimates: on a grid of 10 Hz from its start on, but not inside long gaps between measurements."""

import math
from collections.abc import Iterable, Iterator

from factorgraph_loc.errors import InputError

RATE = 10  # Hz
TICK_GAP = 60.0  # s without any measurement, above which there are no ticks
SHORTEST, LONGEST = 1.0, 86400.0  # s that may be set
TOLERANCE = 1e-6  # of a tick: one that rounding put behind the last measurement counts


def check_tick_gap(gap: float) -> None:
    """InputError if that is no length of gaps without ticks."""
    if not SHORTEST <= gap <= LONGEST:
        raise InputError(f"tick_gap is {gap:g}, expected {SHORTEST:g} to {LONGEST:g} s")


class Ticks:
    """The ticks of a run that begins at ``start``, as measurements arrive.

    A tick comes after all measurements that arrived up to its time. There is none between two measurements, of any sensor, that
    lie more than ``gap`` [s] apart; the grid goes on behind them. So what a hole costs, of a clock that jumps or of a robot that is
    switched off, does not grow with its length.
    """

    def __init__(self, start: float, gap: float = TICK_GAP) -> None:
        self._start, self._gap = start, gap
        self._newest = start
        self._next = 0  # number of the next tick on the grid
        self.count = 0  # ticks that there were
        self.skipped: list[tuple[float, float]] = []  # begin and end [s] of gaps without ticks

    @property
    def seconds(self) -> float:
        """How long it has been since the start, without gaps."""
        return self._newest - self._start - sum(end - begin for begin, end in self.skipped)

    def before(self, t: float) -> Iterable[float]:
        """The ticks that come before a measurement at ``t``, which is the next to arrive."""
        if self._newest <= t <= self._start + self._next / RATE and t <= self._newest + self._gap:
            self._newest = t
            return ()  # as with most rows of odometry
        return self._before(t)

    def _before(self, t: float) -> Iterator[float]:
        if t > self._newest + self._gap:
            yield from self.rest()
            self.skipped.append((self._newest, t))
            self._next = max(self._next, math.floor((t - self._start) * RATE) - 1)
            for _ in range(3):  # rounding of large numbers: the first that is not before
                self._next += self._start + self._next / RATE < t
        self._newest = max(self._newest, t)
        while (tick := self._start + self._next / RATE) < t:
            self._next += 1
            self.count += 1
            yield tick

    def rest(self) -> Iterator[float]:
        """The ticks up to the newest measurement."""
        last = math.floor((self._newest - self._start) * RATE + TOLERANCE)
        while self._next <= last:
            tick = self._start + self._next / RATE
            self._next += 1
            self.count += 1
            yield tick
