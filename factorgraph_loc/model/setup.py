"""The common arguments of all estimators, and the frame of their map.

If a map was made without a reference, its frame has an error that all estimates in the map share.
"""

from __future__ import annotations

from collections.abc import Callable, Container
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from factorgraph_loc.model.belief import Belief, PoseEstimate, PosePrior
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.sections import as_only, kind_of
from factorgraph_loc.model.settings import SensorSettings
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factors.se2 import Array


@dataclass(frozen=True)
class Setup:
    """The common arguments of all estimators. ``rig``: the robot. ``world``: the map. ``sensors``: the names of the
    sensors to use. ``rng``: a random generator."""

    rig: Rig
    world: World
    sensors: tuple[str, ...]
    rng: np.random.Generator

    def alone(self, sensor: str) -> Setup:
        """Return these arguments with ``sensor`` as the only sensor of its kind, see
        :meth:`~factorgraph_loc.model.rig.Rig.alone`."""
        return replace(self, rig=self.rig.alone(sensor), sensors=tuple(as_only(self.sensors, sensor)))


MapUse = Literal["known", "extended", "unknown"]
# which uncertain calibration constants an estimator estimates: all, those that may differ between particles, or none
Calibration = Literal["all", "particles", "none"]


@dataclass(frozen=True)
class MapFrame:
    """Accounts for the error of a map's position in the world. Its covariance is added to priors and to estimates.

    ``error``: a function from poses (N, 3) to covariances (N, 3, 3) of the error (x, y, heading), or None.
    """

    error: Callable[[Array], Array] | None = None

    @classmethod
    def of(cls, setup: Setup, modalities: Container[str], landmarks: MapUse) -> MapFrame:
        """Return the map error of a run, from the settings of its sensors.

        ``modalities``: the kinds of sensors that the estimator uses. ``landmarks``: how the estimator uses the map.
        """
        for name in setup.sensors if landmarks != "unknown" else ():
            settings = setup.rig.section(name) if kind_of(name) in modalities else None
            error = settings.map_error(setup.world) if isinstance(settings, SensorSettings) else None
            if error is not None:
                return cls(error)
        return cls()

    def prior(self, prior: PosePrior) -> PosePrior:
        """Return a prior in the world frame converted to the map frame: the covariance of the map error is added."""
        if self.error is None:
            return prior
        return replace(prior, covariance=prior.covariance + self.error(prior.pose[None])[0])

    def estimate(self, estimate: PoseEstimate) -> PoseEstimate:
        """Return an estimate in the map frame converted to the world frame, by adding the covariance of the map
        error."""
        if self.error is None or estimate.status == "unlocalized":
            return estimate
        return replace(estimate, covariance=estimate.covariance + self.error(estimate.pose[None])[0])

    def belief(self, belief: Belief) -> Belief:
        """Return a belief with the map error's covariance added to its modes. Limitation: the particles do not
        change."""
        if self.error is None:
            return belief
        modes = (replace(m, covariance=m.covariance + self.error(m.pose[None])[0]) for m in belief.modes)
        return replace(belief, modes=tuple(modes))

    def trajectory(self, trajectory: Trajectory) -> Trajectory:
        """Return a trajectory with the covariance of the map error added to its covariances."""
        if self.error is None or trajectory.covariances is None or not len(trajectory):
            return trajectory
        return replace(trajectory, covariances=trajectory.covariances + self.error(trajectory.poses))
