"""Keypoints as arrays, and the interface of feature extractors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from factors.se2 import Array

Float = NDArray[np.float32]
Integers = NDArray[np.int64]
Descriptors = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Keypoints:
    """N points of an image, as arrays.

    ``points`` (N, 2) [px]: x right, y down, (0, 0) at the centre of the upper left pixel. ``sizes`` (N,) [px]: for SIFT and the
    colour features twice the standard deviation of the Gaussian scale of a point, for ORB its patch. It is proportional to the
    size of the described region. ``angles`` (N,) [rad]: direction ``atan2(dy, dx)`` with y down, NaN if a point has none.
    ``responses`` (N,): strength, comparable within one image and one extractor."""

    points: Array
    sizes: Array
    angles: Array
    responses: Array

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, index: Any) -> Keypoints:
        return Keypoints(self.points[index], self.sizes[index], self.angles[index], self.responses[index])

    @classmethod
    def empty(cls) -> Keypoints:
        return cls(np.empty((0, 2)), np.empty(0), np.empty(0), np.empty(0))

    @classmethod
    def from_cv2(cls, keypoints: Sequence[cv2.KeyPoint]) -> Keypoints:
        """Convert OpenCV's keypoints, with degrees to radians; its angle of -1 means none."""
        if not keypoints:
            return cls.empty()
        rows = np.array([(*k.pt, k.size, k.angle, k.response) for k in keypoints], dtype=float)
        angles = np.where(rows[:, 3] < 0.0, np.nan, np.radians(rows[:, 3]))
        return cls(rows[:, :2], rows[:, 2], angles, rows[:, 4])

    def to_cv2(self) -> list[cv2.KeyPoint]:
        """Convert to OpenCV's keypoints."""
        degrees = np.where(np.isnan(self.angles), -1.0, np.degrees(self.angles) % 360.0)
        columns = (*self.points.T, self.sizes, degrees, self.responses)
        return list(map(cv2.KeyPoint, *(column.tolist() for column in columns)))


class Extractor(Protocol):
    """Detector and descriptor of one kind of feature.

    Images are checked by :func:`~factorgraph_loc.vision.images.as_image`, which raises InputError; an image that is blank or
    below 16 px has no features. Returns at most ``count`` points, the strongest first."""

    def detect(self, image: object) -> Keypoints:
        """The points of ``image``."""

    def detectAndCompute(self, image: object) -> tuple[Keypoints, Descriptors]:  # noqa: N802 (as OpenCV)
        """The points of ``image``, and their descriptors: bits, (N, bytes) ``uint8``, or numbers, (N, D) ``float32``."""


PARTS = 12  # of an image that has features everywhere: with more the weakest would be among them


def spread_out(pixels: Array, count: int, priority: Sequence[int] | None = None, cells: int | None = None) -> Integers:
    """Ascending indices of at most ``count`` of ``pixels`` (K, 2), chosen in turn from about ``cells`` cells of a grid.

    ``cells``: by default ``count``. ``priority`` (K,): highest first in each cell, by default the first pixels.
    """
    if len(pixels) <= count:
        return np.arange(len(pixels))
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    side = max(math.sqrt(float(np.prod(high - low)) / (cells or count)), 1.0)
    column, line = np.floor((pixels - low) / side).T
    cell = column * (line.max() + 1.0) + line
    order = np.lexsort((np.zeros(len(pixels)) if priority is None else -np.asarray(priority), cell))
    turns = np.empty(len(pixels), dtype=np.int64)
    turns[order] = np.arange(len(pixels)) - np.searchsorted(cell[order], cell[order])  # rank within the cell
    return np.sort(np.argsort(turns, kind="stable")[:count])
