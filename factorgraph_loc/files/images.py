"""Image headers, read without decoding the image."""

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO

from PIL import Image, UnidentifiedImageError

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.bounded import PIXELS, foreign

# without the formats for which Pillow starts other programs
FORMATS = ("PNG", "JPEG", "PPM", "BMP", "TIFF", "WEBP", "GIF", "TGA", "SUN", "JPEG2000")
PNG = b"\x89PNG\r\n\x1a\n"
NO_IMAGE = "is not an image that can be decoded"
TOO_LARGE = f"has too many pixels, expected at most {PIXELS:,}"


@contextmanager
def pillow_image(file: BinaryIO, source: object) -> Iterator[Image.Image]:
    """Open an image with Pillow without decoding it; InputError if it is invalid, has more than :data:`~bounded.PIXELS` pixels or
    cannot be decoded when it is used."""
    with foreign(source, NO_IMAGE), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow's warnings about large sizes and damaged metadata
        try:
            image = Image.open(file, formats=FORMATS)
        except UnidentifiedImageError as error:  # whose text describes an object in memory
            raise InputError(f"{source}: {NO_IMAGE}, expected PNG, JPEG, PPM or the like") from error
        except Image.DecompressionBombError as error:  # Pillow's own limit, which is higher
            raise InputError(f"{source}: {TOO_LARGE}") from error
        with image:
            if image.width * image.height > PIXELS:
                raise InputError(f"{source}: {TOO_LARGE}")
            yield image


def image_size(content: bytes, source: object) -> tuple[int, int]:
    """Width and height [px] from the header; InputError as in :func:`pillow_image`.

    A PNG with a chunk longer than the file raises InputError too: OpenCV would allocate memory for the declared length.
    """
    at = len(PNG) if content.startswith(PNG) else len(content)
    while at + 8 <= len(content):
        at += 12 + int.from_bytes(content[at : at + 4], "big")
        if at > len(content):
            raise InputError(f"{source}: {NO_IMAGE}: it is cut off, or a part of it is damaged")
    with pillow_image(io.BytesIO(content), source) as image:
        return image.size
