"""Tracks of features in images with known camera poses, and triangulation of their points.

Matches are searched near epipolar lines only (Hartley and Zisserman, "Multiple View Geometry", 2004, chapter 9). This
separates similar features, so that more matches pass the ratio test.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from factorgraph_loc.vision.consensus import Truths
from factorgraph_loc.vision.frame import CameraFrame
from factorgraph_loc.vision.matching import match
from factors.camera import model as reprojection
from factors.camera import triangulation_kernels as kernels
from factors.camera.model import CameraModel, linearize_in_space, undistorted
from factors.se2 import Array, Integers

NEAREST, FARTHEST = 0.1, 100.0  # m: allowed depths of a point in the cameras that observe it
PARALLAX = 0.02  # rad: least angle between two rays to a point
ANY_SPREAD = 1e3  # largest relative standard deviation of a triangulated point: so large that none is rejected
# a frame is matched with the overlapping frames at these places in the order of distance, 0 for the nearest frame
RANKS = (0, 1, 2, 4, 7, 12, 20, 33)
APART, ASKEW = 1.0, 0.8  # m, rad: the images of cameras that differ more are assumed not to overlap
RATIO = 0.85


@dataclass(frozen=True, eq=False)
class Cameras:
    """Poses of F cameras. ``positions`` (F, 3) [m] in the world. ``rotations`` (F, 3, 3): from the camera frame (x
    right, y down, z forward) to the world."""

    positions: Array
    rotations: Array

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, index: Any) -> Cameras:
        return Cameras(self.positions[index], self.rotations[index])


@dataclass(frozen=True, eq=False)
class Tracks:
    """N observations of T points in images.

    ``track`` (N,): the index of the point, from 0 to T - 1. ``frame`` (N,): the index of the image. ``feature`` (N,):
    the index of the feature in this image. ``pixels`` (N, 2): the observed pixel.
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
        """Return the number of observations of each point (T,)."""
        return np.bincount(self.track, minlength=self.count)

    def kept(self, mask: Truths) -> tuple[Tracks, Integers]:
        """Return only the observations for which ``mask`` (N,) is True. Points without an observation are removed, and
        the indices of the other points become consecutive. Also returns the old index of each remaining point."""
        old, track = np.unique(self.track[mask], return_inverse=True)
        left = (self.frame[mask], self.feature[mask], self.pixels[mask])
        return Tracks(track.astype(np.int64), *left), old


@dataclass(frozen=True, eq=False)
class Triangulated:
    """T triangulated points with N observations.

    ``positions`` (T, 3) [m], ``covariances`` (T, 3, 3): of the points, for exact camera poses. ``errors`` (N, 2) [px]:
    the residuals, predicted minus measured. ``depths`` (N,) [m]: the depth of the point in the camera of each
    observation. ``parallax`` (T,) [rad]: the largest angle between two rays to a point.
    """

    positions: Array
    covariances: Array
    errors: Array
    depths: Array
    parallax: Array

    def good(self, tracks: Tracks, model: CameraModel, parallax: float = PARALLAX) -> Truths:
        """Return a mask (T,) of the reliable points. These have two or more observations, an allowed depth in all
        cameras, small residuals, and a parallax of at least ``parallax`` [rad]. ``tracks``: the observations.
        ``model``: the camera."""
        invalid = (self.depths < NEAREST) | (self.depths > FARTHEST)
        square = np.bincount(tracks.track, np.sum(self.errors**2, axis=1), minlength=tracks.count)
        rms = np.sqrt(square / np.maximum(tracks.lengths(), 1))
        good = (self.parallax >= parallax) & (tracks.lengths() >= 2) & (rms <= 4.0 * model.sigma)
        good[tracks.track[invalid]] = False
        return np.asarray(good & np.isfinite(self.positions).all(axis=1))


def reproject(model: CameraModel, cameras: Cameras, points: Array, tracks: Tracks) -> tuple[Array, Array, Array, Array]:
    """Return the residuals (N, 2) [px] of N observations, predicted minus measured, with derivatives.

    Also returns the Jacobians with respect to the camera pose (N, 2, 6) and to the point (N, 2, 3), and the depths (N,)
    [m]. See :func:`factors.camera.model.linearize_in_space`. ``points`` (T, 3): positions in the world frame.
    """
    rotations = cameras.rotations[tracks.frame]
    local = np.einsum("nj,njk->nk", points[tracks.track] - cameras.positions[tracks.frame], rotations)
    pixels, by_camera, by_local = linearize_in_space(model, np.zeros(3), np.eye(3), local)
    return pixels - tracks.pixels, by_camera, by_local @ rotations.transpose(0, 2, 1), local[:, 2]


def triangulate(model: CameraModel, cameras: Cameras, tracks: Tracks) -> Triangulated:
    """Return the points of ``tracks``, triangulated for exact camera poses. The parallax of a point is set to 0 if its
    rays do not determine it."""
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
    """Return for each of ``points`` (T, 3) the largest angle (T,) [rad] between the rays of two of its observations."""
    rays = points[tracks.track] - cameras.positions[tracks.frame]
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
    order = np.argsort(tracks.track, kind="stable")
    bounds = np.cumsum(tracks.lengths())[:-1]
    least = [float((directions @ directions.T).min(initial=1.0)) for directions in np.split(rays[order], bounds)]
    return np.asarray(np.arccos(np.clip(least, -1.0, 1.0)))


def keyframes(cameras: Cameras, distance: float, angle: float) -> Integers:
    """Return the indices of the cameras that become keyframes.

    The first camera is a keyframe, and each later one that differs from all earlier keyframes by ``distance`` [m] or
    ``angle`` [rad]. A second drive through the same region therefore adds no keyframes.
    """
    chosen: list[int] = []
    for i in range(len(cameras)):
        near = np.linalg.norm(cameras.positions[chosen] - cameras.positions[i], axis=1) < distance
        if not np.any(near & (angles_between(cameras.rotations[chosen], cameras.rotations[i]) < angle)):
            chosen.append(i)
    return np.array(chosen, dtype=np.int64)


def overlapping_pairs(cameras: Cameras) -> list[tuple[int, int]]:
    """Return pairs (i, j), i < j, of images that probably show the same objects. Each image is paired with the nearest
    ones by pose, and with some that are farther away."""
    pairs = set()
    for i in range(len(cameras)):
        distance = np.linalg.norm(cameras.positions - cameras.positions[i], axis=1)
        turn = angles_between(cameras.rotations, cameras.rotations[i])
        cost = distance / APART + turn / ASKEW
        cost[i] = np.inf
        order = np.argsort(cost, kind="stable")
        order = order[cost[order] < 1.0]
        pairs |= {(min(i, j), max(i, j)) for j in order[[r for r in RANKS if r < len(order)]].tolist()}
    return sorted(pairs)


def near_epipolar_lines(
    model: CameraModel, cameras: Cameras, i: int, j: int, first: Array, second: Array, gate: float
) -> Truths:
    """Return a mask (N, M) of the pairs of pixels in images i and j that may show the same point.

    ``first`` (N, 2), ``second`` (M, 2) [px]: pixels in image i and in image j. Each pixel of a pair must be at most
    ``gate`` [px] from the epipolar line of the other pixel.
    """
    rotation = cameras.rotations[j].T @ cameras.rotations[i]
    shift = cameras.rotations[j].T @ (cameras.positions[i] - cameras.positions[j])
    x, y, z = shift
    essential = np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))) @ rotation
    a, b = (np.column_stack((undistorted(model, pixels), np.ones(len(pixels)))) for pixels in (first, second))
    lines_j, lines_i = (lines.astype(np.float32) for lines in (a @ essential.T, b @ essential))
    # single precision is accurate to 0.001 px and takes half of the time
    off = np.abs(lines_j @ b.T.astype(np.float32))
    limit = np.float32(gate / np.sqrt(model.fx * model.fy))
    return np.asarray(
        (off <= limit * np.hypot(lines_j[:, 0], lines_j[:, 1])[:, None]) & (off <= limit * np.hypot(*lines_i[:, :2].T))
    )


def matched_pairs(
    model: CameraModel, cameras: Cameras, frames: Sequence[CameraFrame], pairs: Sequence[tuple[int, int]], gate: float
) -> list[tuple[int, int, Integers, Array]]:
    """Return the matching features of each of the ``pairs`` (i, j) of images. Pairs without a match are left out.

    ``gate`` [px]: the largest distance of a match from its epipolar line. The result for a pair is i, j, the indices
    (K, 2) of matching features, and the distances (K,) of their descriptors. Each distance is divided by the median
    distance of this pair of images.
    """
    out = []
    for i, j in pairs:
        a, b = frames[i], frames[j]
        if not (len(a.pixels) and len(b.pixels)):
            continue
        allowed = near_epipolar_lines(model, cameras, i, j, a.pixels, b.pixels, gate)
        matches = match(a.descriptors, b.descriptors, ratio=RATIO, allowed=allowed)
        if len(matches):
            out.append((i, j, matches.indices, matches.distances / np.median(matches.distances + 1e-9)))
    return out


def chained(frames: Sequence[CameraFrame], matches: Sequence[tuple[int, int, Integers, Array]]) -> Tracks:
    """Return tracks made from ``matches``, which are the result of :func:`matched_pairs`. A track is a set of features
    of different images that show the same point.

    Matches are processed in order of descriptor distance. A match that would add two features of one image to a track
    is omitted.
    """
    starts = np.cumsum([0, *(len(frame.pixels) for frame in frames)])
    frame_of = np.repeat(np.arange(len(frames)), np.diff(starts))
    first = np.concatenate([starts[i] + indices[:, 0] for i, _, indices, _ in matches] or [np.empty(0, dtype=np.int64)])
    second = np.concatenate(
        [starts[j] + indices[:, 1] for _, j, indices, _ in matches] or [np.empty(0, dtype=np.int64)]
    )
    order = np.argsort(np.concatenate([d for *_, d in matches] or [np.empty(0)]), kind="stable")
    root = list(range(int(starts[-1])))
    members: dict[int, dict[int, int]] = {}  # for each root of a track, its features by frame

    def find(k: int) -> int:
        while root[k] != k:
            root[k] = root[root[k]]
            k = root[k]
        return k

    for a, b in zip(first[order].tolist(), second[order].tolist(), strict=True):
        ra, rb = find(a), find(b)
        if ra == rb:
            continue
        of_a = members.setdefault(ra, {int(frame_of[ra]): ra})
        of_b = members.setdefault(rb, {int(frame_of[rb]): rb})
        if len(of_a) < len(of_b):
            ra, rb, of_a, of_b = rb, ra, of_b, of_a
        if of_a.keys().isdisjoint(of_b):
            root[rb] = ra
            of_a |= of_b
            del members[rb]
    chains = [sorted(features.values()) for features in members.values() if len(features) > 1]
    chains.sort()
    nodes = np.array([k for chain in chains for k in chain], dtype=np.int64)
    track = np.repeat(np.arange(len(chains)), [len(chain) for chain in chains]).astype(np.int64)
    frame = frame_of[nodes]
    pixels = np.concatenate([frame.pixels for frame in frames])[nodes] if len(nodes) else np.empty((0, 2))
    feature = nodes - starts[frame]
    return Tracks(track, frame, feature, pixels)


def angles_between(first: Array, second: Array) -> Array:
    """Return the angles (F,) [rad] between two sets of rotations. ``first``, ``second``: each (F, 3, 3), or one
    rotation (3, 3)."""
    trace = np.einsum("nij,nij->n", *np.broadcast_arrays(first, second))
    return np.asarray(np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0)))
