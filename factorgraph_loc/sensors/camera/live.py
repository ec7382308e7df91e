"""Online feature detection and tracking, equal to :mod:`.frontend` and :mod:`.tracks` on a log."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.vision.features import extractor
from factorgraph_loc.vision.found import ImageFeatures, decode, encode
from factorgraph_loc.vision.frame import CameraFrame
from factorgraph_loc.vision.images import as_image
from factorgraph_loc.vision.keypoints import Integers
from factorgraph_loc.vision.settings import FrontendSettings
from factorgraph_loc.vision.tracks import pairs
from factors.camera.model import CameraModel, undistorted
from factors.se2 import Array


@dataclass
class _RecentImage:
    """A recent image: directions (K, 2) and track numbers (K,) of its features, and which the next image did not match."""

    found: ImageFeatures
    directions: Array
    numbers: Integers
    missed: Integers


class LiveFrontend:
    """Detects and tracks features, keeping the last two images. Not thread-safe."""

    def __init__(self, settings: FrontendSettings, camera: CameraModel) -> None:
        self._feature, self._camera = settings.feature, camera
        self._extractor = extractor(settings.feature, settings.count, everywhere=settings.everywhere)
        self._last: deque[_RecentImage] = deque(maxlen=2)
        self._following = 0

    def frame(self, t: float, image: object) -> CameraFrame:
        """The features of an image taken at ``t`` [s], an array as in :func:`~factorgraph_loc.vision.images.as_image`.

        InputError if it is no such array, or has another size than the camera is calibrated for.
        """
        pixels = as_image(image, f"image at {t:.3f} s")
        height, width = pixels.shape[:2]
        if (width, height) != (self._camera.width, self._camera.height):
            raise InputError(
                f"image at {t:.3f} s: has {width} x {height} px, expected {self._camera.width} x {self._camera.height}"
            )
        found = decode(encode(*self._extractor.detectAndCompute(pixels)))
        numbers = self._follow(found)
        return CameraFrame(t, self._feature, found.pixels, found.sizes, found.descriptors, numbers)

    def _follow(self, found: ImageFeatures) -> Integers:
        """Track numbers (K,) of the features of the next image; see :func:`~factorgraph_loc.vision.tracks.follow`."""
        every = np.arange(len(found.pixels))
        numbers = np.full(len(every), -1, dtype=np.int64)
        here = _RecentImage(found, undistorted(self._camera, found.pixels), numbers, every)
        if self._last:
            last = self._last[-1]
            near = self._pairs(last, np.arange(len(last.numbers)), here, every)
            numbers[near[:, 1]] = last.numbers[near[:, 0]]
            last.missed = np.setdiff1d(np.arange(len(last.numbers)), near[:, 0])
            if len(self._last) > 1:
                before = self._last[0]
                far = self._pairs(before, before.missed, here, np.setdiff1d(every, near[:, 1]))
                numbers[far[:, 1]] = before.numbers[far[:, 0]]
        fresh = np.flatnonzero(numbers < 0)
        numbers[fresh] = self._following + np.arange(len(fresh))
        self._following += len(fresh)
        self._last.append(here)
        return numbers

    def _pairs(self, a: _RecentImage, first: Integers, b: _RecentImage, second: Integers) -> Integers:
        """Matches (M, 2) between features ``first`` of one image and ``second`` of another."""
        found = pairs(
            (a.directions[first], a.found.descriptors[first]),
            (b.directions[second], b.found.descriptors[second]),
            self._camera,
            binary=self._extractor.binary,
        )
        return np.column_stack((first[found[:, 0]], second[found[:, 1]]))
