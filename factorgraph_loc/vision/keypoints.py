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

    ``points`` (N, 2) [px]: x right, y down, (0, 0) at the centre of the upper left pixel.
    ``sizes`` (N,) [px]: proportional to the size of the described region. For SIFT and colour features the size is
    twice the point's Gaussian scale, for ORB the side of its patch.
    ``angles`` (N,) [rad]: the direction ``atan2(dy, dx)`` with y down, NaN if a point has none.
    ``responses`` (N,): the strength, comparable within one image and one extractor.
    """

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
        """Return keypoints of OpenCV as this class. OpenCV's angle of -1 degrees means that there is no direction."""
        if not keypoints:
            return cls.empty()
        rows = np.array([(*k.pt, k.size, k.angle, k.response) for k in keypoints], dtype=float)
        angles = np.where(rows[:, 3] < 0.0, np.nan, np.radians(rows[:, 3]))
        return cls(rows[:, :2], rows[:, 2], angles, rows[:, 4])

    def to_cv2(self) -> list[cv2.KeyPoint]:
        """Return these points as keypoints of OpenCV."""
        degrees = np.where(np.isnan(self.angles), -1.0, np.degrees(self.angles) % 360.0)
        columns = (*self.points.T, self.sizes, degrees, self.responses)
        return list(map(cv2.KeyPoint, *(column.tolist() for column in columns)))


class Extractor(Protocol):
    """The interface of feature extractors: detector and descriptor of one kind of feature.

    Images are checked by :func:`~factorgraph_loc.vision.images.as_image`, which raises InputError. An image that is
    blank or has a side below 16 px has no features. At most ``count`` points are returned, the strongest first.
    ``count`` is an argument of the extractor's constructor.
    """

    def detect(self, image: object) -> Keypoints:
        """Return the features of ``image``."""

    def detectAndCompute(self, image: object) -> tuple[Keypoints, Descriptors]:  # noqa: N802 (as OpenCV)
        """Return the N features of ``image`` and the descriptors: bits (N, bytes) ``uint8``, or (N, D) ``float32``."""


PARTS = 12  # grid cells for features in all parts of an image: with more cells, very weak features would be chosen


def spread_out(pixels: Array, count: int, priority: Sequence[int] | None = None, cells: int | None = None) -> Integers:
    """Return the indices of at most ``count`` pixels that are distributed over the image, in ascending order.

    ``pixels`` (K, 2) [px]: divided into the cells of a grid. One pixel is taken from each cell in turn, until there are
    enough. ``cells``: the approximate number of cells, None for ``count`` cells. ``priority`` (K,): in each cell,
    pixels with a higher priority are taken first. None means the order of ``pixels``.
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
