"""The common arguments of all estimators, and the frame of their map, whose error all estimates in it have in common."""

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
    """The common arguments of all estimators: robot, map, usable sensors, and a random generator of their own."""

    rig: Rig
    world: World
    sensors: tuple[str, ...]
    rng: np.random.Generator

    def alone(self, sensor: str) -> Setup:
        """The arguments with one of several sensors as the only one of its kind (:meth:`~factorgraph_loc.model.rig.Rig.alone`);
        unchanged for an empty name."""
        return replace(self, rig=self.rig.alone(sensor), sensors=tuple(as_only(self.sensors, sensor)))


MapUse = Literal["known", "extended", "unknown"]
# which uncertain constants an estimator learns: all, those that may differ between particles, or none
Calibration = Literal["all", "particles", "none"]


@dataclass(frozen=True)
class MapFrame:
    """Moves estimates between the frame of a map and the world. ``error``: the covariances (N, 3, 3) of (x, y, heading) of the
    map's frame at poses (N, 3); None if the map is exact."""

    error: Callable[[Array], Array] | None = None

    @classmethod
    def of(cls, setup: Setup, modalities: Container[str], landmarks: MapUse) -> MapFrame:
        """The frame of a run, by the settings of its sensors. ``modalities``: those that the estimator uses; ``landmarks``: how it
        uses the map."""
        for name in setup.sensors if landmarks != "unknown" else ():
            settings = setup.rig.section(name) if kind_of(name) in modalities else None
            error = settings.map_error(setup.world) if isinstance(settings, SensorSettings) else None
            if error is not None:
                return cls(error)
        return cls()

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
