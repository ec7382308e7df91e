"""Feature tracks over consecutive images.

Matches between two images are mutual nearest neighbours that pass the ratio test and have a bounded displacement. They must fit
one essential matrix, estimated by USAC (Raguram et al., PAMI 35, 2013) as in OpenCV with a fixed seed. A fundamental matrix would
often fit a moving object too. Features without a match are also compared with the last image but one.
"""

import math
from typing import NamedTuple

import cv2
import numpy as np

from factorgraph_loc.vision.keypoints import Descriptors, Float, Integers
from factorgraph_loc.vision.matching import Truths, match
from factors.camera.model import CameraModel, undistorted
from factors.se2 import Array

RADIUS = 0.25  # of the longer side of an image: largest displacement of a feature
EPIPOLAR = 1.5  # px from the epipolar line
CONFIDENCE, DRAWS = 0.99, 300  # samples of five pairs
FEWEST = 16  # pairs needed for a meaningful consensus
OTHER_BODY = 0.5  # share of the other pairs that agree, if they are of another body and not wrong


class _TrackedImage(NamedTuple):
    """Directions (K, 2), descriptors (K, D) and track numbers (K,) of the features of one image."""

    directions: Array
    descriptors: Descriptors
    numbers: Integers


class FeatureTracker:
    """Numbers the tracks of features, image by image in order of time, keeping the last two images. Not thread-safe."""

    def __init__(self, camera: CameraModel) -> None:
        self._camera = camera
        self._last: _TrackedImage | None = None
        self._before: _TrackedImage | None = None  # the last but one, with the features that the last one did not match
        self._count = 0  # of tracks

    def follow(self, pixels: Array, descriptors: Descriptors) -> Integers:
        """Track numbers (K,) of the features of the next image, with ``pixels`` (K, 2) and ``descriptors`` (K, D).

        A number occurs at most once per image; a feature seen only once has a number of its own.
        """
        numbers = np.full(len(pixels), -1, dtype=np.int64)
        image = _TrackedImage(undistorted(self._camera, pixels), descriptors, numbers)
        missed = None
        if self._last is not None:
            missed = self._continued(self._last, image)
            if self._before is not None:
                self._continued(self._before, image)
        fresh = np.flatnonzero(numbers < 0)
        numbers[fresh] = self._count + np.arange(len(fresh))
        self._count += len(fresh)
        self._last, self._before = image, missed
        return numbers

    def _continued(self, earlier: _TrackedImage, image: _TrackedImage) -> _TrackedImage:
        """Continue tracks of an earlier image in the features without a number; the rest of the earlier image is returned."""
        rows = np.flatnonzero(image.numbers < 0)
        current = image.directions[rows], image.descriptors[rows]
        matched = pairs(earlier[:2], current, self._camera)
        image.numbers[rows[matched[:, 1]]] = earlier.numbers[matched[:, 0]]
        missed = np.setdiff1d(np.arange(len(earlier.numbers)), matched[:, 0])
        return _TrackedImage(earlier.directions[missed], earlier.descriptors[missed], earlier.numbers[missed])


def pairs(first: tuple[Array, Descriptors], second: tuple[Array, Descriptors], camera: CameraModel) -> Integers:
    """Pairs (M, 2) of features of two images, each given as directions (K, 2), i.e. (x, y) at depth 1, and descriptors (K, D)."""
    if len(first[0]) == 0 or len(second[0]) == 0:
        return np.empty((0, 2), dtype=np.int64)
    focal = math.sqrt(camera.fx * camera.fy)
    a, b = (np.asarray(directions * focal, dtype=np.float32) for directions, _ in (first, second))
    away = [np.square(a[:, None, axis] - b[None, :, axis]) for axis in (0, 1)]
    reach = (RADIUS * max(camera.width, camera.height)) ** 2
    matched = match(first[1], second[1], allowed=away[0] + away[1] < reach).indices
    if len(matched) < FEWEST:
        return matched
    a, b = a[matched[:, 0]], b[matched[:, 1]]
    right = _of_one_geometry(a, b, focal)
    rejected = np.flatnonzero(~right)
    if len(rejected) >= FEWEST:
        too = _of_one_geometry(a[rejected], b[rejected], focal)
        if np.count_nonzero(too) > OTHER_BODY * len(rejected):
            right[rejected] = too
    return matched[right]


def _of_one_geometry(first: Float, second: Float, focal: float) -> Truths:
    """The inliers of M pairs of pixels (M, 2), relative to the principal point, of one epipolar geometry."""
    matrix = np.diag((focal, focal, 1.0))
    try:
        _, inliers = cv2.findEssentialMat(first, second, matrix, cv2.USAC_FAST, CONFIDENCE, EPIPOLAR, DRAWS)
    except cv2.error:  # USAC of OpenCV 5.0 fails occasionally if the camera hardly moves
        inliers = None
    return np.ones(len(first), dtype=bool) if inliers is None else np.asarray(inliers.ravel() != 0)
