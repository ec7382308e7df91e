"""Compact encoding of the features of one image, for transfer between processes and storage."""

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.vision.keypoints import Descriptors, Keypoints
from factors.se2 import Array

_HEAD = struct.Struct(
    "<IIBB"
)  # points, columns of descriptors, whether these are bytes, whether they are stored as bytes


@dataclass(frozen=True, eq=False)
class ImageFeatures:
    """``pixels`` (K, 2) and ``sizes`` (K,) [px], ``descriptors`` (K, D)."""

    pixels: Array
    sizes: Array
    descriptors: Descriptors


def encode(keypoints: Keypoints, descriptors: Descriptors) -> bytes:
    """Encode pixels and sizes with 24 bits (0.001 px or better), descriptors without loss."""
    points = np.column_stack((keypoints.points, keypoints.sizes)).astype("<f4")
    binary = descriptors.dtype == np.uint8
    narrow = descriptors.astype(np.uint8)
    fits = binary or bool(np.array_equal(narrow, descriptors))  # those of SIFT are integers below 256
    kept: NDArray[Any] = narrow if fits else descriptors.astype("<f4")
    return _HEAD.pack(*descriptors.shape, binary, fits) + points.tobytes() + kept.tobytes()


def decode(content: bytes) -> ImageFeatures:
    """Decode the result of :func:`encode`; ValueError for other bytes."""
    if len(content) < _HEAD.size:
        raise ValueError("these bytes are no features")
    count, columns, binary, fits = _HEAD.unpack_from(content)
    split = _HEAD.size + 12 * count
    if len(content) != split + count * columns * (1 if fits else 4):
        raise ValueError("these bytes are no features")
    points = np.frombuffer(content[_HEAD.size : split], dtype="<f4").reshape(count, 3).astype(float)
    stored = np.frombuffer(content[split:], dtype=np.uint8 if fits else "<f4").reshape(count, columns)
    descriptors = stored.astype(np.uint8 if binary else np.float32)
    return ImageFeatures(np.ascontiguousarray(points[:, :2]), np.ascontiguousarray(points[:, 2]), descriptors)
