"""Detection of a lost track by the innovations of landmarks."""

import numpy as np

from factors import positive
from factors.se2 import Array
from factors.update import GATE, SightingFactor

STAMPS, DURATION = 4, 2.0  # minimum number of timestamps, and their duration in s
KEPT = 100  # timestamps
BEYOND = 2.0  # times the gate
SHARE = 0.6  # of the landmarks


class TrackMonitor:
    """Detects that most landmarks of the last timestamps are far outside the gate.

    That is only a suspicion, because a wrong map looks the same. A :class:`Relocalizer` tells whether there is a better pose.
    """

    def __init__(self) -> None:
        self._stamps: list[tuple[float, int, int]] = []
        self._since: float | None = None

    @property
    def suspicious_since(self) -> float | None:
        """The time since which most landmarks are outside, or None."""
        return self._since

    def add(self, t: float, seen: SightingFactor, pose: Array, covariance: Array) -> None:
        """Add the landmarks of a timestamp, with the predicted ``pose`` (3,) and its body-frame ``covariance`` (3, 3)."""
        residual, (jacobian,) = seen.whitened([pose])
        spread = np.eye(2) + jacobian @ covariance @ jacobian.transpose(0, 2, 1)
        squared = positive.squared(residual, spread)
        self._stamps = [s for s in self._stamps if s[0] < t][-KEPT:]
        self._stamps.append((t, int(np.count_nonzero(squared > BEYOND * GATE)), len(squared)))
        last = self._last()
        share = sum(s[1] for s in last) / max(1, sum(s[2] for s in last))
        if share > SHARE or (self._since is not None and share >= SHARE / 2.0):
            self._since = self._beginning()
        else:
            self._since = None

    def clear(self) -> None:
        """Forget the history: a new track starts."""
        self._stamps.clear()
        self._since = None

    def _beginning(self) -> float:
        """The change point: it maximises the number of landmarks outside after and inside before it."""
        excess = np.array([2 * beyond - count for _, beyond, count in self._stamps])
        return self._stamps[int(np.argmax(np.cumsum(excess[::-1])[::-1]))][0]

    def _last(self) -> list[tuple[float, int, int]]:
        """The fewest last timestamps that are sufficient, empty if there are too few."""
        for i in range(len(self._stamps) - STAMPS, -1, -1):
            if self._stamps[i][0] <= self._stamps[-1][0] - DURATION:
                return self._stamps[i:]
        return []
