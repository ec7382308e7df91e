"""Monitors of the RFID sensor in a run.

They detect a wrong pose, a failed reader, correlated reads, and reads that contradict the detection models.
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

DURATION = 5.0  # s; ScanMonitor tests all scans in this time together
KEPT = 60.0  # s; older scans are discarded
SUSPICIOUS, CALM = 6.0, 3.0  # ScanMonitor: standard deviations above which a suspicion begins, and below which it ends
SCANS = 4  # minimum number of scans that ScanMonitor tests
BLOCK, POSSIBLE = 10.0, 0.01  # length [s] of a time block; minimum probability of a read that is counted
INDEPENDENT = 1.5  # an overdispersion below this is replaced by 1
PRIOR = 50.0  # initial value of both sums in BurstMonitor, so that the initial overdispersion is 1
REMEMBERED = 0.95  # BurstMonitor multiplies both sums by this factor at the end of each time block
NO_TAGS = np.empty(0, dtype=np.int64)
SILENT = 8.0  # SilenceMonitor: minimum log-odds of a failure of the reader or of all tags


class SilenceMonitor:
    """Detects a failure of the reader or of all tags: no tag is read although reads are expected. Misses must then be
    ignored, because they would move the estimated pose to an area without tags."""

    REJECTED = "rfid: no tag read where some should be"

    def __init__(self) -> None:
        self._evidence = 0.0
        self.lasts = False  # True if the reader or the tags had failed at the last scan

    def add(self, reads: int, evidence: float) -> bool:
        """Add a scan, and return True if the reader or all tags have failed. ``reads``: the number of reads in the
        scan. ``evidence``: the log-probability of the scan at the predicted pose. It is summed since the last read."""
        self._evidence = 0.0 if reads else self._evidence + evidence
        self.lasts = self._evidence < -SILENT
        return self.lasts


class ScanMonitor:
    """Detects that scans are much less likely at the estimated pose than they should be on average.

    The reason may be a wrong pose, dead tags or a wrong map. Global localization must then decide if another pose is
    better. ``suspicious_since``: the time [s] since which the scans are too unlikely, or None.
    """

    def __init__(self) -> None:
        self._scans: deque[tuple[float, float, float]] = deque()
        self.suspicious_since: float | None = None  # the time [s] since which scans are unlikely, or None
        self._usual = 0.0  # the mean ``surprise`` per scan that is expected

    def add(self, t: float, surprise: float, variance: float) -> None:
        """Add a scan at ``t`` [s], and update ``suspicious_since``. Stored scans at or after ``t`` are discarded.

        ``surprise``: the negative log-likelihood of the scan at the predicted pose, minus the expected value.
        ``variance``: the variance of ``surprise``.
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
        """Reset ``suspicious_since``. Call this if the pose is right and the model or the map is wrong. Later scans are
        then expected to be as unlikely as the last ones."""
        excess, _, count = self._sums()
        self._usual = excess / max(count, 1)
        self.suspicious_since = None

    def clear(self) -> None:
        """Discard all scans. Call this if the estimated pose was replaced."""
        self._scans.clear()
        self.suspicious_since = None

    def _sums(self) -> tuple[float, float, int]:
        """Return the sum of ``surprise``, the sum of ``variance``, and the number of scans in the last DURATION
        seconds. See :meth:`add`."""
        excess, variance, count = 0.0, 0.0, 0
        for t, surprise, own in reversed(self._scans):
            if t <= self._scans[-1][0] - DURATION:
                break
            excess, variance, count = excess + surprise, variance + own, count + 1
        return excess, variance, count

    def _beginning(self) -> float:
        """Return the time [s] after which the sum of ``surprise`` is largest, as the beginning of the suspicion."""
        total, most, begin = 0.0, -math.inf, self._scans[-1][0]
        for t, surprise, variance in reversed(self._scans):
            # a standard deviation is subtracted, so that scans that are as likely as expected reduce the sum
            total += surprise - self._usual - math.sqrt(variance)
            if total > most:
                most, begin = total, t
        return begin


class BurstMonitor:
    """Estimates how strongly successive reads of a tag are correlated, for example because a person is in the way.

    The measure is the overdispersion: the variance of the number of reads in a time block, divided by its value for
    independent reads (McCullagh and Nelder, "Generalized linear models", 1989, section 4.5). If it is n, n correlated
    rounds have as much information as one independent round. ``antennas``, ``tags``: numbers of antennas and tags.
    """

    def __init__(self, antennas: int, tags: int) -> None:
        # for each tag: reads minus expected reads in this block, and the variance of independent reads, by antenna
        self._cells = np.zeros((tags, 2, antennas))
        self._tags = NO_TAGS  # tags whose cells are not zero
        self._sums = np.full(2, PRIOR)  # sums of squared differences and of variances over all blocks
        self._begun = -math.inf
        self._last = -math.inf

    @property
    def overdispersion(self) -> float:
        """The estimated overdispersion, 1 for independent reads. Values only a little above 1 are replaced by 1."""
        ratio = float(self._sums[0] / self._sums[1])
        return ratio if ratio > INDEPENDENT else 1.0

    def add(self, t: float, measured: TagReadCounts, reads: ExpectedReads, counts: NDArray[np.bool_]) -> None:
        """Add a scan at ``t`` [s]. It is ignored if it is not later than the last added scan. ``measured``: the
        antennas and rounds of the scan. ``reads``: observed and expected reads of C tags. ``counts`` (C,): a mask of
        the tags to use."""
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
        """Discard the scans of the current time block. Call this if the estimated pose was wrong."""
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
    """Add the reads of C ``tags`` by K ``antennas`` to ``cells`` (tags, 2, antennas): the differences of observed and
    expected reads, and their variances. ``rounds`` (K,): numbers of rounds. ``hits`` (K, C): numbers of reads. ``p``
    (K, C): the probability of a read in one round. ``counts`` (C,): a mask of the tags to use."""
    for c in range(len(tags)):
        for k in range(len(antennas)):
            if counts[c] and p[k, c] > POSSIBLE:
                cells[tags[c], 0, antennas[k]] += hits[k, c] - rounds[k] * p[k, c]
                cells[tags[c], 1, antennas[k]] += rounds[k] * p[k, c] * (1.0 - p[k, c])


@compiled
def _taken(cells: Array, tags: Integers) -> tuple[float, float]:
    """Return the sum of squared differences of observed and expected reads of ``tags`` (indices), and the sum of their
    variances. Also set the elements of these tags in ``cells``, the table of :func:`_count`, to zero."""
    squares = variances = 0.0
    for t in tags:
        for a in range(cells.shape[2]):
            squares += cells[t, 0, a] ** 2
            variances += cells[t, 1, a]
            cells[t, 0, a] = cells[t, 1, a] = 0.0
    return squares, variances


BAND, BANDS = 1.0, 50  # width [m] and number of distance bands; the last band has no upper limit
FEWEST = 30.0  # minimum number of predicted reads of a group
SHOWN = 4  # number of groups that a message names
DIFFERENT = 0.15  # relative errors of the predicted reads up to this are accepted
TINY = 1e-9  # replaces zero reads in a logarithm
WINDOW = 15.0  # s; the weight of reads falls to 1/e in this time
DOUBTED, TRUSTED = 1e-5, 1e-3  # the model is rejected below the p-value DOUBTED and accepted again above TRUSTED
# an antenna is dead if MANY reads are predicted, and less than the fraction NEARLY_NONE of the predicted reads occurs
MANY, NEARLY_NONE = 12.0, 0.05
KNOWN = BAND / 4.0  # m; maximum standard deviation of the position for a scan that is counted


@dataclass(frozen=True, eq=False)
class ReadGroups:
    """Sums of observed and predicted reads in G groups. There is one group for each interval of the distance between
    antenna and tag. Then follows one group for each of the ``antennas``. ``sums`` (3, G): observed reads, predicted
    reads, and the variance of observed reads if rounds are independent."""

    antennas: Sequence[str]
    sums: Array = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "sums", np.zeros((3, BANDS + len(self.antennas))))

    def add(self, antennas: Integers, rounds: Integers, reads: ExpectedReads, counts: NDArray[np.bool_]) -> None:
        """Add the observed and predicted ``reads`` of C tags by K ``antennas`` to ``sums``. ``rounds`` (K,): the number
        of rounds of each antenna. ``counts`` (K, C): a mask of the reads to use."""
        _add(self.sums, antennas, rounds, reads.hits, reads.p, reads.distance, counts)

    def large(self, fewest: float = FEWEST) -> Integers:
        """Return the column indices in ``sums`` of the groups with at least ``fewest`` predicted reads. If there is
        only one antenna, the group of this antenna is omitted."""
        count = len(self.sums[1]) if len(self.antennas) > 1 else BANDS
        return np.flatnonzero(self.sums[1, :count] >= fewest)

    def names(self, groups: Integers) -> list[str]:
        """Return a name for each of ``groups`` (column indices in ``sums``), such as "0 to 1 m" or "antenna left"."""
        bands = [f"{b * BAND:g} to {(b + 1) * BAND:g} m" for b in range(BANDS)]
        return [(bands + [f"antenna {name}" for name in self.antennas])[g] for g in groups.tolist()]

    def shares(self, groups: Integers) -> str:
        """Return a text with the ratio of observed to predicted reads, such as "antenna left: 0.42". It names up to
        :data:`SHOWN` of the ``groups`` (column indices in ``sums``), those with the largest errors, worst first."""
        observed, predicted, variance = self.sums[:, groups]
        worst = np.argsort(-np.abs(observed - predicted) / np.sqrt(variance), kind="stable")[:SHOWN]
        names = self.names(groups[worst])
        return ", ".join(f"{name}: {observed[i] / predicted[i]:.2f}" for name, i in zip(names, worst, strict=True))


class ConsistencyMonitor:
    """Tests if recent reads agree with the detection models. ``doubted``: True while they disagree.

    Two chi-square tests compare observed and predicted reads: one by distance intervals, the other by antennas. Groups
    with few predicted reads are merged. The models are rejected if a test fails and relative errors exceed DIFFERENT.
    """

    def __init__(self, antennas: Sequence[str]) -> None:
        self._groups = ReadGroups(antennas)
        self._last = -math.inf
        self.doubted = False

    def add(
        self, t: float, measured: TagReadCounts, reads: ExpectedReads, counts: NDArray[np.bool_], overdispersion: float
    ) -> None:
        """Add a scan at ``t`` [s], and update ``doubted``. It is ignored if it is not later than the last added scan.
        ``measured``: the antennas and rounds of the scan. ``reads``: observed and expected reads of C tags by K
        antennas. ``counts`` (K, C): a mask of the reads to use. ``overdispersion``: n correlated rounds have the
        information of n / ``overdispersion`` rounds."""
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
        """Return the p-value of the observed reads if the model is correct, or 1 if the relative error is at most
        DIFFERENT. ``groups``: the columns of :attr:`ReadGroups.sums` to test. ``overdispersion``: the number of
        correlated rounds that count as one."""
        observed, predicted, variance = _merged(self._groups.sums[:, groups], FEWEST)
        off = observed - predicted
        if np.sum(np.abs(off)) <= DIFFERENT * np.sum(predicted):
            return 1.0
        # the deviance is also chi-square distributed for few reads (McCullagh and Nelder, 1989, section 2.3)
        deviance = 2.0 * (observed * np.log(np.maximum(observed, TINY) / predicted) - off) * predicted / variance
        return float(chi_squared.survival(np.sum(deviance) / overdispersion, len(off)))

    @property
    def shares(self) -> str:
        """A text with ratios of observed to predicted reads, for antennas and distances with the largest errors."""
        groups = self._groups.large()
        return self._groups.shares(groups if len(groups) else self._groups.large(1.0))

    def dead_antennas(self, overdispersion: float) -> list[int]:
        """Return the indices of antennas that read nearly nothing although more than :data:`MANY` independent reads
        were predicted. ``overdispersion``: the number of correlated reads that count as one independent read."""
        observed, predicted, _ = self._groups.sums[:, BANDS:]
        return np.flatnonzero((predicted > MANY * overdispersion) & (observed < NEARLY_NONE * predicted)).tolist()

    def clear(self) -> None:
        """Discard all stored reads. Call this if the estimated pose was wrong or the model has changed."""
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
    """Add reads of C tags by K ``antennas`` to the ``sums`` of :class:`ReadGroups`. ``rounds`` (K,): numbers of rounds.
    ``hits`` (K, C): numbers of reads. ``p`` (K, C): probability of a read in one round. ``distance`` (K, C): distance
    of antenna and tag [m]. ``counts`` (K, C): a mask of the reads to use."""
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
    """Return sums (3, H) after merging neighbouring groups until each has at least ``least`` predicted reads.

    ``sums`` (3, G): see :class:`ReadGroups`. Groups are merged from the last to the first. H is 0 if all groups
    together have too few predicted reads.
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
