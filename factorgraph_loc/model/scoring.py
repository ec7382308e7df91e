"""The configuration of a run, and its ticks, the times of the recorded estimates.

Ticks are a grid of 10 Hz from the start of a run, except in long gaps between measurements. This module imports no
numerical libraries, so that the command line starts quickly.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from factorgraph_loc.errors import InputError
from factorgraph_loc.text import quoted

KINDS = ("causal", "final")  # kinds of estimates of a run
MAX_GAP = 0.5  # s: longest gap between two estimates that scoring interpolates
MAX_DIFF = 0.01  # s: largest difference of two timestamps that scoring treats as equal
Alignment = Literal["none", "origin", "se2", "yaw", "se3", "sim3"]
ALIGNMENTS: tuple[Alignment, ...] = ("none", "origin", "se2", "yaw", "se3", "sim3")
Association = Literal["nearest", "interpolate"]
ASSOCIATIONS: tuple[Association, ...] = ("nearest", "interpolate")
NAMED_PRIORS = ("reference", "log", "unknown")
PRIORS = f"{', '.join(NAMED_PRIORS)}, X,Y or X,Y,HEADING"
RATE = 10  # Hz
TICK_GAP = 60.0  # s: default of tick_gap; in a longer gap between measurements no estimates are recorded
SHORTEST, LONGEST = 1.0, 86400.0  # s: bounds of tick_gap
MOST_SEEDS = 10_000
LARGEST_SEED = 2**63 - 1  # the largest integer that a table of results can store
TOLERANCE = 1e-6  # a tick may follow the last measurement by this fraction of a tick interval, because of rounding


@dataclass(frozen=True)
class RunConfig:
    """The configuration of a run on a log.

    ``estimator``: the name of the estimator. ``settings``: {key: value} that replace its default settings. ``sensors``:
    names of the sensors to use, None for the default of the rig. ``rssi`` and ``phase`` are optional parts of ``rfid``.
    ``prior``: the start, such as "log" or "unknown", see
    :func:`~factorgraph_loc.experiments.preparation.resolve_prior`. ``seed``: the seed of the estimator's random
    generator. ``max_gap``: the longest gap [s] between two estimates that scoring interpolates. ``tick_gap``: no
    estimates are recorded in gaps between measurements longer than this [s]. ``align``: unless it is "none", there are
    also scores after this alignment with the reference, such as "se2".
    """

    estimator: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    sensors: tuple[str, ...] | None = None
    prior: str | None = None
    seed: int = 0
    max_gap: float = MAX_GAP
    tick_gap: float = TICK_GAP
    align: Alignment = "none"


def check_max_gap(max_gap: float) -> None:
    """Raise InputError if ``max_gap`` [s] is not positive and finite."""
    if not 0.0 < max_gap < math.inf:
        raise InputError(f"max_gap is {max_gap:g}, expected a time above 0 s")


def check_tick_gap(gap: float) -> None:
    """Raise InputError if ``gap`` [s], the value of the setting ``tick_gap``, is out of bounds."""
    if not SHORTEST <= gap <= LONGEST:
        raise InputError(f"tick_gap is {gap:g}, expected {SHORTEST:g} to {LONGEST:g} s")


def check_prior(prior: str | None) -> None:
    """Raise InputError if ``prior`` is neither the name of a start, such as ``reference``, nor a pose
    ``X,Y,HEADING``."""
    if prior is not None and prior not in NAMED_PRIORS:
        parse_position(prior)


def parse_position(prior: str) -> list[float]:
    """Return the numbers of a start ``X,Y`` or ``X,Y,HEADING`` [m, rad]. Raises InputError if the text is neither."""
    from factorgraph_loc.files.models import FARTHEST  # noqa: PLC0415 - imports pydantic

    try:
        x, y, *heading = (float(part) for part in prior.split(","))
    except ValueError:
        raise InputError(f"prior is {quoted(prior)}, expected one of {PRIORS}") from None
    if len(heading) > 1:
        raise InputError(f"prior is {quoted(prior)}, expected one of {PRIORS}")
    if not (abs(x) <= FARTHEST and abs(y) <= FARTHEST and all(abs(angle) <= 2.0 * math.pi for angle in heading)):
        raise InputError(
            f"prior is {quoted(prior)}, expected X and Y up to {FARTHEST:g} m, and a heading up to 2 pi rad"
        )
    return [x, y, *heading]


def parse_seeds(text: str, source: object = "--seeds") -> range:
    """Return the seeds in a text: ``0:10`` gives the seeds 0 to 9, ``3`` the seed 3.

    Raises InputError if the text is invalid. ``source``: the name of the option in the error message.
    """
    first, colon, end = text.partition(":")
    try:
        seeds = range(int(first), int(end) if colon else int(first) + 1)
    except ValueError:
        seeds = range(0)
    if not seeds or seeds[0] < 0 or seeds[-1] > LARGEST_SEED:
        raise InputError(f"{source} is {quoted(text)}, expected a number such as 3, or a range such as 0:10")
    if seeds[-1] - seeds[0] >= MOST_SEEDS:
        raise InputError(f"{source} is {quoted(text)}, expected at most {MOST_SEEDS:,} seeds")
    return seeds


class Ticks:
    """The ticks of a run: the times at which estimates are recorded. They are computed while measurements arrive.

    ``start``: time of the first tick [s]. A tick at time t follows all measurements up to t. Ticks have a constant
    interval. There are none in a gap of more than ``gap`` [s] without measurements.
    """

    def __init__(self, start: float, gap: float = TICK_GAP) -> None:
        self._start, self.gap = start, gap
        self._newest = start
        self._next = 0  # index of the next tick on the grid
        self.count = 0  # number of ticks so far
        self.skipped: list[tuple[float, float]] = []  # start and end [s] of gaps without ticks

    @property
    def seconds(self) -> float:
        """The time [s] from the start to the newest measurement, without gaps longer than ``gap``."""
        return self._newest - self._start - sum(end - begin for begin, end in self.skipped)

    @property
    def due(self) -> float:
        """The time of the next tick [s]."""
        return self._start + self._next / RATE

    def advance(self, t: float) -> Iterable[float]:
        """Return the ticks [s] before ``t`` that were not returned earlier. ``t`` [s]: the time of the next
        measurement."""
        if self._newest <= t <= self._start + self._next / RATE and t <= self._newest + self.gap:
            self._newest = t
            return ()  # the most frequent case, which must be fast
        return self._pass(t)

    def _pass(self, t: float) -> Iterator[float]:
        if t > self._newest + self.gap:
            yield from self.rest()
            self.skipped.append((self._newest, t))
            self._next = max(self._next, math.floor((t - self._start) * RATE) - 1)
            for _ in range(3):  # rounding may require several steps to the first tick that is not before `t`
                self._next += self._start + self._next / RATE < t
        self._newest = max(self._newest, t)
        while (tick := self._start + self._next / RATE) < t:
            self._next += 1
            self.count += 1
            yield tick

    def rest(self) -> Iterator[float]:
        """Yield the remaining ticks [s] up to the newest measurement. Call this after the last measurement."""
        last = math.floor((self._newest - self._start) * RATE + TOLERANCE)
        while self._next <= last:
            tick = self._start + self._next / RATE
            self._next += 1
            self.count += 1
            yield tick
