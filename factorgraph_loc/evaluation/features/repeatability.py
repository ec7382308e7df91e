"""Repeatability of points between two images of a scene.

A point stands for a disc, which the homography maps to an ellipse in the other image; two regions correspond if they overlap.
Repeatability is the number of one-to-one correspondences over the smaller number of regions in the common part of the scene
(Mikolajczyk et al., "A Comparison of Affine Region Detectors", IJCV 65, 2005, section 4). Both regions of a pair are scaled to a
radius of 30 px in the first image; otherwise large regions would overlap even if they are inaccurate.

The ``strict`` score compares regions in their own size: their position in units of the size, and a ratio of sizes near 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from factorgraph_loc.evaluation.features.sequences import inside, invert, jacobians, project
from factorgraph_loc.vision.features import Integers, Keypoints
from factors.se2 import Array

OVERLAP_ERROR = 0.4
RADIUS = 30.0  # px, of a scaled region in the first image
MEASUREMENT = 3.0  # radius of the region that describes a point, in units of half its size
SCALE_RATIO = 1.2  # maximum ratio of sizes in the strict score

_NODES = 64  # of the integration over a disc
_CHUNK = 20_000

Truths = NDArray[np.bool_]
Shapes = tuple[tuple[int, ...], tuple[int, ...]]  # height, width, ... of both images


class Repeatability(NamedTuple):
    """Scores of a pair of images, 0 to 1.

    ``regions``: the smaller number of them in the common part; if it is 0, all scores are 0.
    """

    regions: int
    repeatability: float
    strict: float


@dataclass(frozen=True, eq=False)
class Candidates:
    """Pairs of regions that may correspond: ``first`` (M,), ``second`` (M,) their indices, ``error`` (M,) overlap error, ``ratio``
    (M,) of their sizes in the first image, second over first."""

    first: Integers
    second: Integers
    error: Array
    ratio: Array

    def best(self, chosen: Truths) -> Candidates:
        """The one-to-one pairs among ``chosen`` (M,), selected greedily by error."""
        taken_first: set[int] = set()
        taken_second: set[int] = set()
        rows = []
        order = np.flatnonzero(chosen)
        order = order[np.argsort(self.error[order], kind="stable")]
        for row, i, j in zip(order.tolist(), self.first[order].tolist(), self.second[order].tolist(), strict=True):
            if i not in taken_first and j not in taken_second:
                taken_first.add(i)
                taken_second.add(j)
                rows.append(row)
        return Candidates(self.first[rows], self.second[rows], self.error[rows], self.ratio[rows])


def repeatability(first: Keypoints, second: Keypoints, homography: Array, shapes: Shapes) -> Repeatability:
    """The scores of points found in two images of ``shapes`` (height, width, ...); ``homography`` maps the first to the second.

    Points with several orientations count as one region.
    """
    in_first, in_second = common(first, second, homography, shapes)
    first, second = distinct(first[in_first]), distinct(second[in_second])
    count = min(len(first), len(second))
    if count == 0:
        return Repeatability(0, 0.0, 0.0)
    pairs = overlaps(first, second, homography)
    again = pairs.best(pairs.error < OVERLAP_ERROR)
    strict = alike_regions(first, second, homography)
    return Repeatability(count, len(again.first) / count, len(strict.first) / count)


def alike_regions(first: Keypoints, second: Keypoints, homography: Array) -> Candidates:
    """One-to-one pairs of points whose regions, in their own size, overlap, with a ratio of sizes below :data:`SCALE_RATIO`."""
    pairs = overlaps(first, second, homography, magnified=False)
    alike = np.maximum(pairs.ratio, 1.0 / pairs.ratio) < SCALE_RATIO
    return pairs.best((pairs.error < OVERLAP_ERROR) & alike)


def common(first: Keypoints, second: Keypoints, homography: Array, shapes: Shapes) -> tuple[Truths, Truths]:
    """Which points of each image lie in the common part of the scene."""
    back = invert(homography)
    return (
        inside(project(homography, first.points), shapes[1]),
        inside(project(back, second.points), shapes[0]),
    )


def overlaps(first: Keypoints, second: Keypoints, homography: Array, *, magnified: bool = True) -> Candidates:
    """All pairs of points in the common part whose regions may have an overlap error below :data:`OVERLAP_ERROR`.

    ``magnified``: scale regions to :data:`RADIUS`, but not the distance of the centres; else the radius of a region is
    :data:`MEASUREMENT` times half the size of its point.
    """
    if len(first) == 0 or len(second) == 0:
        none = np.empty(0, dtype=np.int64)
        return Candidates(none, none, np.empty(0), np.empty(0))
    mapped = project(invert(homography), second.points)
    # symmetric convex regions that share more than half of one of them contain each other's centres
    reach = np.full(len(first), RADIUS) if magnified else MEASUREMENT * first.sizes / 2.0
    near = cKDTree(mapped).query_ball_point(first.points, reach)
    i = np.repeat(np.arange(len(first)), [len(row) for row in near]).astype(np.int64)
    j = np.concatenate([np.asarray(row, dtype=np.int64) for row in near])
    ratio = _sizes_in_first(second, homography)[j] / first.sizes[i]
    alike = np.maximum(ratio, 1.0 / ratio) ** 2 < 1.0 / (1.0 - OVERLAP_ERROR)
    i, j, ratio = i[alike], j[alike], ratio[alike]
    return Candidates(i, j, pair_errors(first[i], second[j], homography, magnified=magnified), ratio)


def pair_errors(first: Keypoints, second: Keypoints, homography: Array, *, magnified: bool = True) -> Array:
    """Overlap error (N,) of point n of ``first`` with point n of ``second``: 1 - intersection / union, as in :func:`overlaps`; 1
    for points that the homography maps to infinity."""
    back = invert(homography)
    radius = np.full(len(first), RADIUS) if magnified else MEASUREMENT * first.sizes / 2.0
    # in units of that radius the first region is the unit disc
    centre = (project(back, second.points) - first.points) / radius[:, None]
    local = jacobians(back, second.points) * (second.sizes / first.sizes)[:, None, None]
    ellipse = local @ local.transpose(0, 2, 1)
    known = np.isfinite(centre).all(axis=1) & np.isfinite(ellipse).all(axis=(1, 2))
    error = np.ones(len(first))
    for rows in np.array_split(np.flatnonzero(known), 1 + len(first) // _CHUNK):
        area = np.pi * np.sqrt(np.linalg.det(ellipse[rows]))
        shared = shared_area(centre[rows], ellipse[rows])
        error[rows] = 1.0 - shared / (np.pi + area - shared)
    return error


def shared_area(centres: Array, ellipses: Array) -> Array:
    """Areas (N,) of the intersection of the unit disc with ellipses {c + x : x^T S^-1 x <= 1}: ``centres`` c (N, 2), ``ellipses``
    S (N, 2, 2).

    Integrates over the intersection of vertical chords, with denser nodes where the disc is short; accurate to 0.006.
    """
    angles = (np.arange(_NODES) + 0.5) * np.pi / _NODES - np.pi / 2.0
    x, half = np.sin(angles), np.cos(angles)
    xx, xy, yy = ellipses[:, 0, 0, None], ellipses[:, 0, 1, None], ellipses[:, 1, 1, None]
    u = x - centres[:, :1]
    # chord of the ellipse at u: middle S_xy u / S_xx, half length sqrt(det S (S_xx - u^2)) / S_xx
    middle = centres[:, 1:] + xy * u / xx
    length = np.sqrt(np.maximum((xx * yy - xy**2) * (xx - u**2), 0.0)) / xx
    chords = np.minimum(half, middle + length) - np.maximum(-half, middle - length)
    return np.asarray(np.maximum(chords, 0.0) @ half * np.pi / _NODES)


def distinct(keypoints: Keypoints) -> Keypoints:
    """Each position and size once, in the order of the points."""
    rows = np.column_stack((keypoints.points, keypoints.sizes))
    _, index = np.unique(rows, axis=0, return_index=True)
    return keypoints[np.sort(index)]


def _sizes_in_first(second: Keypoints, homography: Array) -> Array:
    """The sizes of the second image's points in the first, for discs of equal area."""
    areas = np.abs(np.linalg.det(jacobians(invert(homography), second.points)))
    return np.asarray(second.sizes * np.sqrt(areas))
