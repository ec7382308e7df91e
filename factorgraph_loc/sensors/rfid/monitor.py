"""Whether a track is lost: told by what RFID antennas read and did not read."""

import itertools
import math
from collections import deque

DURATION = 5.0  # s over which scans are taken together
KEPT = 60.0  # s
SUSPICIOUS, CALM = 6.0, 3.0  # standard deviations: a suspicion arises above the one, and goes below the other
SCANS = 4  # at least


SILENT = 8.0  # log of the odds against a silence at which it is no longer taken for one of the place


class Silence:
    """Whether no tag is read where tags should be: then the reader or the tags have failed, and not to read them tells nothing
    of the place, while it would drive an estimate to wherever no tags are."""

    EVENT = "no tag is read where some should be"
    REJECTED = "rfid: no tag read where some should be"

    def __init__(self) -> None:
        self._evidence = 0.0

    @property
    def lasts(self) -> bool:
        """Whether the last scan was one of such a silence."""
        return self._evidence < -SILENT

    def add(self, reads: int, evidence: float) -> bool:
        """Take a scan with so many reads, and the log-probability of it at the predicted pose; True in a silence."""
        self._evidence = 0.0 if reads else self._evidence + evidence
        return self.lasts


class ScanMonitor:
    """Whether scans are much less likely than they would be if the track were right.

    That is a suspicion: dead tags and a wrong map look the same. Whether there is a better place a :class:`Seeker` tells.
    """

    def __init__(self) -> None:
        self._scans: deque[tuple[float, float, float]] = deque()
        self._since: float | None = None
        self._usual = 0.0  # the mean surprise that was found to mean nothing

    @property
    def suspicious_since(self) -> float | None:
        """When the scans began to be unlikely [s], None if all is well."""
        return self._since

    def add(self, t: float, surprise: float, variance: float) -> None:
        """Take a scan: how much larger its negative log-likelihood is than expected, and the variance of that, both at the
        predicted pose. Scans from ``t`` on that were taken before are forgotten."""
        while self._scans and self._scans[-1][0] >= t:
            self._scans.pop()
        self._scans.append((t, surprise, variance))
        while self._scans[0][0] < t - KEPT:
            self._scans.popleft()
        z = self._z()
        if z > SUSPICIOUS or (self._since is not None and z > CALM):
            self._since = self._beginning()
        else:
            self._since = None

    def accept(self) -> None:
        """The track is right all the same: the model or the map is not, and scans will go on to be as unlikely as the last ones."""
        last = self._last()
        self._usual = sum(s[1] for s in last) / max(len(last), 1)
        self._since = None

    def clear(self) -> None:
        """Forget the scans: the track begins anew."""
        self._scans.clear()
        self._since = None

    def _z(self) -> float:
        """The summed surprise of the last scans, in standard deviations."""
        last = self._last()
        if len(last) < SCANS:
            return 0.0
        return sum(s[1] - self._usual for s in last) / math.sqrt(sum(s[2] for s in last) + 1e-9)

    def _last(self) -> list[tuple[float, float, float]]:
        since = self._scans[-1][0] - DURATION if self._scans else 0.0
        return list(itertools.takewhile(lambda scan: scan[0] > since, reversed(self._scans)))

    def _beginning(self) -> float:
        """The change point: from there on the sum of the surprises is largest."""
        total, most, begin = 0.0, -math.inf, self._scans[-1][0]
        for t, surprise, variance in reversed(self._scans):
            # scans as they are expected count against
            total += surprise - self._usual - math.sqrt(variance)
            if total > most:
                most, begin = total, t
        return begin
