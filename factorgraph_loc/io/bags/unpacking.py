"""Limits on the decompression of bags in ``rosbags``, because a few bytes may expand to gigabytes.

A bag is compressed by chunks (``.bag``, ``.mcap``), by messages, or as a whole file that is unpacked to disk (version 2).
"""

from __future__ import annotations

import bz2
import shutil
import tempfile
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO

SMALL, LARGE = 2**24, 2**27  # bytes of a chunk that are always unpacked, and the maximum
FILE = 2**30  # bytes of a file that are always unpacked, if the disk has room
CHUNK_RATIO, FILE_RATIO = 1000, 50  # maximum compression ratios beyond that
STEP = 2**22


@cache
def bound() -> None:
    """Replace the decompression functions in all readers of ``rosbags`` by those below."""
    import lz4.frame  # type: ignore[import-untyped] # noqa: PLC0415 - optional libraries
    from rosbags.rosbag1 import reader as reader1  # noqa: PLC0415
    from rosbags.rosbag2 import reader as reader2  # noqa: PLC0415
    from rosbags.rosbag2 import storage_mcap  # noqa: PLC0415

    zstd = vars(reader2)["zstd"]
    of_bz2 = partial(unpacked, bz2.BZ2Decompressor)
    of_lz4 = partial(unpacked, lz4.frame.LZ4FrameDecompressor)
    of_zstd = partial(unpacked, zstd.ZstdDecompressor)
    reader1.decompressors.update(bz2=of_bz2, lz4=of_lz4)
    storage_mcap.DECOMPRESSORS.update(lz4=lambda data, _: of_lz4(data), zstd=lambda data, _: of_zstd(data))
    vars(reader2)["zstd"] = SimpleNamespace(open=lambda file, _: _File(zstd.open(file, "rb"), file), decompress=of_zstd)


def unpacked(make: Callable[[], Any], data: bytes) -> bytes:
    """Decompress ``data`` frame by frame with decompressors from ``make``; ValueError if it is too large or truncated."""
    limit = max(SMALL, min(LARGE, CHUNK_RATIO * len(data)))
    parts: list[bytes] = []
    count = 0
    while data:
        one = make()
        while not one.eof:
            part = one.decompress(data, max_length=STEP)
            data = b""
            parts.append(part)
            count += len(part)
            if count > limit:
                raise ValueError(f"a chunk or message unpacks to more than {limit:,} bytes, which is too much")
            if not part and one.needs_input:
                raise ValueError("a chunk or message is cut off")
        data = one.unused_data or b""
    return b"".join(parts)


class _File:
    """A compressed file for reading, which raises ValueError beyond its limit. ``content``: decompresses ``file``."""

    def __init__(self, content: BinaryIO, file: BinaryIO) -> None:
        self._content = content
        room = shutil.disk_usage(tempfile.gettempdir()).free // 2
        self._limit = min(max(FILE, FILE_RATIO * Path(file.name).stat().st_size), room)
        self._count = 0

    def __enter__(self) -> _File:
        return self

    def __exit__(self, *_: object) -> None:
        self._content.close()

    def read(self, size: int) -> bytes:
        part = self._content.read(size)
        self._count += len(part)
        if self._count > self._limit:
            raise ValueError(f"its file unpacks to more than {self._limit:,} bytes, which is too much")
        return part
