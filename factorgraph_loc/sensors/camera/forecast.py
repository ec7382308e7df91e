"""Expected information of a camera that sees points of the map, for path planning."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from factorgraph_loc.maps.free_space import crosses
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.camera.simulation_settings import PixelSettings
from factorgraph_loc.sensors.interfaces import Array32, Places
from factors.camera import model as reprojection
from factors.camera.model import CameraModel
from factors.se2 import Array

IMAGES_PER_SECOND = 2.0  # default rate


@dataclass(frozen=True, eq=False)
class CameraForecast:
    """A :class:`~factorgraph_loc.sensors.interfaces.Forecast` for images, ``looks_per_metre``; visibility follows ``settings`` and
    walls. It draws no simulated images, so particles are not weighed."""

    world: World
    model: CameraModel
    looks_per_metre: float = 4.0
    settings: PixelSettings = field(default_factory=PixelSettings)
    goals: Array = field(default_factory=lambda: np.empty((0, 2)))

    def information(self, poses: Array, ways: Array) -> Array:
        """Information of the visible points."""
        looks = (self.looks_per_metre * ways)[:, None, None]
        return np.asarray(looks * np.array([self._of_image(pose) for pose in poses]).reshape(-1, 3, 3))

    def add_log_weights(self, poses: Array, metres: float, stops: Places, seed: np.uint64, out: Array32) -> None:
        """Nothing."""

    def _of_image(self, pose: Array) -> Array:
        """Information (3, 3) of one image taken at pose (3,)."""
        model, points = self.model, self.world.points
        assert points is not None, "a camera has points to look at"
        pixels, depth = reprojection.predict(model, pose, points.positions)
        near = np.flatnonzero((depth > 0.0) & (depth <= self.settings.max_depth) & model.contains(pixels))
        eye, _ = reprojection.camera_pose(model, pose)
        ends = points.positions[near, :2]
        seen = near[~crosses(self.world, np.broadcast_to(eye[:2], (len(near), 2)), ends)]
        _, by_pose, _, _ = reprojection.linearize(model, pose, points.positions[seen])
        share = min(1.0, self.settings.max_points / max(len(seen), 1))
        weight = share * model.tempering / model.sigma**2
        return np.asarray(weight * np.einsum("kia,kib->ab", by_pose, by_pose))


def forecast(world: World, rig: Rig, speed: float, settings: Any = None) -> CameraForecast | None:
    """The forecast for a robot with ``speed`` [m/s], with the rate of the simulation settings; None without a camera or points."""
    camera = rig.find(CameraSettings)
    if camera is None or world.points is None:
        return None
    pixels = PixelSettings(rate=IMAGES_PER_SECOND) if settings is None else settings.pixels
    return CameraForecast(world, camera.model(), pixels.rate / speed, pixels)
