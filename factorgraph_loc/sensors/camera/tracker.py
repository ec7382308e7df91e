"""What a camera sees of known points as a particle filter takes it in.

Where the place is not known, or is refuted by what is seen, frames tell it (:mod:`~factorgraph_loc.sensors.camera.finder`). Else
which points are seen is decided once, at the mean of the cloud; what they tell weighs the particles. The constants of the camera
are those of the rig: what is not known of them widens the noise.
"""

from __future__ import annotations

import numpy as np

from factorgraph_loc.fusion.cloud import Cloud
from factorgraph_loc.fusion.known_position import KnownPosition
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.sensors.camera.finder import PixelFinder
from factorgraph_loc.sensors.camera.sensor import KnownPoints, Pixels, Predicted, pixel_update
from factorgraph_loc.sensors.odometry.motion import Motion
from factors import se2
from factors.camera import model as reprojection
from factors.camera.factor import ReprojectionFactor
from factors.camera.model import TIME_OFFSET
from factors.motion import ChainState
from factors.se2 import Array


class PixelTracker:
    """What pixels make of a cloud whose place is known; see the module."""

    def __init__(self, setup: Setup, motion: Motion, diagnostics: Diagnostics) -> None:
        self._constants = setup.rig.estimated("camera")
        self._spread = np.diag(self._constants.sigmas**2)
        self._points = KnownPoints(setup, diagnostics, self._constants, motion=motion)
        self._motion = motion
        self._finder = PixelFinder(self._points, motion)
        self._rng = setup.rng

    def seek_from(self, start: KnownPosition | None) -> None:
        """Seek the heading of a start whose position is known; None: that is over."""
        self._finder.start = start

    def seek(self, m: Pixels, odometry: ChainState) -> bool:
        """Take a frame while the place is not known; False where it tells nothing."""
        return self._finder.look(m, odometry)

    def sought(self, count: int) -> tuple[Array, bool]:
        """Poses (N, 3) drawn from what the last frame told, and whether it is one place."""
        clear = self._finder.best is not None
        poses = self._finder.sample(self._rng, count)
        if clear:
            self._finder.clear()
        return poses, clear

    def refuted_since(self, m: Pixels, odometry: ChainState, cloud: Cloud) -> float | None:
        """Since when the robot must have been elsewhere, after a frame that was taken; None where nothing tells that."""
        return self._finder.refuted_since(m, odometry, cloud.moments[0])

    def factor(self, m: Pixels, cloud: Cloud) -> ReprojectionFactor | None:
        """What was seen of points of the map; None where that is nothing. Reports the innovation."""
        mean, covariance = cloud.moments
        covariance = se2.world_to_body(mean, covariance)
        twist = self._motion.twist(m.t) if self._points.needs_twist else None
        unchanged = (np.zeros(len(self._spread)), self._spread) if self._constants.names else ()
        factor = self._points.factor(m, Predicted(mean, covariance, *unchanged), None, twist)
        if factor is not None:
            self._points.report(m.t, factor, pixel_update(factor, mean, covariance, *unchanged))
        return factor

    def log_likelihood(self, factor: ReprojectionFactor, cloud: Cloud) -> Array:
        """Of the particles (N,)."""
        spreads = None
        if factor.point_covariances is not None or self._constants.names:
            mean, _ = cloud.moments
            _, by_pose, by_point, by_constants = reprojection.linearize(factor.model, mean, factor.points)
            spreads = np.broadcast_to(factor.model.sigma**2 * np.eye(2), (len(by_point), 2, 2))
            if factor.point_covariances is not None:
                spreads = spreads + by_point @ factor.point_covariances @ by_point.transpose(0, 2, 1)
            if factor.twist is not None:
                by_constants[..., TIME_OFFSET] = by_pose @ factor.twist
            if self._constants.names:
                by_constants = by_constants[..., list(self._constants.indices)]
                # all pixels have this error in common: together they must not seem to be rid of it
                common = by_constants @ self._spread @ by_constants.transpose(0, 2, 1)
                spreads = spreads + len(common) * common
        return reprojection.log_likelihood(factor.model, cloud.poses, factor.points, factor.pixels, spreads)
