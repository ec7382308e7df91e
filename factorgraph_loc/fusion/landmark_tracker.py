"""Landmarks as a particle filter takes them in.

They weigh the particles, each with its own constants of the sensor. Where the place is not known, at an unknown start or once they
refute it, a share of the particles is drawn anew at each stamp (augmented Monte Carlo localization: Thrun, Burgard, Fox,
"Probabilistic Robotics", 2005, table 8.3), not anywhere but from what the last sightings tell
(:mod:`~factorgraph_loc.sensors.landmarks.finder`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from factorgraph_loc.fusion.cloud import Cloud
from factorgraph_loc.fusion.known_position import KnownPosition
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.model.variable import Estimated
from factorgraph_loc.sensors.landmarks.finder import Relocalizer
from factorgraph_loc.sensors.landmarks.measurement import BearingRange
from factorgraph_loc.sensors.landmarks.monitor import TrackMonitor
from factorgraph_loc.sensors.landmarks.sensor import KnownLandmarks
from factorgraph_loc.sensors.odometry.motion import Motion
from factors import positive, se2
from factors.landmarks import model as bearing_range
from factors.landmarks.factor import BearingRangeFactor
from factors.motion import ChainState
from factors.se2 import Array
from factors.update import robust_update

SLOW, FAST = 0.01, 0.1  # decay rates of the averages of the likelihood, per stamp
INJECTED = 0.05  # the least share that is drawn anew while the place is not known
ONE_PLACE, REACH = 0.98, 5.0  # the place is known when so much weight lies within so many standard deviations of it


class LandmarkTracker:
    """What landmarks make of a cloud; see the module. ``constants``: of the sensor, which are those of the particles from ``first``
    on."""

    def __init__(
        self, setup: Setup, motion: Motion, diagnostics: Diagnostics, constants: Estimated, *, first: int
    ) -> None:
        self._constants, self._part, self._rng = constants, slice(first, None), setup.rng
        self._landmarks = KnownLandmarks(setup, diagnostics, estimated=constants.indices)
        self._relocalizer = Relocalizer(motion, setup.world.positions())
        self._monitor = TrackMonitor()

    @property
    def known(self) -> bool:
        """Whether there is a landmark with a known place."""
        return self._landmarks.known

    def factor(self, m: BearingRange) -> BearingRangeFactor | None:
        """What was seen of landmarks of the map; None where that is nothing."""
        return self._landmarks.factor(m)

    def seek_from(self, start: KnownPosition | None) -> None:
        """Seek the heading of a start whose position is known; None: that is over."""
        self._relocalizer.start = start

    def seek(self, seen: BearingRangeFactor, odometry: ChainState) -> None:
        """Search with what was seen while no place is known at all."""
        self._relocalizer.add(odometry, self._expected(seen, np.zeros(len(self._constants.names))))
        self._relocalizer.search()

    def sample(self, count: int) -> Array:
        """Poses (N, 3) drawn from what the last sightings tell."""
        return self._relocalizer.sample(self._rng, count)

    def refuted_since(self, t: float, seen: BearingRangeFactor, odometry: ChainState, cloud: Cloud) -> float | None:
        """Since when the landmarks refute the place, if it is known and they do. Keeps them, and reports the innovation."""
        expected = self._expected(seen, cloud.weights @ cloud.constants[:, self._part])
        self._relocalizer.add(odometry, expected)
        if not cloud.localized:
            return None
        mean, covariance = cloud.moments
        covariance = se2.world_to_body(mean, covariance)
        self._landmarks.report(t, expected, robust_update(expected, mean, covariance, iterations=1))
        self._monitor.add(t, expected, mean, covariance)
        since = self._monitor.suspicious_since
        if since is None:
            return None
        self._relocalizer.forget(since)
        self._relocalizer.search()
        return since if self._relocalizer.refutes(mean, covariance) else None

    def log_likelihood(self, seen: BearingRangeFactor, cloud: Cloud) -> Array:
        """Of the particles (N,), each with its own constants."""
        changes = self._constants.full(cloud.constants[:, self._part], len(bearing_range.PARAMETERS))
        return seen.log_likelihood(cloud.poses, changes)

    def averaged(self, seen: BearingRangeFactor, cloud: Cloud) -> Cloud:
        """The same cloud with its averages of the likelihood, over many and over few stamps, after this one."""
        likelihood = float(cloud.weights @ np.exp(self.log_likelihood(seen, cloud) / len(seen.points)))
        slow = cloud.slow + SLOW * (likelihood - cloud.slow) if cloud.slow else likelihood
        fast = cloud.fast + FAST * (likelihood - cloud.fast) if cloud.fast else likelihood
        return replace(cloud, slow=slow, fast=fast)

    def injected(self, cloud: Cloud) -> Cloud:
        """Particles of equal weight, some drawn anew from the last sightings: the more, the less likely they are than they used to
        be."""
        share = max(INJECTED, 1.0 - cloud.fast / cloud.slow if cloud.slow > 0.0 else 0.0)
        chosen = self._rng.choice(len(cloud.poses), int(share * len(cloud.poses)), replace=False)
        poses = cloud.poses.copy()
        poses[chosen] = self.sample(len(chosen))
        return replace(cloud, poses=poses)

    def search(self) -> None:
        """See what the last sightings tell."""
        self._relocalizer.search()

    def settled(self, cloud: Cloud) -> bool:
        """Whether the place is known: the sightings tell it, and the particles are there."""
        best = self._relocalizer.best
        if best is None:
            return False
        error = cloud.poses - best.pose
        error[:, 2] = se2.wrap(error[:, 2])
        squared = np.sum(error * positive.solve(best.covariance, error.T).T, axis=1)
        if cloud.weights[squared < REACH**2].sum() < ONE_PLACE:
            return False
        self._monitor.clear()
        return True

    def _expected(self, seen: BearingRangeFactor, constants: Array) -> BearingRangeFactor:
        """The factor on the pose alone, of a sensor with these constants (P,)."""
        return seen.fixed([constants], None) if self._constants.names else seen
