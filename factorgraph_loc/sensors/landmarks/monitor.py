"""Whether a track is lost: told by the innovations of the landmarks."""

import numpy as np

from factors import positive
from factors.se2 import Array
from factors.update import GATE, Sightings

STAMPS, DURATION = 4, 2.0  # at least as many, over at least so many seconds
KEPT = 100  # stamps
BEYOND = 2.0  # times the gate
SHARE = 0.6  # of the landmarks


class TrackMonitor:
    """Whether the innovations of a track say that it is lost: most landmarks of the last stamps lie far beyond the gate.

    That is a suspicion: landmarks of a wrong map look the same. Whether there is a better place a :class:`Relocalizer` tells.
    """

    def __init__(self) -> None:
        self._stamps: list[tuple[float, int, int]] = []
        self._since: float | None = None

    @property
    def suspicious_since(self) -> float | None:
        """When most landmarks began to lie beyond, None if all is well."""
        return self._since

    def add(self, t: float, seen: Sightings, pose: Array, covariance: Array) -> None:
        """Take the landmarks of a stamp, with the ``pose`` (3,) predicted there and its body-frame ``covariance`` (3, 3)."""
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
        """Forget the stamps: the track begins anew."""
        self._stamps.clear()
        self._since = None

    def _beginning(self) -> float:
        """The change point: as many landmarks as can be beyond from there on, and within before."""
        excess = np.array([2 * beyond - count for _, beyond, count in self._stamps])
        return self._stamps[int(np.argmax(np.cumsum(excess[::-1])[::-1]))][0]

    def _last(self) -> list[tuple[float, int, int]]:
        """The fewest last stamps that are enough to judge by, none if there are too few."""
        for i in range(len(self._stamps) - STAMPS, -1, -1):
            if self._stamps[i][0] <= self._stamps[-1][0] - DURATION:
                return self._stamps[i:]
        return []
