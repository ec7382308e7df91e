"""Reading of image headers, such as the size, without decoding the image."""

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO

from PIL import Image, UnidentifiedImageError

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.bounded import PIXELS, foreign

# further formats are not read, because Pillow would start other programs for some of them
FORMATS = ("PNG", "JPEG", "PPM", "BMP", "TIFF", "WEBP", "GIF", "TGA", "SUN", "JPEG2000")
PNG = b"\x89PNG\r\n\x1a\n"
NO_IMAGE = "is not an image that can be decoded"
TOO_LARGE = f"has too many pixels, expected at most {PIXELS:,}"


@contextmanager
def pillow_image(file: BinaryIO, source: object) -> Iterator[Image.Image]:
    """Open an image with Pillow in this block, and yield it. The pixels are decoded when they are first used.

    Raises InputError with ``source`` if the image is invalid, has more than :data:`~bounded.PIXELS` pixels, or cannot
    be decoded.
    """
    with foreign(source, NO_IMAGE), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow's warnings about large sizes and damaged metadata
        try:
            image = Image.open(file, formats=FORMATS)
        except UnidentifiedImageError as error:  # its text is useless: it describes a Python object
            raise InputError(f"{source}: {NO_IMAGE}, expected PNG, JPEG, PPM or the like") from error
        except Image.DecompressionBombError as error:  # the image exceeds Pillow's own limit, which is higher
            raise InputError(f"{source}: {TOO_LARGE}") from error
        with image:
            if image.width * image.height > PIXELS:
                raise InputError(f"{source}: {TOO_LARGE}")
            yield image


def image_size(content: bytes, source: object) -> tuple[int, int]:
    """Return the width and height [px] of an image from its header. ``content``: bytes of the file ``source``.

    Raises InputError if the image is invalid or has too many pixels. Raises InputError also if a PNG has a chunk that
    claims to be longer than the file. OpenCV would allocate memory for this length.
    """
    at = len(PNG) if content.startswith(PNG) else len(content)
    while at + 8 <= len(content):
        at += 12 + int.from_bytes(content[at : at + 4], "big")
        if at > len(content):
            raise InputError(f"{source}: {NO_IMAGE}: it is cut off, or a part of it is damaged")
    with pillow_image(io.BytesIO(content), source) as image:
        return image.size
