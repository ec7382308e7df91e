"""Triangulation of points from bearings of several cameras with known poses.

A linear start, the point nearest to all rays, then Gauss-Newton steps on the robust reprojection error (Hartley and Zisserman,
"Multiple View Geometry", 2004, chapter 12), vectorised over all tracks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from factorgraph_loc.vision.consensus import Truths
from factors.camera.model import CameraModel, linearize_in_space, undistorted
from factors.robust import huber_weight
from factors.se2 import Array, Integers

ITERATIONS = 8
NEAREST, FARTHEST = 0.1, 100.0  # m, allowed depths in every camera that sees a point
PARALLAX = 0.02  # rad, the least angle between two rays to a point that determines its depth


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
        behind = (self.depths < NEAREST) | (self.depths > FARTHEST)
        square = np.bincount(tracks.track, np.sum(self.errors**2, axis=1), minlength=tracks.count)
        rms = np.sqrt(square / np.maximum(tracks.lengths(), 1))
        good = (self.parallax >= parallax) & (tracks.lengths() >= 2) & (rms <= 4.0 * model.sigma)
        good[tracks.track[behind]] = False
        return np.asarray(good & np.isfinite(self.positions).all(axis=1))


def directions(model: CameraModel, rotations: Array, pixels: Array) -> Array:
    """Unit vectors (N, 3) in the world towards ``pixels`` (N, 2) of cameras with orientations ``rotations`` (N, 3, 3)."""
    local = np.column_stack((undistorted(model, pixels), np.ones(len(pixels))))
    rays = np.einsum("nij,nj->ni", rotations, local)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def reproject(model: CameraModel, cameras: Cameras, points: Array, tracks: Tracks) -> tuple[Array, Array, Array, Array]:
    """For each of N observations: error (N, 2) [px], predicted minus measured, its Jacobians with respect to the camera (N, 2,
    6), as in :func:`factors.camera.model.linearize_in_space`, and to the point (N, 2, 3), and the depth (N,) [m].
    """
    rotations = cameras.rotations[tracks.frame]
    local = np.einsum("nj,njk->nk", points[tracks.track] - cameras.positions[tracks.frame], rotations)
    pixels, by_camera, by_local = linearize_in_space(model, np.zeros(3), np.eye(3), local)
    return pixels - tracks.pixels, by_camera, by_local @ rotations.transpose(0, 2, 1), local[:, 2]


def triangulate(model: CameraModel, cameras: Cameras, tracks: Tracks) -> Triangulated:
    """Triangulate the points of ``tracks``, with exact camera poses."""
    rays = directions(model, cameras.rotations[tracks.frame], tracks.pixels)
    points = _nearest_to_rays(cameras.positions[tracks.frame], rays, tracks)
    for _ in range(ITERATIONS):
        error, _, by_point, _ = reproject(model, cameras, points, tracks)
        weight = huber_weight(np.sum(error**2, axis=1) / model.sigma**2, model.robust) / model.sigma**2
        information = _summed(np.einsum("n,nij,nik->njk", weight, by_point, by_point), tracks)
        gradient = _summed(np.einsum("n,nij,ni->nj", weight, by_point, error), tracks)
        step = -np.einsum("tij,tj->ti", _inverse(information), gradient)
        # a point of undetermined depth may jump: limit the step to a metre
        points = points + step * np.minimum(1.0, 1.0 / np.maximum(np.linalg.norm(step, axis=1), 1e-12))[:, None]
    error, _, by_point, depth = reproject(model, cameras, points, tracks)
    information = _summed(np.einsum("nij,nik->njk", by_point, by_point) / model.sigma**2, tracks)
    return Triangulated(points, _inverse(information), error, depth, parallax(cameras, points, tracks))


def parallax(cameras: Cameras, points: Array, tracks: Tracks) -> Array:
    """The largest angle (T,) [rad] between two of the rays to each of ``points`` (T, 3)."""
    rays = points[tracks.track] - cameras.positions[tracks.frame]
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
    order = np.argsort(tracks.track, kind="stable")
    bounds = np.cumsum(tracks.lengths())[:-1]
    least = [float((one @ one.T).min(initial=1.0)) for one in np.split(rays[order], bounds)]
    return np.asarray(np.arccos(np.clip(least, -1.0, 1.0)))


def _nearest_to_rays(positions: Array, rays: Array, tracks: Tracks) -> Array:
    """The points (T, 3) with the least sum of squared distances from their rays."""
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    right = _summed(np.einsum("nij,nj->ni", across, positions), tracks)
    return np.asarray(np.einsum("tij,tj->ti", _inverse(_summed(across, tracks)), right))


def _summed(values: Array, tracks: Tracks) -> Array:
    """Sums (T, ...) of ``values`` (N, ...) over the observations of each point."""
    out = np.zeros((tracks.count, *values.shape[1:]))
    np.add.at(out, tracks.track, values)
    return out


def _inverse(matrices: Array) -> Array:
    """Inverses of symmetric ``matrices`` (T, 3, 3), regularised where singular."""
    size = np.trace(matrices, axis1=1, axis2=2)
    return np.asarray(np.linalg.inv(matrices + (1e-12 * size + 1e-300)[:, None, None] * np.eye(3)))
