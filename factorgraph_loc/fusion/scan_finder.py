"""Where the robot is from scans of RFID tags, for graphs: the hypotheses of a :class:`Seeker`, beside the track's own evidence.

Before the start every scan goes to a seeker. On the way scans are kept; when the track comes under suspicion a seeker takes those
since then, and refutes the track if "somewhere else" has become so much likelier than it, by what both predict of the scans.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from factorgraph_loc.fusion.known_position import KnownPosition
from factorgraph_loc.fusion.search import Seeker
from factorgraph_loc.model.belief import Mode, PosePrior
from factorgraph_loc.sensors.odometry.motion import Motion
from factors import positive, se2
from factors.motion import ChainState
from factors.rfid.detection import Looks, RfidLikelihood
from factors.se2 import Array

DURATION = 60.0  # s of scans that are kept
REFUTING = 8.0  # log of the odds that a track must lose by: kidnappings are rare
BEFORE = 2.0  # s before a suspicion in which a change may lie
APART = 16.0  # squared Mahalanobis distance to the track, beyond which it is another place


class ScanFinder:
    """Hypotheses from scans; see the module. ``bounds`` (2, 2): corners [m] of where the robot may be."""

    def __init__(self, likelihood: RfidLikelihood, motion: Motion, bounds: Array, rng: np.random.Generator) -> None:
        self._likelihood, self._motion, self._bounds, self._rng = likelihood, motion, bounds, rng
        self._scans: deque[tuple[ChainState, Looks, float]] = deque()
        self._seeker: Seeker | None = self._new_seeker()
        self._since = -np.inf

    def begin(self, start: KnownPosition) -> None:
        """Seek the heading of a start whose position is known."""
        self._seeker = self._new_seeker(start)

    @property
    def hypotheses(self) -> tuple[Mode, ...]:
        """The places where the robot may be, the likeliest first."""
        return self._seeker.hypotheses if self._seeker is not None else ()

    @property
    def best(self) -> PosePrior | None:
        """The pose at the last scan if one hypothesis is clear, else None."""
        return self._seeker.best if self._seeker is not None else None

    @property
    def particles(self) -> tuple[Array, Array]:
        """Poses (N, 3) at the last scan and their weights (N,); none where nothing is sought."""
        return self._seeker.particles if self._seeker is not None else (np.empty((0, 3)), np.empty(0))

    def add(self, odometry: ChainState, looks: Looks, evidence: float = 0.0) -> bool:
        """Take a scan; ``evidence``: log-probability of it under the track, where there is one. Scans from its time on that were
        taken before are forgotten. False if no seeker took it."""
        while self._scans and self._scans[-1][0].t >= odometry.t:
            self._scans.pop()
        self._scans.append((odometry, looks, evidence))
        while self._scans[0][0].t < odometry.t - DURATION:
            self._scans.popleft()
        return self._seeker is not None and self._seeker.add(odometry, looks)

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Poses (N, 3) at the last scan, drawn from all hypotheses; none where nothing is sought."""
        return self._seeker.sample(rng, count) if self._seeker is not None else np.empty((0, 3))

    def seek(self, since: float) -> None:
        """Look for another place from the scans since then, if that has not begun."""
        if self._seeker is None:
            self._seeker, self._since = self._new_seeker(), since
            for odometry, looks, _ in self._scans:
                if odometry.t >= since:
                    self._seeker.add(odometry, looks)

    def start(self) -> None:
        """A track begins at the best hypothesis, with the scans again that led to it."""
        self._scans.clear()
        self.rest()

    def rest(self) -> None:
        """The track is trusted."""
        self._seeker = None

    def refutes(self, pose: Array, covariance: Array) -> bool:
        """Whether another place than ``pose`` (3,), body-frame ``covariance`` (3, 3), explains the scans much better."""
        if self._seeker is None or (best := self._seeker.best) is None or not self._is_apart(best, pose, covariance):
            return False
        track = sum(evidence for odometry, _, evidence in self._scans if odometry.t >= self._since)
        return self._seeker.log_evidence - track > REFUTING

    def confirms(self, pose: Array, covariance: Array) -> bool:
        """Whether the scans alone lead to the track's place."""
        best = self.best
        return best is not None and not self._is_apart(best, pose, covariance)

    def change(self, place: Callable[[float], Array]) -> float:
        """When the robot must have come to the other place, of which ``place(t)`` gives the pose (3,) at ``t``: from then on scans
        are likelier there, before on the track."""
        scans = [s for s in self._scans if s[0].t >= self._since - BEFORE]
        gains = [-float(self._likelihood.score(place(s[0].t), s[1]).nll[0]) - s[2] for s in scans]
        return scans[int(np.argmax(np.cumsum(gains[::-1])[::-1]))][0].t

    @staticmethod
    def _is_apart(best: PosePrior, pose: Array, covariance: Array) -> bool:
        error = se2.log(se2.between(pose, best.pose))
        spread = covariance + se2.world_to_body(best.pose, best.covariance)
        return float(error @ positive.solve(spread, error[:, None])[:, 0]) > APART

    def _new_seeker(self, start: KnownPosition | None = None) -> Seeker:
        return Seeker(self._likelihood, self._motion, self._bounds, self._rng, start)
