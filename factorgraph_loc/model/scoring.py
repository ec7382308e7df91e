"""The configuration of a run, and its ticks: a grid of 10 Hz from its start, except in long gaps between measurements.

Importable without numerical libraries.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from factorgraph_loc.errors import InputError
from factorgraph_loc.text import quoted

KINDS = ("causal", "final")  # of the estimates of a run
MAX_GAP = 0.5  # s between estimates across which scoring interpolates
MAX_DIFF = 0.01  # s between stamps that are taken for one
Alignment = Literal["none", "origin", "se2", "yaw", "se3", "sim3"]
ALIGNMENTS: tuple[Alignment, ...] = ("none", "origin", "se2", "yaw", "se3", "sim3")
Association = Literal["nearest", "interpolate"]
ASSOCIATIONS: tuple[Association, ...] = ("nearest", "interpolate")
NAMED_PRIORS = ("reference", "log", "unknown")
PRIORS = f"{', '.join(NAMED_PRIORS)}, X,Y or X,Y,HEADING"
RATE = 10  # Hz
TICK_GAP = 60.0  # s; gaps without measurements above this length have no ticks
SHORTEST, LONGEST = 1.0, 86400.0  # s; bounds of the setting
MOST_SEEDS = 10_000
LARGEST_SEED = 2**63 - 1  # as in tables
TOLERANCE = 1e-6  # fraction of a tick, for rounding at the last measurement


@dataclass(frozen=True)
class RunConfig:
    """The configuration of a run on a log.

    ``estimator``: its registered name; ``settings``: overrides of its settings. ``sensors``: names of the streams it may use,
    None for those of the rig; ``rssi`` and ``phase`` are optional parts of the reads of ``rfid``. ``prior``: see
    :func:`~factorgraph_loc.experiments.preparation.resolve_prior`. ``seed``: of the estimator's random generator. ``max_gap``
    [s]: the largest interval between estimates that is interpolated for scoring. ``tick_gap`` [s]: there are no estimates inside
    longer gaps between measurements. ``align``: also score after this alignment with the reference. Scoring changes no estimate.
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
    """InputError if ``max_gap`` is not positive."""
    if not 0.0 < max_gap < math.inf:
        raise InputError(f"max_gap is {max_gap:g}, expected a time above 0 s")


def check_tick_gap(gap: float) -> None:
    """InputError if ``gap`` is out of bounds."""
    if not SHORTEST <= gap <= LONGEST:
        raise InputError(f"tick_gap is {gap:g}, expected {SHORTEST:g} to {LONGEST:g} s")


def check_prior(prior: str | None) -> None:
    """InputError for a text that is no start of a run on any log."""
    if prior is not None and prior not in NAMED_PRIORS:
        parse_position(prior)


def parse_position(prior: str) -> list[float]:
    """Position [m], and the heading [rad] if it is given, of a start ``X,Y`` or ``X,Y,HEADING``. InputError if it is neither."""
    from factorgraph_loc.files.models import FARTHEST  # noqa: PLC0415 - imports pydantic

    try:
        x, y, *heading = (float(part) for part in prior.split(","))
    except ValueError:
        raise InputError(f"prior is {quoted(prior)}, expected {PRIORS}") from None
    if len(heading) > 1:
        raise InputError(f"prior is {quoted(prior)}, expected {PRIORS}")
    if not (abs(x) <= FARTHEST and abs(y) <= FARTHEST and all(abs(angle) <= 2.0 * math.pi for angle in heading)):
        raise InputError(f"prior is {quoted(prior)}, expected metres, at most {FARTHEST:g}, and a heading in radians")
    return [x, y, *heading]


def parse_seeds(text: str, source: object = "--seeds") -> range:
    """Parse ``0:10`` as the seeds 0 to 9, ``3`` as the seed 3. Raises InputError with ``source``."""
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
    """The ticks of a run that starts at ``start``, generated as measurements arrive.

    A tick follows all measurements that arrived up to its time. Gaps of more than ``gap`` [s] between measurements (of all
    sensors) have no ticks; the grid continues after them. So the cost of a gap does not grow with its length.
    """

    def __init__(self, start: float, gap: float = TICK_GAP) -> None:
        self._start, self._gap = start, gap
        self._newest = start
        self._next = 0  # index of the next tick on the grid
        self.count = 0  # number of ticks so far
        self.skipped: list[tuple[float, float]] = []  # start and end [s] of gaps without ticks

    @property
    def seconds(self) -> float:
        """Time since the start, without gaps."""
        return self._newest - self._start - sum(end - begin for begin, end in self.skipped)

    @property
    def due(self) -> float:
        """When the next tick is."""
        return self._start + self._next / RATE

    def advance(self, t: float) -> Iterable[float]:
        """Advance to the next measurement, at ``t``: yields the ticks before it that were not yielded yet."""
        if self._newest <= t <= self._start + self._next / RATE and t <= self._newest + self._gap:
            self._newest = t
            return ()  # the usual case for odometry
        return self._pass(t)

    def _pass(self, t: float) -> Iterator[float]:
        if t > self._newest + self._gap:
            yield from self.rest()
            self.skipped.append((self._newest, t))
            self._next = max(self._next, math.floor((t - self._start) * RATE) - 1)
            for _ in range(3):  # find the first tick that is not before `t` despite rounding
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
