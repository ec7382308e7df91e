"""Estimates in a map that was made without a reference, as estimates in the world.

An estimator works in the frame of its map. Where that is bent, as the trajectory was that the map was made with, an estimate is as
wrong in the world, however well it is known in the map: that is added to the covariances that are told, and to that of the start,
which is known in the world.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container
from dataclasses import dataclass, replace
from functools import partial

from factorgraph_loc.maps.common_error import CommonError
from factorgraph_loc.model.belief import Belief, PoseEstimate, PosePrior
from factorgraph_loc.model.setup import MapUse, Setup
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factors.se2 import Array


@dataclass(frozen=True)
class MapFrame:
    """``error``: the covariances (N, 3, 3) of (x, y, heading) of the map's frame at poses (N, 3); None where it is exact."""

    error: Callable[[Array], Array] | None = None

    @classmethod
    def of(cls, setup: Setup, modalities: Container[str], landmarks: MapUse) -> MapFrame:
        """That of a run; ``modalities``: of measurements that the estimator takes, ``landmarks``: how it uses the map."""
        points, camera = setup.world.points, setup.rig.find(CameraSettings)
        used = "camera" in setup.sensors and "camera" in modalities and landmarks != "unknown"
        if points is None or camera is None or not used or (common := CommonError.of(points)) is None:
            return cls()
        ahead = camera.model().rotation[:, 2]
        return cls(partial(common.at, looking=math.atan2(ahead[1], ahead[0])))

    def prior(self, prior: PosePrior) -> PosePrior:
        """A start in the world, as one in the map."""
        if self.error is None:
            return prior
        return replace(prior, covariance=prior.covariance + self.error(prior.pose[None])[0])

    def estimate(self, estimate: PoseEstimate) -> PoseEstimate:
        """An estimate in the map, as one in the world."""
        if self.error is None or estimate.status == "unlocalized":
            return estimate
        return replace(estimate, covariance=estimate.covariance + self.error(estimate.pose[None])[0])

    def belief(self, belief: Belief) -> Belief:
        """The same of a belief; particles stay in the map."""
        if self.error is None:
            return belief
        modes = (replace(m, covariance=m.covariance + self.error(m.pose[None])[0]) for m in belief.modes)
        return replace(belief, modes=tuple(modes))

    def trajectory(self, trajectory: Trajectory) -> Trajectory:
        """The same of a trajectory."""
        if self.error is None or trajectory.covariances is None or not len(trajectory):
            return trajectory
        return replace(trajectory, covariances=trajectory.covariances + self.error(trajectory.poses))
