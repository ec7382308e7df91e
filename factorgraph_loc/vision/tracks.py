"""Feature tracks over consecutive images.

Matches between two images are mutual nearest neighbours that pass the ratio test and have a bounded displacement. They
must fit one essential matrix, estimated by USAC (Raguram et al., PAMI 35, 2013) as in OpenCV with a fixed seed. A
fundamental matrix is not used, because it often fits a moving object too. Features without a match in the last image
are also compared with the image before it.
"""

import math
from typing import NamedTuple

import cv2
import numpy as np

from factorgraph_loc.vision.keypoints import Descriptors, Float, Integers
from factorgraph_loc.vision.matching import Truths, match
from factors.camera.model import CameraModel, undistorted
from factors.se2 import Array

RADIUS = 0.25  # largest displacement of a feature, as a fraction of the longer side of the image
EPIPOLAR = 1.5  # px: largest distance of an inlier from its epipolar line
CONFIDENCE, DRAWS = 0.99, 300  # of USAC: confidence, and largest number of samples of five pairs
FEWEST = 16  # with fewer pairs, no outliers are rejected
OTHER_BODY = 0.5  # pairs of a second essential matrix are kept if they exceed this fraction of the rejected pairs


class _TrackedImage(NamedTuple):
    """The K features of one image. ``directions`` (K, 2): normalised image coordinates, which are x and y at depth 1.
    ``numbers`` (K,): the numbers of their tracks."""

    directions: Array
    descriptors: Descriptors
    numbers: Integers


class FeatureTracker:
    """Assigns track numbers to the features of consecutive images. Features with the same number show the same point.

    Call :meth:`follow` for each image in order of time. A track may miss one image, but not two in succession. Not
    thread-safe.
    """

    def __init__(self, camera: CameraModel) -> None:
        self._camera = camera
        self._last: _TrackedImage | None = None
        self._before: _TrackedImage | None = None  # the image before the last, without the features matched since
        self._count = 0  # number of tracks

    def follow(self, pixels: Array, descriptors: Descriptors) -> Integers:
        """Return the track numbers (K,) of the K features of the next image. ``pixels`` (K, 2), ``descriptors`` (K, D).
        A number occurs at most once per image. A feature without a match gets a new number."""
        numbers = np.full(len(pixels), -1, dtype=np.int64)
        image = _TrackedImage(undistorted(self._camera, pixels), descriptors, numbers)
        missed = None
        if self._last is not None:
            missed = self._continue_tracks(self._last, image)
            if self._before is not None:
                self._continue_tracks(self._before, image)
        fresh = np.flatnonzero(numbers < 0)
        numbers[fresh] = self._count + np.arange(len(fresh))
        self._count += len(fresh)
        self._last, self._before = image, missed
        return numbers

    def _continue_tracks(self, earlier: _TrackedImage, image: _TrackedImage) -> _TrackedImage:
        """Match the features of ``image`` without a track number with an ``earlier`` image, and write their numbers.
        Return the features of the earlier image that were not matched."""
        rows = np.flatnonzero(image.numbers < 0)
        current = image.directions[rows], image.descriptors[rows]
        matched = pairs(earlier[:2], current, self._camera)
        image.numbers[rows[matched[:, 1]]] = earlier.numbers[matched[:, 0]]
        missed = np.setdiff1d(np.arange(len(earlier.numbers)), matched[:, 0])
        return _TrackedImage(earlier.directions[missed], earlier.descriptors[missed], earlier.numbers[missed])


def pairs(first: tuple[Array, Descriptors], second: tuple[Array, Descriptors], camera: CameraModel) -> Integers:
    """Return the matches between the features of two images, as pairs (M, 2) of indices in the first and second image.

    ``first``, ``second``: the features of an image. They are normalised image coordinates (K, 2), x and y at depth 1,
    and descriptors (K, D). ``camera``: the calibration of the camera.
    """
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
        fits = _of_one_geometry(a[rejected], b[rejected], focal)
        if np.count_nonzero(fits) > OTHER_BODY * len(rejected):
            right[rejected] = fits
    return matched[right]


def _of_one_geometry(first: Float, second: Float, focal: float) -> Truths:
    """Return a mask (M,) of the pairs of pixels that fit one essential matrix. All are True if no matrix can be
    estimated. ``first``, ``second`` (M, 2) [px]: pixels relative to the principal point. ``focal`` [px]: the focal
    length."""
    matrix = np.diag((focal, focal, 1.0))
    try:
        _, inliers = cv2.findEssentialMat(first, second, matrix, cv2.USAC_FAST, CONFIDENCE, EPIPOLAR, DRAWS)
    except cv2.error:  # USAC of OpenCV 5.0 fails occasionally if the camera hardly moves
        inliers = None
    return np.ones(len(first), dtype=bool) if inliers is None else np.asarray(inliers.ravel() != 0)
