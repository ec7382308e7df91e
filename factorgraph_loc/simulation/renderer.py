"""Camera images of a building, with lens distortion, exposure, noise and motion blur."""

import math

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from factorgraph_loc.simulation import raycasting
from factorgraph_loc.simulation.raycasting import Surroundings
from factorgraph_loc.simulation.scene import TexturedScene
from factorgraph_loc.simulation.settings import ImageSettings
from factors.camera import model as reprojection
from factors.camera.model import CameraModel
from factors.se2 import Array

Image = NDArray[np.uint8]
STEP = 2.0  # px between the sub-images that are averaged to a blurred one
MOST_STEPS = 16
CHECKED = 8  # stride in rows and columns of the pixels whose motion is evaluated
STILL: Array = np.zeros(3)
# quantiles of the normal distribution: ten times as fast as drawing from it
_QUANTILES = ndtri((np.arange(4096) + 0.5) / 4096)
NORMAL = (_QUANTILES / _QUANTILES.std()).astype(np.float32)


class Renderer:
    """A camera ``model`` in a ``scene``. Poses are of the camera in the world: ``position`` (3,) and ``rotation`` (3, 3), as
    from :func:`factors.camera.model.camera_pose` for a robot on the floor.
    """

    def __init__(self, scene: TexturedScene, model: CameraModel, settings: ImageSettings | None = None) -> None:
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
        """Render a BGR image (H, W, 3). ``velocity`` (3,) [m/s] and ``turn`` (3,) [rad/s] of the camera in the world frame blur
        it; the pose is that in the middle of the exposure. ``gain``: of the brightness. Without ``rng`` there is no noise.
        """
        shape = (self.model.height, self.model.width, 3)
        light = np.zeros(shape, dtype=np.float32)
        shifts = self._moments(position, rotation, velocity, turn)
        for t in shifts.tolist():
            self._expose(position + t * velocity, _turned(rotation, t * turn), light)
        brightness = np.float32(gain / len(shifts)) * self._vignette
        noise, read, shot = np.zeros(shape, dtype=np.uint16), 0.0, 0.0
        if rng is not None:
            noise = np.frombuffer(rng.bytes(2 * noise.size), dtype="<u2").reshape(shape)
            read, shot = self.settings.read_noise, self.settings.shot_noise
        return np.asarray(raycasting.develop(light, brightness, noise, NORMAL, read, shot))

    def hits(self, pixels: Array, position: Array, rotation: Array) -> Array:
        """The world points (K, 3) shown by ``pixels`` (K, 2), NaN if there is none."""
        directions = reprojection.undistorted(self.model, np.asarray(pixels, dtype=float).reshape(-1, 2))
        rays = np.column_stack((directions, np.ones(len(directions)))) @ rotation.T
        distance: Array = raycasting.cast_all(self._surroundings(position), rays)
        distance[np.isinf(distance)] = np.nan
        return np.asarray(position + distance[:, None] * rays)

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
        if not np.isfinite(place).all():
            raise ValueError(f"the camera's position is {place}, expected finite numbers")
        around: Surroundings = raycasting.surroundings(scene.faces, scene.bottoms, scene.tops, place, self._size)
        return around


def _turned(rotation: Array, turn: Array) -> Array:
    """``rotation`` (3, 3) after a rotation vector (3,) [rad] in the world frame."""
    return np.ascontiguousarray(np.asarray(gtsam.Rot3.Expmap(turn).matrix()) @ rotation)
