"""Monitors of the RFID sensor in a run.

They detect a lost track, a failed reader, correlated reads, and reads that contradict the detection models.
"""

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

DURATION = 5.0  # s; scans of this time are tested jointly
KEPT = 60.0  # s; older scans are discarded
SUSPICIOUS, CALM = 6.0, 3.0  # standard deviations: a suspicion begins above SUSPICIOUS and ends below CALM
SCANS = 4  # minimum number of scans in a test
BLOCK, POSSIBLE = 10.0, 0.01  # s, length of a block of time; minimum probability of a read that is counted
INDEPENDENT = 1.5  # a ratio of variances up to this is treated as 1
PRIOR = 50.0  # initial value of the sums of both variances, so that their ratio is 1 at first
REMEMBERED = 0.95  # weight of the sums of earlier blocks after each block
NO_TAGS = np.empty(0, dtype=np.int64)
SILENT = 8.0  # log odds above which missing reads are attributed to a failure instead of a wrong pose


class SilenceMonitor:
    """Detects that no tag is read although reads are expected, because the reader or the tags have failed. Misses are
    then without information, and would shift the estimate to an area without tags."""

    REJECTED = "rfid: no tag read where some should be"

    def __init__(self) -> None:
        self._evidence = 0.0
        self.lasts = False  # True if the reader or the tags had failed at the last scan

    def add(self, reads: int, evidence: float) -> bool:
        """Add a scan: its number of ``reads``, and its log-probability ``evidence`` at the predicted pose. Returns True
        during a failure."""
        self._evidence = 0.0 if reads else self._evidence + evidence
        self.lasts = self._evidence < -SILENT
        return self.lasts


class ScanMonitor:
    """Detects that scans are much less likely than expected on a correct track.

    This is only a suspicion, because dead tags and a wrong map have the same effect. A search decides if there is a
    better pose.
    """

    def __init__(self) -> None:
        self._scans: deque[tuple[float, float, float]] = deque()
        self.suspicious_since: float | None = None  # the time [s] since which scans are unlikely, or None
        self._usual = 0.0  # mean excess of the negative log-likelihood of scans on an accepted track

    def add(self, t: float, surprise: float, variance: float) -> None:
        """Add a scan at ``t`` [s]. Scans after ``t`` are discarded.

        ``surprise``: its negative log-likelihood at the predicted pose minus the expected value. ``variance``: the
        variance of ``surprise``.
        """
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
        """End the suspicion, because the track is correct and the model or the map is wrong. Later scans are expected
        to be as unlikely as the last ones."""
        excess, _, count = self._sums()
        self._usual = excess / max(count, 1)
        self.suspicious_since = None

    def clear(self) -> None:
        """Discard the scans, because a new track starts."""
        self._scans.clear()
        self.suspicious_since = None

    def _sums(self) -> tuple[float, float, int]:
        """Return sums over the scans of the last DURATION seconds: of ``surprise``, of ``variance`` (see :meth:`add`),
        and the number of these scans."""
        excess, variance, count = 0.0, 0.0, 0
        for t, surprise, own in reversed(self._scans):
            if t <= self._scans[-1][0] - DURATION:
                break
            excess, variance, count = excess + surprise, variance + own, count + 1
        return excess, variance, count

    def _beginning(self) -> float:
        """Return the time [s] of the begin of the suspicion. The sum of ``surprise`` after this time is the largest."""
        total, most, begin = 0.0, -math.inf, self._scans[-1][0]
        for t, surprise, variance in reversed(self._scans):
            # one standard deviation is subtracted, so that scans with the expected likelihood reduce the sum
            total += surprise - self._usual - math.sqrt(variance)
            if total > most:
                most, begin = total, t
        return begin


class BurstMonitor:
    """Estimates the overdispersion of reads: the number of correlated rounds that have the information of one
    independent round.

    Reads and misses are correlated, for example behind a person. The number of reads in a block of time then varies more around
    its expectation than the number of independent reads. The overdispersion is the ratio of the two variances (McCullagh and
    Nelder, "Generalized linear models", 1989, section 4.5). Arguments are the numbers of antennas and tags.
    """

    def __init__(self, antennas: int, tags: int) -> None:
        # for each tag and antenna: reads minus expected reads in this block, and the variance of independent reads
        self._cells = np.zeros((tags, 2, antennas))
        self._tags = NO_TAGS  # tags whose cells are not zero
        self._sums = np.full(2, PRIOR)  # sums over all blocks: of the squared differences, and of the variances
        self._begun = -math.inf
        self._last = -math.inf

    @property
    def overdispersion(self) -> float:
        """The ratio of the variances. Small ratios, which occur by chance with a correct model, are replaced by 1."""
        ratio = float(self._sums[0] / self._sums[1])
        return ratio if ratio > INDEPENDENT else 1.0

    def add(self, t: float, measured: TagReadCounts, reads: ExpectedReads, counts: NDArray[np.bool_]) -> None:
        """Add a scan, unless a scan of this time or later was added. ``measured``: its reads. ``reads``: observed and
        expected reads of C tags. ``counts`` (C,): True for tags that are counted."""
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
        """Discard the current block, because the track was wrong."""
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
    """Add the reads of C ``tags`` by K ``antennas`` to the cells of :class:`BurstMonitor`. ``hits``, ``p`` (K, C): numbers of
    reads, and probabilities of a read in one of ``rounds`` (K,). ``counts`` (C,): True for tags that are counted."""
    for c in range(len(tags)):
        for k in range(len(antennas)):
            if counts[c] and p[k, c] > POSSIBLE:
                cells[tags[c], 0, antennas[k]] += hits[k, c] - rounds[k] * p[k, c]
                cells[tags[c], 1, antennas[k]] += rounds[k] * p[k, c] * (1.0 - p[k, c])


@compiled
def _taken(cells: Array, tags: Integers) -> tuple[float, float]:
    """Return the sums of squared differences and of variances in the ``cells`` of ``tags``, and set these cells to zero."""
    squares = variances = 0.0
    for t in tags:
        for a in range(cells.shape[2]):
            squares += cells[t, 0, a] ** 2
            variances += cells[t, 1, a]
            cells[t, 0, a] = cells[t, 1, a] = 0.0
    return squares, variances


BAND, BANDS = 1.0, 50  # m, width of a band of distance; number of bands. The last band has no upper end
FEWEST = 30.0  # minimum number of predicted reads of a group
SHOWN = 4  # number of groups that a message names
DIFFERENT = 0.15  # a model is doubted only if the relative error of its predicted reads exceeds this
TINY = 1e-9  # replaces zero reads in a logarithm
WINDOW = 15.0  # s; the weight of reads falls to 1/e in this time
DOUBTED, TRUSTED = 1e-5, 1e-3  # p-values of the counts: a doubt begins below DOUBTED and ends above TRUSTED
# an antenna is dead if at least MANY reads are predicted, and a smaller fraction than NEARLY_NONE is observed
MANY, NEARLY_NONE = 12.0, 0.05
KNOWN = BAND / 4.0  # m; scans are only counted if the standard deviation of the position is below this


@dataclass(frozen=True, eq=False)
class ReadGroups:
    """Counts of reads in G groups: one group for each band of distance, then one for each of the ``antennas``.

    ``sums`` (3, G): observed reads, predicted reads, and the variance of the observed reads if rounds were independent.
    """

    antennas: Sequence[str]
    sums: Array = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "sums", np.zeros((3, BANDS + len(self.antennas))))

    def add(self, antennas: Integers, rounds: Integers, reads: ExpectedReads, counts: NDArray[np.bool_]) -> None:
        """Add reads of C tags by K ``antennas`` in ``rounds`` (K,). ``counts`` (K, C): True for reads that are counted."""
        _add(self.sums, antennas, rounds, reads.hits, reads.p, reads.distance, counts)

    def large(self, fewest: float = FEWEST) -> Integers:
        """Return the indices of groups with at least ``fewest`` predicted reads. Antennas are only included if there
        are several."""
        count = len(self.sums[1]) if len(self.antennas) > 1 else BANDS
        return np.flatnonzero(self.sums[1, :count] >= fewest)

    def names(self, groups: Integers) -> list[str]:
        """Return the names of groups by their indices."""
        bands = [f"{b * BAND:g} to {(b + 1) * BAND:g} m" for b in range(BANDS)]
        return [(bands + [f"antenna {name}" for name in self.antennas])[g] for g in groups.tolist()]

    def shares(self, groups: Integers) -> str:
        """Return a text with the ratios of observed to predicted reads of groups. Groups with the largest errors, in
        standard deviations, come first."""
        observed, predicted, variance = self.sums[:, groups]
        worst = np.argsort(-np.abs(observed - predicted) / np.sqrt(variance), kind="stable")[:SHOWN]
        names = self.names(groups[worst])
        return ", ".join(f"{name}: {observed[i] / predicted[i]:.2f}" for name, i in zip(names, worst, strict=True))


class ConsistencyMonitor:
    """Tests if recent reads agree with the detection models. ``doubted``: True while they do not.

    Observed and predicted reads are compared by bands of distance, and by antennas, with a chi-square test each. Groups
    with few predicted reads are merged, far bands with nearer ones. The model is doubted if a test fails, and if the
    errors exceed the fraction :data:`DIFFERENT` of the predicted reads.
    """

    def __init__(self, antennas: Sequence[str]) -> None:
        self._groups = ReadGroups(antennas)
        self._last = -math.inf
        self.doubted = False

    def add(
        self, t: float, measured: TagReadCounts, reads: ExpectedReads, counts: NDArray[np.bool_], overdispersion: float
    ) -> None:
        """Add a scan, unless a scan of this time or later was added. ``measured``: its reads. ``reads``: observed and
        expected reads. ``counts`` (K, C): True for reads that are counted. ``overdispersion``: the number of correlated
        rounds that count as one."""
        if t <= self._last:
            return
        forgotten = math.exp((self._last - t) / WINDOW)
        self._last = t
        self._groups.sums[:2] *= forgotten
        self._groups.sums[2] *= forgotten**2
        self._groups.add(measured.antennas, measured.rounds, reads, counts)
        groups = slice(0, BANDS), slice(BANDS, None)
        chance = min(self._chance(group, overdispersion) for group in groups)
        self.doubted = chance < (TRUSTED if self.doubted else DOUBTED)

    def _chance(self, groups: slice, overdispersion: float) -> float:
        """Return the p-value of the reads in some ``groups``: the probability that a correct model predicts reads so badly. It is 1
        if the relative error is at most DIFFERENT. ``overdispersion``: the number of correlated rounds that count as one."""
        observed, predicted, variance = _merged(self._groups.sums[:, groups], FEWEST)
        off = observed - predicted
        if np.sum(np.abs(off)) <= DIFFERENT * np.sum(predicted):
            return 1.0
        # the tail of the deviance is also accurate for few reads (McCullagh and Nelder, 1989, section 2.3)
        deviance = 2.0 * (observed * np.log(np.maximum(observed, TINY) / predicted) - off) * predicted / variance
        return float(chi_squared.survival(np.sum(deviance) / overdispersion, len(off)))

    @property
    def shares(self) -> str:
        """A text with the ratios of observed to predicted reads of the groups with the largest errors."""
        groups = self._groups.large()
        return self._groups.shares(groups if len(groups) else self._groups.large(1.0))

    def dead_antennas(self, overdispersion: float) -> list[int]:
        """Return the indices of antennas that read nearly nothing, although :data:`MANY` independent reads of each were predicted.

        ``overdispersion``: the number of correlated reads that count as one independent read.
        """
        observed, predicted, _ = self._groups.sums[:, BANDS:]
        return np.flatnonzero((predicted > MANY * overdispersion) & (observed < NEARLY_NONE * predicted)).tolist()

    def clear(self) -> None:
        """Discard all counts, because the track was wrong or the model changes."""
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
    """Add reads of C tags by K ``antennas`` to the ``sums`` of :class:`ReadGroups`. ``hits``, ``p``, ``distance``,
    ``counts`` (K, C)."""
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
    """Merge neighbouring groups until each has ``least`` predicted reads. Returns sums (3, H) of the H merged groups.

    ``sums`` (3, G): as in :class:`ReadGroups`. Merging proceeds from the last group to the first. If the groups at the beginning
    still have too few predicted reads, they are merged with the next group. H is 0 if all groups together have too few.
    """
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
