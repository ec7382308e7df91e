"""Camera images of a textured building, with lens distortion, exposure, noise and motion blur.

The building has vertical faces, a floor and a ceiling. A face is a rectangle above a segment of the floor plan, visible
from the left side of the segment only. Furniture is lower than the room but higher than cameras, so that its top is
never visible. Textures have mip levels (Williams, "Pyramidal parametrics", SIGGRAPH 1983).
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from factorgraph_loc.sensors.rfid.map import Tag
from factorgraph_loc.simulation import raycasting, textures
from factorgraph_loc.simulation.pictures import Canvas, paste
from factorgraph_loc.simulation.raycasting import LEVELS, Surroundings
from factorgraph_loc.simulation.settings import ImageSettings
from factorgraph_loc.simulation.worlds import LOWEST_BOX, Plan, both_sides
from factors.camera import model as reprojection
from factors.camera.model import CameraModel
from factors.se2 import Array

Image = NDArray[np.uint8]

ROOM_HEIGHT, DOOR_HEIGHT, HIGHEST_BOX = 2.7, 2.05, 2.0  # m; boxes are furniture
TEXEL = 0.005  # m: size of a texel; larger in a building that would need more than MOST_TEXELS
MOST_TEXELS = 50e6  # largest number of texels of a building; with the mip levels, each needs four bytes of memory
STEP = 2.0  # px: motion between two sub-images. The mean of the sub-images is an image with motion blur.
MOST_STEPS = 16  # sub-images
CHECKED = 8  # rows and columns of the grid of pixels whose motion is computed
STILL: Array = np.zeros(3)  # no motion
# quantiles of the normal distribution, because selecting from these is ten times as fast as drawing normal random numbers
_QUANTILES = ndtri((np.arange(4096) + 0.5) / 4096)
NORMAL = (_QUANTILES / _QUANTILES.std()).astype(np.float32)


@dataclass(frozen=True, eq=False)
class TexturedScene:
    """A building with textures.

    ``faces`` (F, 4) [m]: segments (x1, y1, x2, y2), visible from their left side. ``bottoms``, ``tops`` (F,) [m]:
    heights of the faces.
    ``width``, ``depth`` [m]: size of floor and ceiling. ``height`` [m]: height of the ceiling.
    ``texels`` (T, 3): the BGR colours of all mip levels of all textures. Columns of a face's texture run from left to
    right for the viewer, rows run downwards. On floor and ceiling, columns run along x and rows along y.
    ``layout`` (F + 2, LEVELS, 3): index of the first texel, width and height of each level of each texture. The
    textures of floor and ceiling come last. ``texel`` [m]: the size of a texel.
    """

    faces: Array
    bottoms: Array
    tops: Array
    width: float
    depth: float
    height: float
    texels: NDArray[np.uint8]
    layout: NDArray[np.int64]
    texel: float


def make_scene(plan: Plan, tags: Sequence[Tag], rng: np.random.Generator) -> TexturedScene:
    """Return the building of a plan with random textures and random heights of furniture. ``tags``: those with a facing
    (direction of the front) are drawn on the surfaces as small labels."""
    walls, boxes = plan.faces()
    doors = np.array([side for door in plan.doors for side in both_sides(door)]).reshape(-1, 4)
    faces = np.concatenate((walls, boxes, doors))
    w, b, d = len(walls), len(boxes), len(doors)
    bottoms = np.concatenate((np.zeros(w + b), np.full(d, DOOR_HEIGHT)))
    of_boxes = rng.uniform(LOWEST_BOX, HIGHEST_BOX, b // 4).round(2).repeat(4)
    tops = np.concatenate((np.full(w, ROOM_HEIGHT), of_boxes, np.full(d, ROOM_HEIGHT)))
    lengths = np.hypot(faces[:, 2] - faces[:, 0], faces[:, 3] - faces[:, 1])
    area = float(lengths @ (tops - bottoms)) + 2.0 * plan.width * plan.depth
    texel = max(TEXEL, math.sqrt(area / MOST_TEXELS))
    sizes = [(max(round(z / texel), 8), max(round(x / texel), 8)) for z, x in zip(tops - bottoms, lengths, strict=True)]
    across = round(plan.depth / texel), round(plan.width / texel)
    are_outer = ~plan.indoors((faces[:, :2] + faces[:, 2:]) / 2.0)  # points on the outline count as outside

    def drawn() -> Iterator[Canvas]:
        for i, size in enumerate(sizes):
            if i < w:
                canvas = textures.wall(rng, *size, texel, windows=bool(are_outer[i]))
            elif i < w + b:
                canvas = textures.furniture(rng, *size)
            else:
                canvas = textures.lintel(rng, *size, texel)
            for x, z in _places(tags, faces[i]):
                label = textures.label(rng, texel)
                row = (tops[i] - z) / texel - label.shape[0] / 2
                paste(canvas, label, round(x / texel - label.shape[1] / 2), round(row))
            yield canvas
        yield textures.floor(rng, *across, texel)
        yield textures.ceiling(rng, *across, texel)

    texels, layout = _stored([*sizes, across, across], drawn())
    return TexturedScene(faces, bottoms, tops, plan.width, plan.depth, ROOM_HEIGHT, texels, layout, texel)


def _places(tags: Sequence[Tag], face: Array) -> Iterator[tuple[float, float]]:
    """Yield (x, z) [m] of each tag on a face. x: the distance from the viewer's left end. z: the height."""
    along = face[2:] - face[:2]
    length = math.hypot(*along)
    along = along / length
    normal = np.array((-along[1], along[0]))
    for tag in tags:
        offset = np.array((tag.x, tag.y)) - face[:2]
        s, away = float(offset @ along), float(offset @ normal)
        if tag.facing is None or not 0.0 <= s <= length or not 0.0 <= away < 0.05:
            continue
        if normal @ (math.cos(tag.facing), math.sin(tag.facing)) > 0.9:
            # the viewer is on the left side of the segment, so the end of the segment is on the viewer's left
            yield length - s, tag.z


def _stored(
    sizes: Sequence[tuple[int, int]], canvases: Iterable[Canvas]
) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Return textures and their mip levels in one array, as ``texels`` and ``layout`` of :class:`TexturedScene`.

    ``sizes``: height and width of each texture. ``canvases``: the textures.
    """
    layout = np.empty((len(sizes), LEVELS, 3), dtype=np.int64)
    total = 0
    for i, (height, width) in enumerate(sizes):
        for k in range(LEVELS):
            layout[i, k] = total, max(width >> k, 1), max(height >> k, 1)
            total += int(layout[i, k, 1] * layout[i, k, 2])
    texels = np.empty((total, 3), dtype=np.uint8)
    for levels, canvas in zip(layout.tolist(), canvases, strict=True):
        level = canvas
        for k, (first, width, height) in enumerate(levels):
            if k:
                level = np.asarray(cv2.resize(level, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
            texels[first : first + width * height] = level.reshape(-1, 3)
    return texels, layout


class Renderer:
    """Renders images of a ``scene`` by a camera ``model``, which has the calibration.

    Arguments ``position`` (3,) [m] and ``rotation`` (3, 3) are the camera pose in the world frame. The function
    :func:`factors.camera.model.camera_pose` computes it from the pose of a robot on the floor.
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
        """Return a rendered BGR image (H, W, 3).

        ``position``, ``rotation``: the camera pose in the middle of the exposure. ``velocity`` (3,) [m/s], ``turn``
        (3,) [rad/s]: the motion of the camera in the world frame, which blurs the image. ``gain``: factor of the
        brightness. ``rng``: for the noise of the camera; None renders an image without noise.
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
        """Return the points (K, 3) [m] of the scene that are visible at ``pixels`` (K, 2), in the world frame. A point
        is NaN if nothing is visible."""
        directions = reprojection.undistorted(self.model, np.asarray(pixels, dtype=float).reshape(-1, 2))
        rays = np.column_stack((directions, np.ones(len(directions)))) @ rotation.T
        distance: Array = raycasting.cast_all(self._surroundings(position), rays)
        distance[np.isinf(distance)] = np.nan
        return np.asarray(position + distance[:, None] * rays)

    def _moments(self, position: Array, rotation: Array, velocity: Array, turn: Array) -> Array:
        """Return the times (M,) [s] of the sub-images of a blurred image, relative to the middle of the exposure."""
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
    """Return ``rotation`` (3, 3), turned by the rotation vector ``turn`` (3,) [rad] in the world frame."""
    return np.ascontiguousarray(np.asarray(gtsam.Rot3.Expmap(turn).matrix()) @ rotation)
