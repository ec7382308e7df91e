"""Tracks of features in images of cameras with known poses, and the points triangulated from them.

Matches are searched near epipolar lines only (Hartley and Zisserman, "Multiple View Geometry", 2004, chapter 9), which
separates features that look alike and yields more matches.
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

NEAREST, FARTHEST = 0.1, 100.0  # m, allowed depths in every camera that sees a point
PARALLAX = 0.02  # rad, the least angle between two rays to a point that determines its depth
ANY_SPREAD = 1e3  # relative standard deviation of a point that is never exceeded in practice
RANKS = (
    0,
    1,
    2,
    4,
    7,
    12,
    20,
    33,
)  # ranks of the overlapping frames, nearest first, that a frame is matched with
APART, ASKEW = 1.0, 0.8  # m and rad: cameras farther apart are assumed not to overlap
RATIO = 0.85


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


def keyframes(cameras: Cameras, distance: float, angle: float) -> Integers:
    """Indices of keyframes: the first, and each at ``distance`` [m] or ``angle`` [rad] from all chosen before, so that
    revisiting a place adds none.
    """
    chosen: list[int] = []
    for i in range(len(cameras)):
        near = np.linalg.norm(cameras.positions[chosen] - cameras.positions[i], axis=1) < distance
        if not np.any(near & (angles_between(cameras.rotations[chosen], cameras.rotations[i]) < angle)):
            chosen.append(i)
    return np.array(chosen, dtype=np.int64)


def overlapping_pairs(cameras: Cameras) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of frames that overlap: for each frame the nearest ones, and some farther ones."""
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
    """Whether pairs (N, M) of pixels ``first`` (N, 2) of frame i and ``second`` (M, 2) of frame j may show one point.

    Each must be at most ``gate`` pixels from the epipolar line of the other.
    """
    rotation = cameras.rotations[j].T @ cameras.rotations[i]
    shift = cameras.rotations[j].T @ (cameras.positions[i] - cameras.positions[j])
    x, y, z = shift
    essential = np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))) @ rotation
    a, b = (np.column_stack((undistorted(model, pixels), np.ones(len(pixels)))) for pixels in (first, second))
    lines_j, lines_i = (lines.astype(np.float32) for lines in (a @ essential.T, b @ essential))
    off = np.abs(
        lines_j @ b.T.astype(np.float32)
    )  # single precision is accurate to 0.001 px and takes half of the time
    limit = np.float32(gate / np.sqrt(model.fx * model.fy))
    return np.asarray(
        (off <= limit * np.hypot(lines_j[:, 0], lines_j[:, 1])[:, None]) & (off <= limit * np.hypot(*lines_i[:, :2].T))
    )


def matched_pairs(
    model: CameraModel, cameras: Cameras, frames: Sequence[CameraFrame], pairs: Sequence[tuple[int, int]], gate: float
) -> list[tuple[int, int, Integers, Array]]:
    """For each of ``pairs`` (i, j): indices (K, 2) of matching features, and their distances (K,) relative to the typical
    distance of that pair. ``gate`` [px]: see :func:`near_epipolar_lines`.
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
    """Tracks chained from matches, best first; a match that would join two features of one frame is rejected."""
    starts = np.cumsum([0, *(len(frame.pixels) for frame in frames)])
    frame_of = np.repeat(np.arange(len(frames)), np.diff(starts))
    first = np.concatenate([starts[i] + indices[:, 0] for i, _, indices, _ in matches] or [np.empty(0, dtype=np.int64)])
    second = np.concatenate(
        [starts[j] + indices[:, 1] for _, j, indices, _ in matches] or [np.empty(0, dtype=np.int64)]
    )
    order = np.argsort(np.concatenate([d for *_, d in matches] or [np.empty(0)]), kind="stable")
    root = list(range(int(starts[-1])))
    members: dict[int, dict[int, int]] = {}  # features by frame, for each root

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
    """Angles (F,) [rad] between rotations ``first`` (F, 3, 3) and ``second`` (F, 3, 3), or one (3, 3)."""
    trace = np.einsum("nij,nij->n", *np.broadcast_arrays(first, second))
    return np.asarray(np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0)))
