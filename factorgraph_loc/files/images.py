"""What the heads of images say, before anything is decoded."""

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from PIL import Image, UnidentifiedImageError

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.bounded import IMAGE, PIXELS, foreign, opened

# without those for which Pillow would start other programs
FORMATS = ("PNG", "JPEG", "PPM", "BMP", "TIFF", "WEBP", "GIF", "TGA", "SUN", "JPEG2000")
PNG = b"\x89PNG\r\n\x1a\n"
NO_IMAGE = "is not an image that can be decoded"
TOO_LARGE = f"has too many pixels, expected at most {PIXELS:,}"


@contextmanager
def pillow_image(file: BinaryIO, source: object) -> Iterator[Image.Image]:
    """An image by Pillow, not decoded yet; InputError if it is none, has more than :data:`~bounded.PIXELS` pixels or, when it is
    used, does not decode."""
    with foreign(source, NO_IMAGE), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of sizes that Pillow takes for too large, and of damaged metadata
        try:
            image = Image.open(file, formats=FORMATS)
        except UnidentifiedImageError as error:  # its text is about an object in memory
            raise InputError(f"{source}: {NO_IMAGE}, expected PNG, JPEG, PPM or the like") from error
        except Image.DecompressionBombError as error:  # beyond Pillow's own limit, which is higher
            raise InputError(f"{source}: {TOO_LARGE}") from error
        with image:
            if image.width * image.height > PIXELS:
                raise InputError(f"{source}: {TOO_LARGE}")
            yield image


def image_size(content: bytes, source: object) -> tuple[int, int]:
    """Width and height [px] as the head says them; InputError as of :func:`pillow_image`, and for a PNG of which a part says it
    is longer than the file, for which OpenCV takes memory."""
    at = len(PNG) if content.startswith(PNG) else len(content)
    while at + 8 <= len(content):
        at += 12 + int.from_bytes(content[at : at + 4], "big")
        if at > len(content):
            raise InputError(f"{source}: {NO_IMAGE}: it is cut off, or a part of it is damaged")
    with pillow_image(io.BytesIO(content), source) as image:
        return image.size


def size_of_file(path: Path) -> tuple[int, int]:
    """As :func:`image_size`, of the image in a file, of which only the head is read."""
    with opened(path, IMAGE) as file, pillow_image(file, path) as image:
        return image.size
