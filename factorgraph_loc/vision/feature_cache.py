"""Disk cache of the features of images, and the conversion of features to bytes.

The cache is in the user's cache folder. If it is missing, full or damaged, features are computed again.
"""

import os
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.bounded import DATA, read_bytes
from factorgraph_loc.files.models import replacing
from factorgraph_loc.vision.keypoints import Descriptors, Keypoints
from factors.se2 import Array

# number of points, columns of the descriptors, whether descriptors have the type uint8, whether they are stored as uint8
_FEATURES = struct.Struct("<IIBB")


@dataclass(frozen=True, eq=False)
class ImageFeatures:
    """The K features of an image: ``pixels`` (K, 2) [px] and ``descriptors`` (K, D)."""

    pixels: Array
    descriptors: Descriptors


def encode(keypoints: Keypoints, descriptors: Descriptors) -> bytes:
    """Return features as bytes. Pixel coordinates are rounded to float32: the error is at most 0.001 px below 16384 px.
    Descriptors are stored without loss."""
    points = keypoints.points.astype("<f4")
    binary = descriptors.dtype == np.uint8
    narrow = descriptors.astype(np.uint8)
    fits = binary or bool(np.array_equal(narrow, descriptors))  # SIFT's values are integers below 256
    kept: NDArray[Any] = narrow if fits else descriptors.astype("<f4")
    return _FEATURES.pack(*descriptors.shape, binary, fits) + points.tobytes() + kept.tobytes()


def decode(content: bytes) -> ImageFeatures:
    """Return the features that :func:`encode` encoded. Raises ValueError if ``content`` is something else."""
    if len(content) < _FEATURES.size:
        raise ValueError("these bytes are no features")
    count, columns, binary, fits = _FEATURES.unpack_from(content)
    split = _FEATURES.size + 8 * count
    if len(content) != split + count * columns * (1 if fits else 4):
        raise ValueError("these bytes are no features")
    pixels = np.frombuffer(content[_FEATURES.size : split], dtype="<f4").reshape(count, 2).astype(float)
    stored = np.frombuffer(content[split:], dtype=np.uint8 if fits else "<f4").reshape(count, columns)
    return ImageFeatures(pixels, stored.astype(np.uint8 if binary else np.float32))


VARIABLE = "FGLOC_CACHE"  # environment variable that names the folder of the cache
LIMIT = 4 * 10**9  # bytes: largest size of the cache
_HEAD = struct.Struct("<4sII")  # mark, CRC-32 and length of the content
_MARK = b"FGLC"


def cache_folder() -> Path:
    """Return the cache folder: the environment variable ``FGLOC_CACHE`` if it is set, else the user's cache folder."""
    folder_name = os.environ.get(VARIABLE)
    return Path(folder_name) if folder_name else platformdirs.user_cache_path("factorgraph-loc", appauthor=False)


class FeatureCache:
    """A cache on disk for the encoded features of images. The features of each image are a file below ``folder``.

    A key identifies an image and the method, and names the file. Call :meth:`trim` to limit the total size. ``fault``:
    an error message after a file could not be written, otherwise empty.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder / "features"
        self.fault = ""

    def read(self, key: str) -> bytes | None:
        """Return the bytes stored under ``key``, or None if they are missing or damaged. The entry then counts as just
        used."""
        path = self._path(key)
        try:
            stored = read_bytes(path, DATA)
            if len(stored) < _HEAD.size:
                return None
            mark, check, length = _HEAD.unpack_from(stored)
            content = stored[_HEAD.size :]
            if mark != _MARK or len(content) != length or zlib.crc32(content) != check:
                return None
            os.utime(path)
        except (OSError, InputError):
            return None
        return content

    def write(self, key: str, content: bytes) -> None:
        """Store ``content`` under ``key``, atomically. If this fails, ``fault`` is set to a message, and no error is
        raised."""
        if self.fault:
            return
        path = self._path(key)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with replacing(path) as temporary:
                temporary.write_bytes(_HEAD.pack(_MARK, zlib.crc32(content), len(content)) + content)
        except OSError as error:
            self.fault = f"{self._folder}: cannot be written: {error.strerror}"

    def trim(self) -> None:
        """Delete the least recently used files until the size of the cache is at most :data:`LIMIT`."""
        files = []  # without temporary files, which are still being written
        for path in self._folder.glob("*/[!.]*"):
            try:
                status = path.stat()
            except OSError:  # removed by another process
                continue
            files.append((status.st_mtime_ns, status.st_size, path))
        excess = sum(size for _, size, _ in files) - LIMIT
        for _, size, path in sorted(files):
            if excess <= 0:
                return
            try:
                path.unlink(missing_ok=True)
            except OSError:
                return
            excess -= size

    def _path(self, key: str) -> Path:
        # two levels of folders: some file systems are slow with many files in one
        return self._folder / key[:2] / key
