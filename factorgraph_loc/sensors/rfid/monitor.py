"""Monitors of a run: a lost track, a failed reader, reads in bursts, and reads that are not as predicted."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from factors import chi_squared
from factors.compiled import compiled
from factors.rfid.detection import ExpectedReads, TagReadCounts
from factors.se2 import Array, Integers

DURATION = 5.0  # s of scans that are tested jointly
KEPT = 60.0  # s
SUSPICIOUS, CALM = 6.0, 3.0  # standard deviations; thresholds at which a suspicion begins and ends
SCANS = 4  # minimum number
BLOCK, POSSIBLE = 10.0, 0.01  # s of counting; least probability of a counted read
INDEPENDENT = 1.5  # largest ratio of variances of independent reads
PRIOR = 50.0  # variance of independent reads that is believed beforehand
REMEMBERED = 0.95  # share of what was counted that still counts a block later
NO_TAGS = np.empty(0, dtype=np.int64)
SILENT = 8.0  # log odds above which silence is attributed to a failure instead of the pose


class SilenceMonitor:
    """Detects that no tag is read where tags should be: the reader or the tags have failed. The misses are then uninformative, and
    would drive the estimate to an area without tags."""

    REJECTED = "rfid: no tag read where some should be"

    def __init__(self) -> None:
        self._evidence = 0.0
        self.lasts = False  # whether the last scan was part of such a silence

    def add(self, reads: int, evidence: float) -> bool:
        """Add a scan with its number of reads and its log-probability at the predicted pose; True in a silence."""
        self._evidence = 0.0 if reads else self._evidence + evidence
        self.lasts = self._evidence < -SILENT
        return self.lasts


class ScanMonitor:
    """Detects that scans are much less likely than they would be on a correct track.

    That is only a suspicion, because dead tags and a wrong map have the same effect. The search decides whether there is a
    better pose.
    """

    def __init__(self) -> None:
        self._scans: deque[tuple[float, float, float]] = deque()
        self.suspicious_since: float | None = None  # the time [s] since which scans are unlikely
        self._usual = 0.0  # mean excess of the negative log-likelihood that was accepted

    def add(self, t: float, surprise: float, variance: float) -> None:
        """Add a scan: excess of its negative log-likelihood over the expected value, and the variance of that, at the predicted
        pose. Later scans are discarded."""
        while self._scans and self._scans[-1][0] >= t:
            self._scans.pop()
        self._scans.append((t, surprise, variance))
        while self._scans[0][0] < t - KEPT:
            self._scans.popleft()
        excess, total, count = self._sums()
        z = (excess - count * self._usual) / math.sqrt(total + 1e-9) if count >= SCANS else 0.0
        if z > SUSPICIOUS or (self.suspicious_since is not None and z > CALM):
            self.suspicious_since = self._beginning()
        else:
            self.suspicious_since = None

    def accept(self) -> None:
        """Accept the track: the model or the map is wrong instead, and scans will remain as unlikely as the last ones."""
        excess, _, count = self._sums()
        self._usual = excess / max(count, 1)
        self.suspicious_since = None

    def clear(self) -> None:
        """Forget the scans: a new track starts."""
        self._scans.clear()
        self.suspicious_since = None

    def _sums(self) -> tuple[float, float, int]:
        """Sums of the excesses and of the variances of the last scans, and their number."""
        excess, variance, count = 0.0, 0.0, 0
        for t, surprise, own in reversed(self._scans):
            if t <= self._scans[-1][0] - DURATION:
                break
            excess, variance, count = excess + surprise, variance + own, count + 1
        return excess, variance, count

    def _beginning(self) -> float:
        """The change point, which maximises the total excess after it."""
        total, most, begin = 0.0, -math.inf, self._scans[-1][0]
        for t, surprise, variance in reversed(self._scans):
            # scans as likely as expected count against it
            total += surprise - self._usual - math.sqrt(variance)
            if total > most:
                most, begin = total, t
        return begin


class BurstMonitor:
    """The number of correlated rounds that inform as much as one independent round.

    Reads and misses behind a person or a shelf are correlated. The number of reads in a block of time then scatters more about its
    expectation than independent reads would. The result is the ratio of the two variances (McCullagh and Nelder, "Generalized
    linear models", 1989, section 4.5), over A antennas and T tags.
    """

    def __init__(self, antennas: int, tags: int) -> None:
        # reads minus expected reads and their variance in this block; and the tags with any
        self._cells = np.zeros((tags, 2, antennas))
        self._tags = NO_TAGS
        self._sums = np.full(2, PRIOR)  # of the squares, and of the variances, of all blocks
        self._begun = -math.inf
        self._last = -math.inf

    @property
    def together(self) -> float:
        """The ratio, 1 where a right model may have it by chance."""
        ratio = float(self._sums[0] / self._sums[1])
        return ratio if ratio > INDEPENDENT else 1.0

    def add(self, t: float, measured: TagReadCounts, reads: ExpectedReads, counts: NDArray[np.bool_]) -> None:
        """Add the reads of a scan once; ``counts`` (C,): whether each tag is counted."""
        if t <= self._last:
            return
        self._last = t
        if t >= self._begun + BLOCK:
            squares, variances = _taken(self._cells, self._tags)
            self._sums = REMEMBERED * self._sums + (squares, variances)
            self._tags, self._begun = NO_TAGS, t
        _count(self._cells, measured.antennas, measured.rounds, reads.tags, reads.hits, reads.p, counts)
        self._tags = np.union1d(self._tags, reads.tags)

    def clear(self) -> None:
        """Forget this block: the track was wrong."""
        _taken(self._cells, self._tags)
        self._tags, self._begun = NO_TAGS, -math.inf


@compiled
def _count(
    cells: Array,
    antennas: Integers,
    rounds: Integers,
    tags: Integers,
    hits: Integers,
    p: Array,
    counts: NDArray[np.bool_],
) -> None:
    """Add to the cells of :class:`BurstMonitor`."""
    for c in range(len(tags)):
        for k in range(len(antennas)):
            if counts[c] and p[k, c] > POSSIBLE:
                cells[tags[c], 0, antennas[k]] += hits[k, c] - rounds[k] * p[k, c]
                cells[tags[c], 1, antennas[k]] += rounds[k] * p[k, c] * (1.0 - p[k, c])


@compiled
def _taken(cells: Array, tags: Integers) -> tuple[float, float]:
    """The sums of the squares and of the variances in the cells of some tags, which are empty then."""
    squares = variances = 0.0
    for t in tags:
        for a in range(cells.shape[2]):
            squares += cells[t, 0, a] ** 2
            variances += cells[t, 1, a]
            cells[t, 0, a] = cells[t, 1, a] = 0.0
    return squares, variances


BAND, BANDS = 1.0, 50  # m of distance, and how many bands; the last one has no end
FEWEST = 30.0  # least predicted reads of a reported group
SHOWN = 4  # groups that are named
DIFFERENT = 0.15  # least relative error of the predicted reads of a doubted model
TINY = 1e-9  # reads: none of them has no logarithm
WINDOW = 15.0  # s after which counts have the weight 1 / e
DOUBTED, TRUSTED = 1e-5, 1e-3  # probability of such counts with a right model at which doubts begin, and end
MANY, NEARLY_NONE = 12.0, 0.05  # predicted reads of an antenna that may be dead, and the share of these that it reads
KNOWN = BAND / 4.0  # m: largest standard deviation of the position with which a scan informs the model


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

    def large(self, fewest: float = FEWEST) -> Integers:
        """The groups of at least ``fewest`` predicted reads; antennas only if there are several."""
        count = len(self.sums[1]) if len(self.antennas) > 1 else BANDS
        return np.flatnonzero(self.sums[1, :count] >= fewest)

    def names(self, groups: Integers) -> list[str]:
        """The names of groups."""
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

    The bands of distance and the antennas have a chi-square each, where ``together`` rounds count as one; groups with
    few predicted reads are merged, far bands with nearer ones: there are the reads if a range is too short. The model is
    doubted while one of them is beyond chance, and more than :data:`DIFFERENT` of the predicted reads are missing or too many.
    """

    def __init__(self, antennas: Sequence[str]) -> None:
        self._groups = ReadGroups(antennas)
        self._last = -math.inf
        self.doubted = False

    def add(
        self, t: float, measured: TagReadCounts, reads: ExpectedReads, counts: NDArray[np.bool_], together: float
    ) -> None:
        """Add the reads of a scan once; ``counts`` (K, C): whether each read is counted."""
        if t <= self._last:
            return
        forgotten = math.exp((self._last - t) / WINDOW)
        self._last = t
        self._groups.sums[:2] *= forgotten
        self._groups.sums[2] *= forgotten**2
        self._groups.add(measured.antennas, measured.rounds, reads, counts)
        by_distance, by_antenna = self._chance(slice(0, BANDS), together), self._chance(slice(BANDS, None), together)
        chance = min(by_distance, by_antenna)
        self.doubted = chance < (TRUSTED if self.doubted else DOUBTED)

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
        groups = self._groups.large()
        return self._groups.shares(groups if len(groups) else self._groups.large(1.0))

    def dead_antennas(self, together: float) -> list[int]:
        """The antennas that read nothing, or nearly so, although :data:`MANY` independent reads were predicted of each."""
        observed, predicted, _ = self._groups.sums[:, BANDS:]
        return np.flatnonzero((predicted > MANY * together) & (observed < NEARLY_NONE * predicted)).tolist()

    def clear(self) -> None:
        """Forget everything: the track was wrong, or the model changes."""
        self._groups.sums[:] = 0.0
        self.doubted = False


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
