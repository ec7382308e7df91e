"""Compressed bags of all kinds are read as others are, but unpack to no more than a limit."""

import bz2
import importlib
import sys
import tempfile
import tracemalloc

import lz4.frame
import numpy as np
import pytest
from rosbags import rosbag1, rosbag2

from factorgraph_loc.io.bags import file
from factorgraph_loc.io.bags.file import unpacked

zstd = importlib.import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")
T0 = 1_700_000_000_000_000_000
MODE, ZSTD, ROS1 = rosbag2.CompressionMode, rosbag2.CompressionFormat.ZSTD, rosbag1.Writer.CompressionFormat
KINDS = {
    "bz2": ("drive.bag", "", (ROS1.BZ2,)),
    "lz4": ("drive.bag", "", (ROS1.LZ4,)),
    "chunks of mcap": ("drive", "mcap", (MODE.STORAGE, ZSTD)),
    "messages of mcap": ("drive", "mcap", (MODE.MESSAGE, ZSTD)),
    "messages of sqlite3": ("drive", "sqlite3", (MODE.MESSAGE, ZSTD)),
    "file of mcap": ("drive", "mcap", (MODE.FILE, ZSTD)),
    "file of sqlite3": ("drive", "sqlite3", (MODE.FILE, ZSTD)),
}
OPTIONS = {"odometry": {"topic": "/odom"}}


@pytest.fixture(params=KINDS.values(), ids=list(KINDS))
def bag(request, tmp_path, bag_maker):
    name, storage, compression = request.param
    with bag_maker(tmp_path / name, storage, compression) as made:
        for i in range(50):
            made.odometry("/odom", T0 + 100_000_000 * i, (0.1 * i, 0.0, 0.0))
    return tmp_path / name


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where files are unpacked to."""
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    return tmp_path / "tmp"


def test_what_is_read(bag, one, folder):
    moved = one(bag, reader="rosbag", options=OPTIONS).streams["odometry"]
    np.testing.assert_allclose(moved.dx, [0.0] + [0.1] * 49, atol=1e-12)
    assert not list(folder.iterdir())


def test_a_bag_that_unpacks_to_too_much(bag, refused, folder, monkeypatch):
    for name in ("SMALL", "CHUNK_RATIO", "FILE", "FILE_RATIO"):
        monkeypatch.setattr(file, name, 1)
    for name in ("LARGE", "STEP"):
        monkeypatch.setattr(file, name, 100)
    refused(bag, str(bag), "unpacks to more than", "bytes, which is too much", reader="rosbag", options=OPTIONS)
    assert not list(folder.iterdir())


@pytest.mark.parametrize("bag", [KINDS["file of mcap"], KINDS["file of sqlite3"]], indirect=True)
def test_half_of_a_disk_is_left(bag, refused, folder, monkeypatch):
    monkeypatch.setattr(file.shutil, "disk_usage", lambda _: type("Usage", (), {"free": 200}))
    refused(bag, "its file unpacks to more than 100 bytes", reader="rosbag", options=OPTIONS)
    assert not list(folder.iterdir())


COMPRESSED = {
    "bz2": (bz2.BZ2Decompressor, bz2.compress),
    "lz4": (lz4.frame.LZ4FrameDecompressor, lz4.frame.compress),
    "zstd": (zstd.ZstdDecompressor, zstd.compress),
}


@pytest.mark.parametrize(("make", "compress"), COMPRESSED.values(), ids=list(COMPRESSED))
def test_frames(make, compress, monkeypatch):
    monkeypatch.setattr(file, "STEP", 1000)
    one, other = np.random.default_rng(0).bytes(5000), bytes(7000)
    assert unpacked(make, compress(one) + compress(other)) == one + other
    with pytest.raises(ValueError, match="cut off"):
        unpacked(make, compress(one)[:-20])


@pytest.mark.parametrize(("make", "compress"), COMPRESSED.values(), ids=list(COMPRESSED))
def test_a_few_bytes_that_stand_for_very_many_take_no_memory(make, compress, monkeypatch):
    monkeypatch.setattr(file, "LARGE", file.SMALL)
    bomb = compress(bytes(2**26))
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match="unpacks to more than 16,777,216 bytes"):
            unpacked(make, bomb)
        assert tracemalloc.get_traced_memory()[1] < 2**25
    finally:
        tracemalloc.stop()
