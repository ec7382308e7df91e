"""Extractors of point features by name: the paper's colour features, and OpenCV's SIFT and ORB."""

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import nearest
from factorgraph_loc.text import quoted
from factorgraph_loc.vision.colour_features import ColourExtractor
from factorgraph_loc.vision.images import as_image, is_blank
from factorgraph_loc.vision.keypoints import PARTS, Descriptors, Extractor, Integers, Keypoints, spread_out

__all__ = ["EXTRACTORS", "Descriptors", "Extractor", "Integers", "Keypoints", "OpenCvExtractor", "extractor"]

MORE = 10  # with ``everywhere``, this multiple of ``count`` features is detected, and ``count`` are selected
SIFT_CONTRAST = 0.01  # OpenCV's default of 0.04 finds too few points in indoor images


class OpenCvExtractor:
    """An :class:`Extractor` that uses a feature of OpenCV.

    ``create``: the function of OpenCV that creates the feature. ``count``: the largest number of features per image.
    ``everywhere``: True to choose features in all parts of an image, False to choose the strongest.
    """

    def __init__(self, create: Callable[..., cv2.Feature2D], count: int, *, everywhere: bool = False) -> None:
        self._feature = create(nfeatures=count * MORE if everywhere else count)
        self._count, self._everywhere = count, everywhere

    def detect(self, image: object) -> Keypoints:
        pixels = as_image(image)
        if is_blank(pixels):
            return Keypoints.empty()
        keypoints = Keypoints.from_cv2(self._feature.detect(pixels))
        return keypoints[self._chosen(keypoints)]

    def detectAndCompute(self, image: object) -> tuple[Keypoints, Descriptors]:  # noqa: N802 (as OpenCV)
        pixels = as_image(image)
        detected, descriptors = ((), None) if is_blank(pixels) else self._feature.detectAndCompute(pixels, None)
        if descriptors is None:
            kind = np.uint8 if self._feature.descriptorType() == cv2.CV_8U else np.float32
            return Keypoints.empty(), np.empty((0, self._feature.descriptorSize()), dtype=kind)
        keypoints = Keypoints.from_cv2(detected)
        order = self._chosen(keypoints)
        return keypoints[order], np.asarray(descriptors)[order]

    def _chosen(self, keypoints: Keypoints) -> Integers:
        """Return the indices of at most ``count`` keypoints, by descending response. OpenCV may return more."""
        order = np.argsort(-keypoints.responses, kind="stable").astype(np.int64)
        if self._everywhere:
            return order[spread_out(keypoints.points[order], self._count, cells=PARTS)]
        return order[: self._count]


EXTRACTORS: dict[str, Callable[..., Extractor]] = {
    "colour": ColourExtractor,
    "sift": partial(OpenCvExtractor, partial(cv2.SIFT.create, contrastThreshold=SIFT_CONTRAST)),
    "orb": partial(OpenCvExtractor, cv2.ORB.create),
}


def extractor(name: str, count: int = 1000, *, everywhere: bool = False) -> Extractor:
    """Return a new extractor of features. ``name``: a key of :data:`EXTRACTORS`, such as "sift".

    ``count``: the largest number of features per image. ``everywhere``: True to choose features in all parts of an
    image, False to choose the strongest. Raises InputError for an unknown name or a ``count`` below 1.
    """
    if name not in EXTRACTORS:
        raise InputError(f"feature {quoted(name)} is not known{nearest(name, sorted(EXTRACTORS))}")
    if count < 1:
        raise InputError(f"feature {name}: count is {count}, expected at least 1")
    return EXTRACTORS[name](count, everywhere=everywhere)
