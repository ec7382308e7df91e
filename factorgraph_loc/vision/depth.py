"""Depths of features, from the depth image that belongs to an image."""

from pathlib import Path

import cv2
import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.bounded import IMAGE, read_bytes
from factorgraph_loc.vision.images import decoded
from factors.se2 import Array

EDGE = 0.05  # relative difference of the depths around a pixel, beyond which it may show either side of an edge
BEYOND = np.iinfo(np.uint16).max  # what cameras write where nothing is in their range
AROUND = np.ones((3, 3), dtype=np.uint8)


def depths_at(path: Path, pixels: Array, size: tuple[int, int], unit: float) -> Array:
    """As :func:`depths_in` of the image ``path``. InputError if it is missing, cannot be decoded, or is no such image."""
    return depths_in(decoded(read_bytes(path, IMAGE), path, cv2.IMREAD_UNCHANGED), pixels, size, unit, str(path))


def depths_in(image: object, pixels: Array, size: tuple[int, int], unit: float, where: str) -> Array:
    """The depths (K,) [m] at ``pixels`` (K, 2) in a 16-bit image of ``size`` (width, height), NaN where there is none, with a value
    of 0 or the largest, and at edges; a value of 1 is ``unit`` [m]. InputError, which begins with ``where``, if it is no such
    image."""
    expected = f"expected {size[0]} x {size[1]} px of uint16"
    if not isinstance(image, np.ndarray) or image.ndim not in {2, 3}:
        raise InputError(f"{where}: is {type(image).__name__}, {expected}")
    if image.dtype != np.uint16 or image.shape != size[::-1]:
        channels = f", {image.shape[2]} channels" if image.ndim == 3 else ""
        raise InputError(f"{where}: has {image.shape[1]} x {image.shape[0]} px of {image.dtype}{channels}, {expected}")
    column, row = np.clip(np.rint(pixels).astype(np.int64), 0, np.array(size) - 1).T
    least, most = (found[row, column].astype(float) for found in (cv2.erode(image, AROUND), cv2.dilate(image, AROUND)))
    value = image[row, column]
    measured = (least > 0) & (most < BEYOND)
    return np.where(measured & (most - least <= EDGE * value), value * unit, np.nan)
