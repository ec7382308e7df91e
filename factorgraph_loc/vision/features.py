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
from factorgraph_loc.vision.keypoints import PARTS, Descriptors, Extractor, Integers, Keypoints, spread_out

__all__ = ["EXTRACTORS", "Descriptors", "Extractor", "Integers", "Keypoints", "OpenCvExtractor", "extractor"]

MORE = 10  # times as many features are found where those are chosen that are everywhere
SIFT_CONTRAST = 0.01  # OpenCV's default of 0.04 finds too few points in indoor images


class OpenCvExtractor:
    """An OpenCV feature behind :class:`Extractor`."""

    def __init__(self, name: str, feature: cv2.Feature2D, count: int, *, everywhere: bool = False) -> None:
        self.name = name
        self._everywhere = everywhere
        self.binary = feature.descriptorType() == cv2.CV_8U
        self._feature = feature
        self._count = count

    def detect(self, image: object, mask: object = None) -> Keypoints:
        pixels = as_image(image)
        where = as_mask(mask, pixels)
        if is_blank(pixels):
            return Keypoints.empty()
        keypoints = Keypoints.from_cv2(self._feature.detect(pixels, where))
        return keypoints[self._chosen(keypoints)]

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
        detected, descriptors = self._feature.detectAndCompute(pixels, where)
        if descriptors is None:
            return Keypoints.empty(), self._none()
        keypoints = Keypoints.from_cv2(detected)
        order = self._chosen(keypoints)
        return keypoints[order], np.asarray(descriptors)[order]

    def _chosen(self, keypoints: Keypoints) -> Integers:
        """Indices of the points, by descending response: OpenCV keeps more than asked for at equal responses."""
        order = np.argsort(-keypoints.responses, kind="stable").astype(np.int64)
        if self._everywhere:
            return order[spread_out(keypoints.points[order], self._count, cells=PARTS)]
        return order[: self._count]

    def _none(self) -> Descriptors:
        kind = np.uint8 if self.binary else np.float32
        return np.empty((0, self._feature.descriptorSize()), dtype=kind)


def _colour(count: int, everywhere: bool) -> Extractor:
    return ColourExtractor(count, everywhere=everywhere)


def _sift(count: int, everywhere: bool) -> Extractor:
    detected = count * MORE if everywhere else count
    feature = cv2.SIFT.create(nfeatures=detected, contrastThreshold=SIFT_CONTRAST)
    return OpenCvExtractor("sift", feature, count, everywhere=everywhere)


def _orb(count: int, everywhere: bool) -> Extractor:
    feature = cv2.ORB.create(nfeatures=count * MORE if everywhere else count)
    return OpenCvExtractor("orb", feature, count, everywhere=everywhere)


EXTRACTORS: dict[str, Callable[[int, bool], Extractor]] = {"colour": _colour, "sift": _sift, "orb": _orb}


def extractor(name: str, count: int = 1000, *, everywhere: bool = False) -> Extractor:
    """The extractor ``name`` of :data:`EXTRACTORS`, with at most ``count`` features per image: the strongest, or of all its parts
    ``everywhere``. Raises InputError for an unknown name."""
    if name not in EXTRACTORS:
        raise InputError(f"feature {quoted(name)} is not known{nearest(name, sorted(EXTRACTORS))}")
    if count < 1:
        raise InputError(f"feature {name}: count is {count}, expected at least 1")
    return EXTRACTORS[name](count, everywhere)
