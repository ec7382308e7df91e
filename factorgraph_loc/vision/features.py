"""Features by name: the paper's colour features, and OpenCV's SIFT and ORB, behind one interface.

A caller uses ``binary`` to choose between Hamming and Euclidean distance."""

from collections.abc import Callable

import cv2
import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import nearest
from factorgraph_loc.text import quoted
from factorgraph_loc.vision.colour_features import ColourExtractor
from factorgraph_loc.vision.images import as_image, as_mask, is_blank
from factorgraph_loc.vision.keypoints import Descriptors, Extractor, Integers, Keypoints

__all__ = ["EXTRACTORS", "Descriptors", "Extractor", "Integers", "Keypoints", "OpenCvExtractor", "extractor"]

SIFT_CONTRAST = 0.01  # OpenCV's default of 0.04 finds too few points in indoor images


class OpenCvExtractor:
    """An OpenCV feature behind :class:`Extractor`."""

    def __init__(self, name: str, feature: cv2.Feature2D, count: int) -> None:
        self.name = name
        self.binary = feature.descriptorType() == cv2.CV_8U
        self._feature = feature
        self._count = count

    def detect(self, image: object, mask: object = None) -> Keypoints:
        pixels = as_image(image)
        where = as_mask(mask, pixels)
        if is_blank(pixels):
            return Keypoints.empty()
        return self._strongest(Keypoints.from_cv2(self._feature.detect(pixels, where)))

    def compute(self, image: object, keypoints: Keypoints) -> tuple[Keypoints, Descriptors]:
        pixels = as_image(image)
        if len(keypoints) == 0 or is_blank(pixels):
            return Keypoints.empty(), self._none()
        described, descriptors = self._feature.compute(pixels, keypoints.to_cv2())
        if descriptors is None:
            return Keypoints.empty(), self._none()
        # ORB drops points near the border and sorts the others
        return keypoints[np.array([k.class_id for k in described])], np.asarray(descriptors)

    def detectAndCompute(self, image: object, mask: object = None) -> tuple[Keypoints, Descriptors]:  # noqa: N802 (as OpenCV)
        pixels = as_image(image)
        where = as_mask(mask, pixels)
        if is_blank(pixels):
            return Keypoints.empty(), self._none()
        found, descriptors = self._feature.detectAndCompute(pixels, where)
        if descriptors is None:
            return Keypoints.empty(), self._none()
        keypoints = Keypoints.from_cv2(found)
        order = _strongest_first(keypoints, self._count)
        return keypoints[order], np.asarray(descriptors)[order]

    def _strongest(self, keypoints: Keypoints) -> Keypoints:
        return keypoints[_strongest_first(keypoints, self._count)]

    def _none(self) -> Descriptors:
        kind = np.uint8 if self.binary else np.float32
        return np.empty((0, self._feature.descriptorSize()), dtype=kind)


def _strongest_first(keypoints: Keypoints, count: int) -> Integers:
    """Indices of at most ``count`` points by descending response: OpenCV keeps more at equal responses."""
    return np.argsort(-keypoints.responses, kind="stable")[:count].astype(np.int64)


def _sift(count: int) -> Extractor:
    return OpenCvExtractor("sift", cv2.SIFT.create(nfeatures=count, contrastThreshold=SIFT_CONTRAST), count)


def _orb(count: int) -> Extractor:
    return OpenCvExtractor("orb", cv2.ORB.create(nfeatures=count), count)


EXTRACTORS: dict[str, Callable[[int], Extractor]] = {"colour": ColourExtractor, "sift": _sift, "orb": _orb}


def extractor(name: str, count: int = 1000) -> Extractor:
    """The extractor ``name`` of :data:`EXTRACTORS`, with at most ``count`` features per image. Raises InputError for an unknown
    name."""
    if name not in EXTRACTORS:
        raise InputError(f"feature {quoted(name)} is not known{nearest(name, sorted(EXTRACTORS))}")
    if count < 1:
        raise InputError(f"feature {name}: count is {count}, expected at least 1")
    return EXTRACTORS[name](count)
