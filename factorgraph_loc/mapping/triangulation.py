"""Tracks of features in images of cameras with known poses, and the points triangulated from them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from factorgraph_loc.vision.consensus import Truths
from factors.camera import model as reprojection
from factors.camera import triangulation_kernels as kernels
from factors.camera.model import CameraModel, linearize_in_space
from factors.se2 import Array, Integers

NEAREST, FARTHEST = 0.1, 100.0  # m, allowed depths in every camera that sees a point
PARALLAX = 0.02  # rad, the least angle between two rays to a point that determines its depth
ANY_SPREAD = 1e3  # relative standard deviation of a point that is never exceeded in practice


@dataclass(frozen=True, eq=False)
class Cameras:
    """Poses of cameras in the world: ``positions`` (F, 3) [m], ``rotations`` (F, 3, 3), axes z forward, x right, y down."""

    positions: Array
    rotations: Array

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, index: Any) -> Cameras:
        return Cameras(self.positions[index], self.rotations[index])


@dataclass(frozen=True, eq=False)
class Tracks:
    """N observations of T points: the point ``track`` (N,) in 0 .. T - 1 is feature ``feature`` (N,) of frame ``frame`` (N,),
    at ``pixels`` (N, 2).
    """

    track: Integers
    frame: Integers
    feature: Integers
    pixels: Array

    def __len__(self) -> int:
        return len(self.track)

    @property
    def count(self) -> int:
        """The number of points."""
        return int(self.track.max(initial=-1)) + 1

    def lengths(self) -> Integers:
        """The number of observations of each point (T,)."""
        return np.bincount(self.track, minlength=self.count)

    def kept(self, observations: Truths) -> tuple[Tracks, Integers]:
        """The tracks with the selected ``observations`` (N,), renumbered, and the old indices (T',) of the remaining points."""
        old, track = np.unique(self.track[observations], return_inverse=True)
        left = (self.frame[observations], self.feature[observations], self.pixels[observations])
        return Tracks(track.astype(np.int64), *left), old


@dataclass(frozen=True, eq=False)
class Triangulated:
    """``positions`` (T, 3) [m] with ``covariances`` (T, 3, 3), given the cameras; ``errors`` (N, 2) [px] of the observations,
    predicted minus measured, and their ``depths`` (N,) [m]; ``parallax`` (T,) [rad]: the largest angle between two rays.
    """

    positions: Array
    covariances: Array
    errors: Array
    depths: Array
    parallax: Array

    def good(self, tracks: Tracks, model: CameraModel, parallax: float = PARALLAX) -> Truths:
        """Which points (T,) have two or more observations, lie in front of all their cameras, and have enough parallax
        and small errors.
        """
        invalid = (self.depths < NEAREST) | (self.depths > FARTHEST)
        square = np.bincount(tracks.track, np.sum(self.errors**2, axis=1), minlength=tracks.count)
        rms = np.sqrt(square / np.maximum(tracks.lengths(), 1))
        good = (self.parallax >= parallax) & (tracks.lengths() >= 2) & (rms <= 4.0 * model.sigma)
        good[tracks.track[invalid]] = False
        return np.asarray(good & np.isfinite(self.positions).all(axis=1))


def reproject(model: CameraModel, cameras: Cameras, points: Array, tracks: Tracks) -> tuple[Array, Array, Array, Array]:
    """Errors of N observations (N, 2) [px], predicted minus measured, their Jacobians, and the depths (N,) [m].

    The Jacobians are with respect to the camera (N, 2, 6), as in :func:`factors.camera.model.linearize_in_space`, and to the
    point (N, 2, 3).
    """
    rotations = cameras.rotations[tracks.frame]
    local = np.einsum("nj,njk->nk", points[tracks.track] - cameras.positions[tracks.frame], rotations)
    pixels, by_camera, by_local = linearize_in_space(model, np.zeros(3), np.eye(3), local)
    return pixels - tracks.pixels, by_camera, by_local @ rotations.transpose(0, 2, 1), local[:, 2]


def triangulate(model: CameraModel, cameras: Cameras, tracks: Tracks) -> Triangulated:
    """Triangulate the points of ``tracks``, with exact camera poses (:mod:`factors.camera.triangulation_kernels`). A point that is
    not determined is at the origin, with no parallax."""
    points, covariances = np.zeros((tracks.count, 3)), np.zeros((tracks.count, 3, 3))
    rays, determined = reprojection.rays(model, tracks.pixels), np.zeros(tracks.count, dtype=bool)
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    sigmas, lens = np.full(len(tracks), model.sigma), reprojection.lens_of(model)
    order = np.argsort(tracks.track, kind="stable")
    for i, rows in enumerate(np.split(order, np.cumsum(tracks.lengths())[:-1])):
        frames = tracks.frame[rows]
        observed = cameras.positions[frames], cameras.rotations[frames], rays[rows], tracks.pixels[rows], sigmas[rows]
        is_determined, points[i], covariances[i], squared = kernels.triangulated(
            lens, *observed, ANY_SPREAD, 0.0, NEAREST, model.robust
        )
        determined[i] = is_determined and np.isfinite(squared[0])
    error, _, _, depth = reproject(model, cameras, points, tracks)
    return Triangulated(points, covariances, error, depth, np.where(determined, parallax(cameras, points, tracks), 0.0))


def parallax(cameras: Cameras, points: Array, tracks: Tracks) -> Array:
    """The largest angle (T,) [rad] between two of the rays to each of ``points`` (T, 3)."""
    rays = points[tracks.track] - cameras.positions[tracks.frame]
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
    order = np.argsort(tracks.track, kind="stable")
    bounds = np.cumsum(tracks.lengths())[:-1]
    least = [float((directions @ directions.T).min(initial=1.0)) for directions in np.split(rays[order], bounds)]
    return np.asarray(np.arccos(np.clip(least, -1.0, 1.0)))
