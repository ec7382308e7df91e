"""Repeatability of points between two images of a scene.

The region of a point is a disc, which the homography maps to an ellipse in the other image. Two regions correspond if they overlap.
Repeatability is the number of one-to-one correspondences divided by the smaller number of regions in the common part of the scene
(Mikolajczyk et al., "A Comparison of Affine Region Detectors", IJCV 65, 2005, section 4). Both regions of a pair are scaled so that
the first has a radius of 30 px. Otherwise large regions would overlap even if their positions are inaccurate.

The ``strict`` score does not scale regions. It compares positions in units of the region's size, and requires similar sizes.
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

OVERLAP_ERROR = 0.4  # regions correspond below this error: 1 - intersection / union
RADIUS = 30.0  # px; radius of a scaled region in the first image
MEASUREMENT = 3.0  # radius of the region that describes a point, in units of the point's radius (half of its size)
SCALE_RATIO = 1.2  # maximum ratio between the sizes of corresponding points for the score ``strict``

_NODES = 64  # number of nodes of the integration over a disc
_CHUNK = 20_000  # number of pairs in one comparison, to limit memory

Truths = NDArray[np.bool_]
Shapes = tuple[tuple[int, ...], tuple[int, ...]]  # height, width, ... of both images


class Repeatability(NamedTuple):
    """Repeatability scores of a pair of images, from 0 to 1. A region is the image area that a keypoint describes.

    ``regions``: the smaller of the two numbers of regions in the part of the scene that both images show.
    ``repeatability``: number of corresponding regions (overlap error below 0.4) divided by ``regions``. ``strict``:
    number of regions that also have similar sizes, divided by ``regions``. Without regions all are 0.
    """

    regions: int
    repeatability: float
    strict: float


@dataclass(frozen=True, eq=False)
class Candidates:
    """M pairs of regions in two images that may correspond. ``first``, ``second`` (M,): indices of the regions.

    ``error`` (M,): overlap error, 1 - intersection / union. ``ratio`` (M,): size of the second region after mapping to
    the first image, divided by the size of the first region.
    """

    first: Integers
    second: Integers
    error: Array
    ratio: Array

    def best(self, chosen: Truths) -> Candidates:
        """Return a one-to-one selection from the pairs with True in the mask ``chosen`` (M,), by ascending error. A
        pair is omitted if one of its regions is in a pair with a smaller error."""
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
    """Return the repeatability scores of points that are detected in two images.

    ``homography`` (3, 3): maps pixels of the first image to the second. ``shapes``: (height, width, ...) of both
    images. Points at the same position with several orientations count as one region.
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
    """Return one-to-one pairs of points with overlapping regions and a ratio of sizes below :data:`SCALE_RATIO`.
    ``first``, ``second``: the points of two images. ``homography`` (3, 3): maps pixels of the first image to the
    second. The radius of a region is proportional to the size of its point."""
    pairs = overlaps(first, second, homography, magnified=False)
    alike = np.maximum(pairs.ratio, 1.0 / pairs.ratio) < SCALE_RATIO
    return pairs.best((pairs.error < OVERLAP_ERROR) & alike)


def common(first: Keypoints, second: Keypoints, homography: Array, shapes: Shapes) -> tuple[Truths, Truths]:
    """Return masks of the points ``first`` and of the points ``second`` that lie inside the other image after mapping.
    ``homography`` (3, 3): maps pixels of the first image to the second. ``shapes``: (height, width, ...) of both
    images."""
    back = invert(homography)
    return (
        inside(project(homography, first.points), shapes[1]),
        inside(project(back, second.points), shapes[0]),
    )


def overlaps(first: Keypoints, second: Keypoints, homography: Array, *, magnified: bool = True) -> Candidates:
    """Return pairs of points with nearby regions of similar size, with the overlap error of their regions.

    They include all pairs with an error below :data:`OVERLAP_ERROR`, but also others. The error is 1 - intersection /
    union (:func:`pair_errors`). ``homography`` (3, 3): maps pixels of the first image to the second. ``magnified``: if
    true, both regions are scaled by the same factor, so that the first region has the radius :data:`RADIUS`. Otherwise
    the radius of a region is :data:`MEASUREMENT` times half the size of its point.
    """
    if len(first) == 0 or len(second) == 0:
        none = np.empty(0, dtype=np.int64)
        return Candidates(none, none, np.empty(0), np.empty(0))
    mapped = project(invert(homography), second.points)
    # if the intersection of two symmetric convex regions is more than half of one region, that region's centre is in the other
    reach = np.full(len(first), RADIUS) if magnified else MEASUREMENT * first.sizes / 2.0
    near = cKDTree(mapped).query_ball_point(first.points, reach)
    i = np.repeat(np.arange(len(first)), [len(row) for row in near]).astype(np.int64)
    j = np.concatenate([np.asarray(row, dtype=np.int64) for row in near])
    ratio = _sizes_in_first(second, homography)[j] / first.sizes[i]
    alike = np.maximum(ratio, 1.0 / ratio) ** 2 < 1.0 / (1.0 - OVERLAP_ERROR)
    i, j, ratio = i[alike], j[alike], ratio[alike]
    return Candidates(i, j, pair_errors(first[i], second[j], homography, magnified=magnified), ratio)


def pair_errors(first: Keypoints, second: Keypoints, homography: Array, *, magnified: bool = True) -> Array:
    """Return the overlap errors (N,) between the regions of the N points ``first`` and of the N points ``second``.

    The error is 1 - intersection / union, and 1 for points that the homography (3, 3) maps to infinity. ``magnified``:
    if true, both regions are scaled by the same factor to a fixed radius of the first.
    """
    back = invert(homography)
    radius = np.full(len(first), RADIUS) if magnified else MEASUREMENT * first.sizes / 2.0
    # lengths are in units of ``radius``, so that the first region is the unit disc
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
    """Return the areas (N,) of the intersections of the unit disc with N ellipses {c + x : x^T S^-1 x <= 1}.

    ``centres``: c (N, 2). ``ellipses``: S (N, 2, 2). The lengths of common vertical chords are integrated numerically,
    with denser nodes at the sides of the disc. The error is below 0.006.
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
    """Return the keypoints without duplicates. A duplicate has the same position and size as another keypoint."""
    rows = np.column_stack((keypoints.points, keypoints.sizes))
    _, index = np.unique(rows, axis=0, return_index=True)
    return keypoints[np.sort(index)]


def _sizes_in_first(second: Keypoints, homography: Array) -> Array:
    """Return the sizes (N,) [px] of points of the second image after mapping to the first image. A size is the diameter
    of a disc of equal area."""
    areas = np.abs(np.linalg.det(jacobians(invert(homography), second.points)))
    return np.asarray(second.sizes * np.sqrt(areas))
