"""Cameras that look at known points."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factorgraph_loc.mapping.triangulation import Cameras, Tracks
from factorgraph_loc.vision.frame import CameraFrame
from factors.camera.model import CameraModel, project


@dataclass(frozen=True)
class Sight:
    """Points (P, 3) with descriptors, cameras that look at them, and what each of them sees, its features shuffled: ``shown`` tells
    which point each feature shows."""

    model: CameraModel
    points: np.ndarray
    cameras: Cameras
    frames: list[CameraFrame]
    shown: list[np.ndarray]

    def tracks(self) -> Tracks:
        """The true tracks of what is seen twice or more, with their points' numbers."""
        frame = np.repeat(np.arange(len(self.frames)), [len(s) for s in self.shown])
        point = np.concatenate(self.shown)
        pixels = np.concatenate([f.pixels for f in self.frames])
        feature = np.concatenate([np.arange(len(s)) for s in self.shown])
        every = Tracks(point, frame, feature, pixels)
        return every.kept(np.bincount(point)[point] >= 2)

    def moved(self, rng: np.random.Generator, turn: float, shift: float) -> Cameras:
        """The cameras as someone believes who is wrong by that much in each axis [rad, m]."""
        turns = Rotation.from_rotvec(turn * rng.standard_normal((len(self.cameras), 3))).as_matrix()
        shifts = shift * rng.standard_normal((len(self.cameras), 3, 1))
        return Cameras(
            self.cameras.positions + (self.cameras.rotations @ shifts)[..., 0], self.cameras.rotations @ turns
        )


@pytest.fixture
def look() -> Callable[..., Sight]:
    """``look(rng, ...)``: cameras on an arc that look at a cloud of points 2 m to 4 m away."""

    def make(
        rng: np.random.Generator,
        *,
        count: int = 12,
        points: int = 150,
        noise: float = 1.0,
        arc: float = 0.6,
    ) -> Sight:
        model = CameraModel(
            525.0, 520.0, 320.0, 240.0, 640, 480, distortion=(0.05, -0.02, 0.001, 0.0), sigma=max(noise, 0.1)
        )
        cloud = rng.uniform((-1.2, -0.8, 2.0), (1.2, 0.8, 4.0), (points, 3))
        looks = rng.standard_normal((points, 16)).astype(np.float32)
        angles = np.linspace(-arc, arc, count)
        rotations = Rotation.from_rotvec(-angles[:, None] * np.array((0.0, 1.0, 0.0))).as_matrix()
        positions = np.array((0.0, 0.0, 3.0)) - 3.0 * rotations[:, :, 2]
        positions[:, 1] += 0.15 * arc * rng.uniform(-1.0, 1.0, count)
        cameras = Cameras(positions, rotations)
        frames, shown = [], []
        for i in range(count):
            local = (cloud - positions[i]) @ rotations[i]
            pixels = project(model, local) + noise * rng.standard_normal((points, 2))
            seen = rng.permutation(np.flatnonzero(model.contains(pixels) & (local[:, 2] > 0.1)))
            descriptors = looks[seen] + 0.1 * rng.standard_normal((len(seen), 16)).astype(np.float32)
            numbers = np.arange(len(seen))
            frames.append(CameraFrame(0.1 * i, "sift", pixels[seen], descriptors, numbers))
            shown.append(seen)
        return Sight(model, cloud, cameras, frames, shown)

    return make
