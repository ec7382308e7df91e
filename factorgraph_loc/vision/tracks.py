"""Feature tracks over consecutive images.

Matches between two images are mutual nearest neighbours that pass the ratio test, with bounded displacement, and must fit one
essential matrix, found by USAC (Raguram et al., PAMI 35, 2013) as in OpenCV with a fixed seed. A fundamental matrix would often
fit a moving object too. Features without a match are also compared with the last image but one.
"""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np

from factorgraph_loc.vision.colour import Float
from factorgraph_loc.vision.keypoints import Descriptors, Integers
from factorgraph_loc.vision.matching import Truths, match
from factors.camera.model import CameraModel, undistorted
from factors.se2 import Array

RADIUS = 0.25  # of the longer side of an image: largest displacement of a feature
EPIPOLAR = 1.5  # px from the epipolar line
CONFIDENCE, DRAWS = 0.99, 300  # samples of five pairs
FEWEST = 16  # pairs needed for a meaningful consensus
ALIKE = 0.5  # share of the other pairs that agree, if they are of another body and not wrong
THREADS = 2


def follow(
    pixels: Sequence[Array], descriptors: Sequence[Descriptors], camera: CameraModel, *, binary: bool
) -> list[Integers]:
    """Track numbers (K,) of the features of each of N images in order of time.

    ``pixels``: N times (K, 2) of the ``camera``; ``descriptors``: N times (K, D), ``binary`` or not. A number occurs at most once
    per image; a feature seen only once has a number of its own.
    """
    count = len(pixels)
    directions = [undistorted(camera, p) for p in pixels]

    def matched(i: int, j: int, first: Integers, second: Integers) -> Integers:
        """Pairs (M, 2) of features among ``first`` of image i and ``second`` of image j."""
        found = pairs(
            (directions[i][first], descriptors[i][first]),
            (directions[j][second], descriptors[j][second]),
            camera,
            binary=binary,
        )
        return np.column_stack((first[found[:, 0]], second[found[:, 1]]))

    every = [np.arange(len(p)) for p in pixels]
    with ThreadPoolExecutor(THREADS) as pool:  # numpy and OpenCV release the interpreter lock
        steps = range(1, count)
        near = list(pool.map(lambda j: matched(j - 1, j, every[j - 1], every[j]), steps))
        missed = [np.setdiff1d(every[j], near[j][:, 0]) for j in range(count - 1)]  # of image j, not in the next
        new = [np.setdiff1d(every[j], near[j - 1][:, 1]) for j in steps]  # of image j
        far = list(pool.map(lambda j: matched(j - 2, j, missed[j - 2], new[j - 1]), range(2, count)))
    tracks: list[Integers] = []
    following = 0
    for j in range(count):
        numbers = np.full(len(every[j]), -1, dtype=np.int64)
        if j >= 1:
            numbers[near[j - 1][:, 1]] = tracks[j - 1][near[j - 1][:, 0]]
        if j >= 2:
            numbers[far[j - 2][:, 1]] = tracks[j - 2][far[j - 2][:, 0]]
        fresh = np.flatnonzero(numbers < 0)
        numbers[fresh] = following + np.arange(len(fresh))
        following += len(fresh)
        tracks.append(numbers)
    return tracks


def pairs(
    first: tuple[Array, Descriptors], second: tuple[Array, Descriptors], camera: CameraModel, *, binary: bool
) -> Integers:
    """Pairs (M, 2) of features of two images, each given as directions (K, 2), i.e. (x, y) at depth 1, and descriptors (K, D)."""
    if len(first[0]) == 0 or len(second[0]) == 0:
        return np.empty((0, 2), dtype=np.int64)
    focal = math.sqrt(camera.fx * camera.fy)
    a, b = (np.asarray(directions * focal, dtype=np.float32) for directions, _ in (first, second))
    away = [np.square(a[:, None, axis] - b[None, :, axis]) for axis in (0, 1)]
    reach = (RADIUS * max(camera.width, camera.height)) ** 2
    found = match(first[1], second[1], binary=binary, allowed=away[0] + away[1] < reach).indices
    if len(found) < FEWEST:
        return found
    a, b = a[found[:, 0]], b[found[:, 1]]
    right = _of_one_geometry(a, b, focal)
    others = np.flatnonzero(~right)
    if len(others) >= FEWEST:
        too = _of_one_geometry(a[others], b[others], focal)
        if np.count_nonzero(too) > ALIKE * len(others):
            right[others] = too
    return found[right]


def _of_one_geometry(first: Float, second: Float, focal: float) -> Truths:
    """The inliers of M pairs of pixels (M, 2), relative to the principal point, of one epipolar geometry."""
    matrix = np.diag((focal, focal, 1.0))
    try:
        _, inliers = cv2.findEssentialMat(first, second, matrix, cv2.USAC_FAST, CONFIDENCE, EPIPOLAR, DRAWS)
    except cv2.error:  # USAC of OpenCV 5.0 fails occasionally if the camera hardly moves
        inliers = None
    return np.ones(len(first), dtype=bool) if inliers is None else np.asarray(inliers.ravel() != 0)
