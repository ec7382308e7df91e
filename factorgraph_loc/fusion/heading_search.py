"""The search of a filter for the heading of its start: what is seen meanwhile is kept, and taken in once the heading is found."""

from __future__ import annotations

from collections import deque

import numpy as np

from factorgraph_loc.fusion.search import Search
from factorgraph_loc.model.belief import Belief, PosePrior
from factorgraph_loc.model.measurement import Measurement, Tick
from factorgraph_loc.sensors.known_position import START_KEPT, KnownPosition
from factorgraph_loc.sensors.motion import Motion
from factors import se2
from factors.se2 import Array

# The filter begins with a heading that has so many times the standard deviation with which it was found: what told it is taken in
# once more, so that a 16th of it counts twice. Without any heading the filter would be linearised far from the truth.
WIDENED = 4.0


class HeadingSearch:
    """The search of a heading at a known position; see the module."""

    def __init__(self, search: Search, motion: Motion, prior: PosePrior) -> None:
        self._search, self._motion = search, motion
        self.start = KnownPosition(prior, motion)
        search.begin(self.start)
        self._kept: deque[Measurement] = deque()

    def take(self, m: Measurement) -> PosePrior | None:
        """The start as a Gaussian, if one heading is clear with this measurement."""
        self._kept.append(m)
        while self._kept[0].t < m.t - START_KEPT:
            self._kept.popleft()
        told = self._search.advance(m.t) if isinstance(m, Tick) else self._search.look(m, self._motion.state(m.t))
        if not told:
            return None
        found = self._search.best
        return None if found is None else self._begun(found, m.t)

    def kept(self) -> list[Measurement]:
        """All that is to be taken in from the start on, in order of time; the search is over."""
        self._search.begin_track(found=True)
        return sorted(self._kept, key=lambda m: m.t)

    def belief(self, t: float) -> Belief:
        """What may be at ``t``: all headings, as far as nothing was seen."""
        return Belief(tuple(self._search.modes(t)))

    def _begun(self, found: PosePrior, now: float) -> PosePrior:
        """The start, or what is left of it, from the pose that was ``found``."""
        t = self.start.t if now <= self.start.t + START_KEPT else self._kept[0].t
        moved = self._motion.relative(self._motion.state(t), self._motion.state(found.t))
        pose: Array = se2.compose(found.pose, se2.inverse(moved.delta))
        covariance = WIDENED**2 * found.covariance
        covariance[2, 2] += WIDENED**2 * moved.covariance[2, 2]
        if t == self.start.t:
            known = np.diag((0.0, 0.0, covariance[2, 2]))
            known[:2, :2] = self.start.prior.covariance[:2, :2]
            pose, covariance = np.append(self.start.prior.pose[:2], pose[2]), known
        return PosePrior(t, pose, covariance)
