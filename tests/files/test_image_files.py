import os
import struct
import zlib
from contextlib import nullcontext, suppress

import cv2
import numpy as np
import pytest

from factorgraph_loc.errors import InputError
from factorgraph_loc.vision import images
from factorgraph_loc.vision.images import as_image, read_image


def png(width: int, height: int) -> bytes:
    """The head of a PNG of that size, and nothing else."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def jpeg(width: int, height: int) -> bytes:
    small = bytes(cv2.imencode(".jpg", np.zeros((16, 16, 3), dtype=np.uint8))[1])
    at = small.index(b"\xff\xc0") + 5
    return small[:at] + struct.pack(">HH", height, width) + small[at + 4 :]


IMAGES = {
    "a.png": png(60_000, 60_000),
    "e.png": png(10_000, 10_000),
    "b.jpg": jpeg(60_000, 60_000),
    "c.pgm": b"P5 60000 60000 255\n" + bytes(100),
    "d.bmp": b"BM"
    + struct.pack("<IHHIIiiHHIIiiII", 154, 0, 0, 54, 40, 60_000, 60_000, 1, 24, 0, 0, 0, 0, 0, 0)
    + bytes(100),
}


@pytest.mark.parametrize("name", IMAGES)
def test_the_size_in_a_head_is_checked_before_memory_is_taken(tmp_path, name):
    (tmp_path / name).write_bytes(IMAGES[name])
    with pytest.raises(InputError, match=rf"{name}: has too many pixels, expected at most 67,108,864"):
        read_image(tmp_path / name)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".ppm", ".bmp", ".tiff", ".webp"])
def test_the_formats_of_cameras_are_read(tmp_path, suffix):
    image = np.random.default_rng(1).integers(0, 255, (24, 40, 3)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / f"a{suffix}"), image)
    assert read_image(tmp_path / f"a{suffix}").shape == (24, 40, 3)


def test_a_part_of_a_png_that_is_longer_than_the_file_takes_no_memory(tmp_path):
    whole = bytes(cv2.imencode(".png", np.zeros((24, 40, 3), dtype=np.uint8))[1])
    at = whole.index(b"IDAT")
    (tmp_path / "a.png").write_bytes(whole[: at - 4] + struct.pack(">I", 2**30) + whole[at:])
    with pytest.raises(InputError, match=r"a.png: is not an image that can be decoded"):
        read_image(tmp_path / "a.png")


def test_sixteen_bits_become_eight():
    values = np.arange(2**16, dtype=np.uint16).reshape(256, 256)
    np.testing.assert_array_equal(as_image(values), np.round(values / 257.0).astype(np.uint8))


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_what_libraries_write_of_damaged_images_stays_unseen(suffix, capfd, monkeypatch):
    pixels = np.random.default_rng(0).integers(0, 255, (40, 60), dtype=np.uint8)
    damaged = bytearray(cv2.imencode(suffix, pixels)[1].tobytes())
    damaged[len(damaged) // 2 : len(damaged) // 2 + 40] = bytes(40)

    def written():
        with suppress(InputError):  # JPEG images decode as far as they can
            images.decoded(bytes(damaged), "a", cv2.IMREAD_UNCHANGED)
        return capfd.readouterr().err

    assert written() == ""
    os.write(2, b"seen")
    assert capfd.readouterr().err == "seen"
    monkeypatch.setattr(images, "quiet", nullcontext)
    assert written() != ""
