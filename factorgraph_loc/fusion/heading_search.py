"""The search of a filter for the heading of its start: what is seen meanwhile is kept, and taken in once the heading is found."""

from __future__ import annotations

from collections import deque

import numpy as np

from factorgraph_loc.fusion.known_position import START_KEPT, KnownPosition
from factorgraph_loc.model.belief import Belief, Mode, PosePrior
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.measurement import Exteroceptive, Tick
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.sensors.camera.finder import PixelFinder
from factorgraph_loc.sensors.landmarks.finder import Relocalizer
from factorgraph_loc.sensors.landmarks.measurement import BearingRange
from factorgraph_loc.sensors.landmarks.sensor import KnownLandmarks
from factorgraph_loc.sensors.odometry.motion import Motion
from factorgraph_loc.sensors.rfid.measurement import RfidScan
from factors import se2
from factors.motion import ChainState
from factors.se2 import Array

# The filter begins with a heading that has so many times the standard deviation with which it was found: what told it is taken in
# once more, so that a 16th of it counts twice. Without any heading the filter would be linearised far from the truth.
WIDENED = 4.0


class HeadingSearch:
    """The search; see the module. ``camera``: finds poses from single frames."""

    def __init__(self, setup: Setup, motion: Motion, start: KnownPosition, camera: PixelFinder) -> None:
        self._motion, self.start, self._camera = motion, start, camera
        self._landmarks = KnownLandmarks(setup, Diagnostics())  # what is seen is counted when it is taken in
        self._relocalizer = Relocalizer(motion, setup.world.positions())
        self._relocalizer.start = camera.start = start
        self._searched: ChainState | None = None
        self._horizon = motion.horizon
        motion.keep(START_KEPT)
        self._kept: deque[Exteroceptive | Tick] = deque()

    def take(self, m: Exteroceptive | Tick) -> PosePrior | None:
        """The start as a Gaussian, if one heading is clear with this measurement."""
        self._kept.append(m)
        while self._kept[0].t < m.t - START_KEPT:
            self._kept.popleft()
        state = self._motion.state(m.t)
        found = None
        if isinstance(m, BearingRange):
            if (seen := self._landmarks.factor(m)) is not None:
                self._relocalizer.add(state, seen)
                self._relocalizer.search()
                self._searched, found = state, self._relocalizer.best
        elif not isinstance(m, Tick | RfidScan) and self._camera.look(m, state):
            found = self._camera.best
        return None if found is None else self._begun(found, m.t)

    def kept(self) -> list[Exteroceptive | Tick]:
        """All that is to be taken in from the start on, in order of time; the search is over."""
        self._camera.start = None
        self._motion.keep(self._horizon)
        self._camera.clear()
        return sorted(self._kept, key=lambda m: m.t)

    def belief(self, t: float) -> Belief:
        """What may be at ``t``: all headings, as far as nothing was seen."""
        now = self._motion.state(t)
        if self._searched is None or not self._relocalizer.hypotheses:
            return Belief((self.start.mode(now),))
        since = self._motion.relative(self._searched, now)
        return Belief(
            tuple(
                Mode(
                    h.weight,
                    se2.compose(h.pose, since.delta),
                    h.covariance + se2.body_to_world(h.pose, since.covariance),
                )
                for h in self._relocalizer.hypotheses
            )
        )

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
