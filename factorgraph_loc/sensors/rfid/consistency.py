"""Reads that were observed against reads that were predicted, by distance and by antenna: of a log, and on the way."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from factors import chi_squared
from factors.compiled import compiled
from factors.rfid.counts import TagReadCounts
from factors.rfid.detection import ExpectedReads
from factors.se2 import Array, Integers

BAND, BANDS = 1.0, 50  # m of distance, and how many bands; the last one has no end
FEWEST = 30.0  # predicted reads of a group that is told
SHOWN = 4  # groups that are named
DIFFERENT = 0.15  # share of the predicted reads by which a model that is doubted is off
TINY = 1e-9  # reads: none of them has no logarithm
WINDOW = 15.0  # s in which what was counted comes to count for 1 / e
DOUBTED, TRUSTED = 1e-5, 1e-3  # probability of such counts with a right model at which doubts begin, and end
KNOWN = BAND / 4.0  # m: standard deviation of the position up to which a scan tells of the model


@dataclass(frozen=True, eq=False)
class ReadGroups:
    """Counts of reads in G groups: bands of distance, then ``antennas``. ``sums`` (3, G): observed reads, predicted ones, and the
    variance of the former if rounds are independent."""

    antennas: Sequence[str]
    sums: Array = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "sums", np.zeros((3, BANDS + len(self.antennas))))

    def add(self, antennas: Integers, rounds: Integers, reads: ExpectedReads, counts: NDArray[np.bool_]) -> None:
        """Add ``reads`` in ``rounds`` (K,) of ``antennas`` (K,); ``counts`` (K, C): which of them are counted."""
        _add(self.sums, antennas, rounds, reads.hits, reads.p, reads.distance, counts)

    def told(self, fewest: float = FEWEST) -> Integers:
        """The groups that are predicted to have so many reads or more; antennas only if there are several."""
        count = len(self.sums[1]) if len(self.antennas) > 1 else BANDS
        return np.flatnonzero(self.sums[1, :count] >= fewest)

    def names(self, groups: Integers) -> list[str]:
        """What groups are called."""
        bands = [f"{b * BAND:g} to {(b + 1) * BAND:g} m" for b in range(BANDS)]
        return [(bands + [f"antenna {name}" for name in self.antennas])[g] for g in groups.tolist()]

    def shares(self, groups: Integers) -> str:
        """Reads over predicted reads of groups, those first that are off by the most standard deviations."""
        observed, predicted, variance = self.sums[:, groups]
        worst = np.argsort(-np.abs(observed - predicted) / np.sqrt(variance), kind="stable")[:SHOWN]
        names = self.names(groups[worst])
        return ", ".join(f"{name}: {observed[i] / predicted[i]:.2f}" for name, i in zip(names, worst, strict=True))


class ConsistencyMonitor:
    """Whether reads are as the detection models predict, in a window that forgets.

    The bands of distance and the antennas have a chi-square each, where ``together`` rounds tell as much as one; groups of
    which few reads are predicted are merged, far bands with nearer ones: there are the reads if a range is too short. The model is
    doubted while one of them is beyond chance, and more than :data:`DIFFERENT` of the predicted reads are missing or too many.
    That may come of a wrong pose: ``suspicious_since`` is the time [s] since which they were not as by chance; None without doubts,
    and once the pose is accepted.
    """

    EVENT = "reads are not as the detection models predict"

    def __init__(self, antennas: Sequence[str]) -> None:
        self._groups = ReadGroups(antennas)
        self._last = -math.inf
        self._odd_since: float | None = None
        self.doubted = False
        self.suspicious_since: float | None = None

    def add(
        self, t: float, looks: TagReadCounts, reads: ExpectedReads, counts: NDArray[np.bool_], together: float
    ) -> None:
        """Add what was read in looks, once; ``counts`` (K, C): which of it is counted."""
        if t <= self._last:
            return
        forgotten = math.exp((self._last - t) / WINDOW)
        self._last = t
        self._groups.sums[:2] *= forgotten
        self._groups.sums[2] *= forgotten**2
        self._groups.add(looks.antennas, looks.rounds, reads, counts)
        chance = min((self._chance(one, together) for one in (slice(0, BANDS), slice(BANDS, None))), default=1.0)
        if chance >= TRUSTED:
            self._odd_since = None
        elif self._odd_since is None:
            self._odd_since = t
        before, self.doubted = self.doubted, chance < (TRUSTED if self.doubted else DOUBTED)
        if self.doubted != before:
            self.suspicious_since = self._odd_since if self.doubted else None

    def _chance(self, groups: slice, together: float) -> float:
        """The probability of counts that are so far off with a right model; 1 if they are not off by much."""
        observed, predicted, variance = _merged(self._groups.sums[:, groups], FEWEST)
        off = observed - predicted
        if np.sum(np.abs(off)) <= DIFFERENT * np.sum(predicted):
            return 1.0
        # the deviance, whose tail is right for few reads too (McCullagh and Nelder, 1989, section 2.3)
        deviance = 2.0 * (observed * np.log(np.maximum(observed, TINY) / predicted) - off) * predicted / variance
        return float(chi_squared.survival(np.sum(deviance) / together, len(off)))

    @property
    def shares(self) -> str:
        """Reads over predicted reads of the groups that are off most."""
        told = self._groups.told()
        return self._groups.shares(told if len(told) else self._groups.told(1.0))

    def accept(self) -> None:
        """Accept the pose: the model is wrong instead."""
        self.suspicious_since = None

    def clear(self) -> None:
        """Forget everything: the track was wrong."""
        self._groups.sums[:] = 0.0
        self.doubted, self._odd_since = False, None
        self.accept()


@compiled
def _add(
    sums: Array,
    antennas: Integers,
    rounds: Integers,
    hits: Integers,
    p: Array,
    distance: Array,
    counts: NDArray[np.bool_],
) -> None:
    """Add to the groups of :class:`ReadGroups`."""
    for k in range(len(antennas)):
        for c in range(p.shape[1]):
            if counts[k, c]:
                expected = rounds[k] * p[k, c]
                for group in (min(int(distance[k, c] / BAND), BANDS - 1), BANDS + antennas[k]):
                    sums[0, group] += hits[k, c]
                    sums[1, group] += expected
                    sums[2, group] += expected * (1.0 - p[k, c])


@compiled
def _merged(sums: Array, least: float) -> Array:
    """Sums (3, G) of groups, each merged with those before it until ``least`` reads are predicted of it; what is left of the first
    ones goes with the last that was made."""
    out, count, open_ = np.zeros(sums.shape), 0, 0.0
    for g in range(sums.shape[1] - 1, -1, -1):
        if open_ == 0.0 and sums[1, g] == 0.0:
            continue
        open_ += sums[1, g]
        for i in range(3):
            out[i, count] += sums[i, g]
        if open_ >= least:
            count, open_ = count + 1, 0.0
    if open_ > 0.0 and count > 0:
        for i in range(3):
            out[i, count - 1] += out[i, count]
    return out[:, :count]
