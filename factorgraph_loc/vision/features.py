"""Features by name: the paper's colour features and OpenCV's SIFT and ORB behind one interface.

``extractor("colour")``, ``extractor("sift")`` and ``extractor("orb")`` take and give the same, so that what uses features need not
know which; a caller asks ``binary`` to choose between Hamming and Euclidean distance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import nearest
from factorgraph_loc.vision.images import as_image, as_mask, is_blank
from factors.se2 import Array

Integers = NDArray[np.int64]
Descriptors = NDArray[Any]

SIFT_CONTRAST = 0.01  # OpenCV's default of 0.04 finds too few points in indoor images


@dataclass(frozen=True, eq=False)
class Keypoints:
    """N points of an image, as arrays.

    ``points`` (N, 2) [px]: x right, y down, (0, 0) at the centre of the upper left pixel. ``sizes`` (N,) [px]: for SIFT and the
    colour features twice the standard deviation of the Gaussian scale at which a point was found, for ORB its patch; within one
    feature the region that a point stands for is a fixed multiple of it. ``angles`` (N,) [rad]: direction ``atan2(dy, dx)`` with y
    down; NaN where a point has none. ``responses`` (N,): strength, comparable within one image and one extractor. ``levels`` (N,): the level of the scale
    that a point was found at; for OpenCV's features its packed octave.
    """

    points: Array
    sizes: Array
    angles: Array
    responses: Array
    levels: Integers

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, index: Any) -> Keypoints:
        """The points of an index array, a truth array or a slice."""
        return Keypoints(
            self.points[index], self.sizes[index], self.angles[index], self.responses[index], self.levels[index]
        )

    @classmethod
    def empty(cls) -> Keypoints:
        return cls(np.empty((0, 2)), np.empty(0), np.empty(0), np.empty(0), np.empty(0, dtype=np.int64))

    @classmethod
    def from_cv2(cls, keypoints: Sequence[cv2.KeyPoint]) -> Keypoints:
        """OpenCV's points, degrees as radians; its angle of -1 means none."""
        if not keypoints:
            return cls.empty()
        rows = np.array([(*k.pt, k.size, k.angle, k.response) for k in keypoints], dtype=float)
        angles = np.where(rows[:, 3] < 0.0, np.nan, np.radians(rows[:, 3]))
        levels = np.array([k.octave for k in keypoints], dtype=np.int64)
        return cls(rows[:, :2], rows[:, 2], angles, rows[:, 4], levels)

    def to_cv2(self) -> list[cv2.KeyPoint]:
        """The same points as OpenCV has them; ``class_id`` is the index of a point."""
        degrees = np.where(np.isnan(self.angles), -1.0, np.degrees(self.angles) % 360.0)
        columns = (*self.points.T, self.sizes, degrees, self.responses, self.levels, np.arange(len(self)))
        return list(map(cv2.KeyPoint, *(column.tolist() for column in columns)))


class Extractor(Protocol):
    """Detector and descriptor of one kind of feature.

    Images and masks are what :func:`~factorgraph_loc.vision.images.as_image` and ``as_mask`` take, which raise InputError on
    others; an image that is blank or below 16 px has no features. At most ``count`` of them are given, the strongest first.
    """

    @property
    def name(self) -> str: ...

    @property
    def binary(self) -> bool:
        """Whether descriptors are bits, (N, bytes) ``uint8``, compared by Hamming distance, and not (N, D) ``float32`` by the
        Euclidean one."""

    def detect(self, image: object, mask: object = None) -> Keypoints:
        """The points of ``image`` where ``mask`` (H, W) is not 0."""

    def compute(self, image: object, keypoints: Keypoints) -> tuple[Keypoints, Descriptors]:
        """Those of ``keypoints`` that can be described, and the descriptors of each."""

    def detectAndCompute(self, image: object, mask: object = None) -> tuple[Keypoints, Descriptors]:  # noqa: N802 (as OpenCV)
        """:meth:`detect` and :meth:`compute` in one."""


class OpenCvExtractor:
    """A feature of OpenCV behind :class:`Extractor`."""

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
    """Indices of at most ``count`` points by falling response: OpenCV keeps more where responses are equal."""
    return np.argsort(-keypoints.responses, kind="stable")[:count].astype(np.int64)


def _sift(count: int) -> Extractor:
    return OpenCvExtractor("sift", cv2.SIFT.create(nfeatures=count, contrastThreshold=SIFT_CONTRAST), count)


def _orb(count: int) -> Extractor:
    return OpenCvExtractor("orb", cv2.ORB.create(nfeatures=count), count)


EXTRACTORS: dict[str, Callable[[int], Extractor]] = {"sift": _sift, "orb": _orb}


def extractor(name: str, count: int = 1000) -> Extractor:
    """The feature of that name in :data:`EXTRACTORS`, at most ``count`` of them in an image; InputError if there is none."""
    if name not in EXTRACTORS:
        raise InputError(f"feature {name!r} is not known{nearest(name, sorted(EXTRACTORS))}")
    if count < 1:
        raise InputError(f"feature {name}: count is {count}, expected at least 1")
    return EXTRACTORS[name](count)
