"""Images of a building as a camera takes them: its lens, its exposure, its noise, and the blur of its motion."""

from __future__ import annotations

import math

import gtsam
import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.simulation import raycasting
from factorgraph_loc.simulation.raycasting import Surroundings
from factorgraph_loc.simulation.scene import Scene
from factorgraph_loc.simulation.settings import ImageSettings
from factors import reprojection
from factors.reprojection import CameraModel
from factors.se2 import Array

Image = NDArray[np.uint8]
STEP = 2.0  # px between the sub-images whose mean is a blurred one, so that no edge shows twice
MOST_STEPS = 16
CHECKED = 8  # by as many rows and columns of pixels the motion is judged
STILL: Array = np.zeros(3)


class Renderer:
    """A camera of a ``model`` in a ``scene``. Poses are of the camera in the world: ``position`` (3,) and ``rotation`` (3, 3), as
    of :func:`factors.reprojection.camera_pose` for a robot on the floor."""

    def __init__(self, scene: Scene, model: CameraModel, settings: ImageSettings | None = None) -> None:
        self.scene, self.model, self.settings = scene, model, settings or ImageSettings()
        v, u = np.mgrid[: model.height, : model.width]
        pixels = np.column_stack((u.ravel(), v.ravel()))
        shape = (model.height, model.width)
        self._directions = reprojection.undistorted(model, pixels).reshape(*shape, 2)
        radius = np.hypot(*(self._directions.reshape(-1, 2).T)).reshape(shape)
        self._vignette = (1.0 - self.settings.vignetting * (radius / radius.max()) ** 2).astype(np.float32)
        self._size = np.array((scene.width, scene.depth, scene.height, 1.0 / scene.width, 1.0 / scene.depth))
        self._found = np.empty(shape, dtype=np.int16)

    def image(
        self,
        position: Array,
        rotation: Array,
        *,
        velocity: Array = STILL,
        turn: Array = STILL,
        gain: float = 1.0,
        rng: np.random.Generator | None = None,
    ) -> Image:
        """BGR (H, W, 3). ``velocity`` (3,) [m/s] and ``turn`` (3,) [rad/s] of the camera in the world's frame blur the image; the
        pose is that in the middle of the exposure. ``gain``: of the brightness. Without ``rng`` there is no noise."""
        shape = (self.model.height, self.model.width, 3)
        light = np.zeros(shape, dtype=np.float32)
        shifts = self._moments(position, rotation, velocity, turn)
        for t in shifts.tolist():
            self._expose(position + t * velocity, _turned(rotation, t * turn), light)
        noise = np.zeros(shape, dtype=np.float32) if rng is None else rng.standard_normal(shape, dtype=np.float32)
        s = self.settings
        brightness = np.float32(gain / len(shifts)) * self._vignette
        read, shot = (s.read_noise, s.shot_noise) if rng is not None else (0.0, 0.0)
        return np.asarray(raycasting.develop(light, brightness, noise, read, shot))

    def hits(self, pixels: Array, position: Array, rotation: Array) -> Array:
        """The points (K, 3) of the world that ``pixels`` (K, 2) show, NaN where they show nothing."""
        directions = reprojection.undistorted(self.model, np.asarray(pixels, dtype=float).reshape(-1, 2))
        rays = np.column_stack((directions, np.ones(len(directions)))) @ rotation.T
        distance = raycasting.cast_all(self._surroundings(position), rays)
        distance[np.isinf(distance)] = np.nan
        return np.asarray(position + distance[:, None] * rays)

    def depths(self, position: Array, rotation: Array) -> Array:
        """How far along the optical axis each pixel's point is (H, W) [m], infinite where there is none."""
        directions = self._directions.reshape(-1, 2)
        rays = np.column_stack((directions, np.ones(len(directions)))) @ rotation.T
        distance = raycasting.cast_all(self._surroundings(position), rays)
        return np.asarray(distance.reshape(self._directions.shape[:2]))

    def _moments(self, position: Array, rotation: Array, velocity: Array, turn: Array) -> Array:
        """Times (M,) of the sub-images, about the middle of the exposure."""
        exposure = self.settings.exposure
        u = np.linspace(0.0, self.model.width - 1.0, CHECKED)
        v = np.linspace(0.0, self.model.height - 1.0, CHECKED)
        pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        if not (velocity.any() or turn.any()):
            return np.zeros(1)
        points = self.hits(pixels, position, rotation)
        later = _turned(rotation, exposure * turn)
        moved = reprojection.project(self.model, (points - position - exposure * velocity) @ later)
        far = np.hypot(*(moved - pixels).T)
        longest = float(far[np.isfinite(far)].max(initial=0.0))
        count = min(max(1, math.ceil(longest / STEP)), MOST_STEPS)
        return np.asarray(exposure * ((np.arange(count) + 0.5) / count - 0.5))

    def _expose(self, position: Array, rotation: Array, light: NDArray[np.float32]) -> None:
        scene = self.scene
        pixel_at_one = 2.0 / (self.model.fx + self.model.fy) / scene.texel
        around = self._surroundings(position)
        view = self._directions, rotation, pixel_at_one
        raycasting.expose(around, scene.texels, scene.layout, *view, self._found, light)

    def _surroundings(self, position: Array) -> Surroundings:
        scene = self.scene
        place = np.asarray(position, dtype=float)
        found: Surroundings = raycasting.surroundings(
            scene.faces, scene.bottoms, scene.tops, scene.lids, place, self._size
        )
        return found


def _turned(rotation: Array, turn: Array) -> Array:
    """``rotation`` (3, 3) after a turn (3,) [rad] about the world's axes."""
    return np.ascontiguousarray(np.asarray(gtsam.Rot3.Expmap(turn).matrix()) @ rotation)
