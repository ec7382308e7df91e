"""Reading and checking of images. A checked image has the type ``uint8`` and is grey or BGR, as in OpenCV."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.bounded import IMAGE, foreign, quiet, read_bytes
from factorgraph_loc.files.images import NO_IMAGE, image_size

Image = NDArray[np.uint8]

MIN_SIDE = 16  # px: smaller images have no features


def as_image(array: object, source: object = "image") -> Image:
    """Return an image as a C-contiguous array of ``uint8``, (H, W) if it is grey or (H, W, 3) BGR.

    ``array``: (H, W), (H, W, 1), (H, W, 3) BGR or (H, W, 4) BGRA. Alpha is dropped. ``uint16`` values from 0 to 65535
    and floating-point values from 0 to 1 are scaled to 0 to 255. ``source``: the name of the image, for error messages.
    Raises InputError for an empty array, another shape or type, and values that are not finite or out of range.
    """
    if not isinstance(array, np.ndarray):
        raise InputError(f"{source}: is {type(array).__name__}, expected an array of pixels")
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] not in (1, 3, 4)):
        raise InputError(f"{source}: has shape {array.shape}, expected (H, W), or (H, W, C) with 1, 3 or 4 channels")
    if array.size == 0:
        raise InputError(f"{source}: is empty, of shape {array.shape}, expected at least one pixel")
    if array.ndim == 3:
        array = array[:, :, 0] if array.shape[2] == 1 else array[:, :, :3]
    if array.dtype == np.uint8:
        return np.ascontiguousarray(array)
    if array.dtype == np.uint16:
        scaled = array.astype(np.uint32)  # in place, to save memory for large images
        scaled += 128
        scaled //= 257
        return np.ascontiguousarray(scaled, dtype=np.uint8)
    if array.dtype.kind != "f":
        raise InputError(f"{source}: has pixels of type {array.dtype}, expected uint8, uint16 or floating point")
    if not np.isfinite(array).all():
        raise InputError(f"{source}: has {np.count_nonzero(~np.isfinite(array))} values that are not finite numbers")
    low, high = float(array.min()), float(array.max())
    if low < 0.0 or high > 1.0:
        raise InputError(f"{source}: has floating-point values from {low:g} to {high:g}, expected 0 to 1")
    return np.ascontiguousarray(np.rint(array * 255.0), dtype=np.uint8)


def is_blank(image: Image) -> bool:
    """True if an image cannot have features, because a side is below :data:`MIN_SIDE` or all its pixels are equal."""
    # compare row by row: in most images the first row has different pixels, and no other row needs to be compared
    return min(image.shape[:2]) < MIN_SIDE or all(bool((row == image[0, 0]).all()) for row in image)


def read_image(path: Path) -> Image:
    """Return the image in a file as an array of ``uint8``, (H, W) or (H, W, 3) BGR.

    Raises InputError if the file is missing, cannot be decoded or has too many pixels.
    """
    return as_image(decoded(read_bytes(path, IMAGE), path, cv2.IMREAD_UNCHANGED), path)


def decoded(content: bytes, source: object, flags: int) -> NDArray[Any]:
    """Return the pixels of an image file, decoded with OpenCV: (H, W) or (H, W, C).

    ``content``: the bytes of the file. ``source``: its name, for error messages. ``flags``: see ``cv2.imdecode``.
    Raises InputError if the bytes are no image, or if it has more than :data:`~factorgraph_loc.files.bounded.PIXELS`
    pixels. The number is checked before memory is allocated, because OpenCV itself allows 2^30 pixels.
    """
    image_size(content, source)
    with foreign(source, NO_IMAGE), quiet():
        image = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), flags)
    if image is None:
        raise InputError(f"{source}: {NO_IMAGE}, expected PNG, JPEG, PPM or the like")
    return np.asarray(image)
