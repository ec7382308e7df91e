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
    """The common arguments of all estimators. ``rig``: the robot with the settings of its sensors. ``world``: the map.
    ``sensors``: the names of the sensors to use. ``rng``: a random generator."""

    rig: Rig
    world: World
    sensors: tuple[str, ...]
    rng: np.random.Generator

    def alone(self, sensor: str) -> Setup:
        """Return these arguments with ``sensor`` as the only sensor of its kind, renamed to the kind. For example
        ``bearing_range.front`` becomes ``bearing_range``."""
        return replace(self, rig=self.rig.alone(sensor), sensors=tuple(as_only(self.sensors, sensor)))


MapUse = Literal["known", "extended", "unknown"]
# which uncertain calibration constants an estimator estimates: all, those that may differ between particles, or none
Calibration = Literal["all", "particles", "none"]


@dataclass(frozen=True)
class MapFrame:
    """The error of a map's position and heading in the world. Methods add its covariance to priors and estimates.
    ``error``: a function from poses (N, 3) to covariances (N, 3, 3) of this error (x, y, heading) at the poses. None
    means that the map has no error."""

    error: Callable[[Array], Array] | None = None

    @classmethod
    def of(cls, setup: Setup, modalities: Container[str], landmarks: MapUse) -> MapFrame:
        """Return the map error of a run, from the settings of the first used sensor that define one.

        ``setup``: has the settings and names of the sensors, and the map. ``modalities``: the kinds of sensors that the
        estimator uses. ``landmarks``: "known", "extended" (landmarks are added to the map) or "unknown". There is no
        map error if it is "unknown".
        """
        for name in setup.sensors if landmarks != "unknown" else ():
            settings = setup.rig.section(name) if kind_of(name) in modalities else None
            error = settings.map_error(setup.world) if isinstance(settings, SensorSettings) else None
            if error is not None:
                return cls(error)
        return cls()

    def prior(self, prior: PosePrior) -> PosePrior:
        """Return the prior with the covariance of the map error at its pose added. The pose does not change."""
        if self.error is None:
            return prior
        return replace(prior, covariance=prior.covariance + self.error(prior.pose[None])[0])

    def estimate(self, estimate: PoseEstimate) -> PoseEstimate:
        """Return the estimate with the covariance of the map error at its pose added. The pose does not change. An
        estimate with the status "unlocalized" is returned unchanged."""
        if self.error is None or estimate.status == "unlocalized":
            return estimate
        return replace(estimate, covariance=estimate.covariance + self.error(estimate.pose[None])[0])

    def belief(self, belief: Belief) -> Belief:
        """Return the belief with the covariance of the map error added to the covariance of each mode. The poses do not
        change. Limitation: the particles are not changed, so they lack the error of the map."""
        if self.error is None:
            return belief
        modes = (replace(m, covariance=m.covariance + self.error(m.pose[None])[0]) for m in belief.modes)
        return replace(belief, modes=tuple(modes))

    def trajectory(self, trajectory: Trajectory) -> Trajectory:
        """Return the trajectory with the covariance of the map error added at each pose. The poses do not change."""
        if self.error is None or trajectory.covariances is None or not len(trajectory):
            return trajectory
        return replace(trajectory, covariances=trajectory.covariances + self.error(trajectory.poses))
