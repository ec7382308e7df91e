"""What is kept comes back or is not there; never half of it, and never too much."""

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from factorgraph_loc.vision import feature_cache
from factorgraph_loc.vision.feature_cache import FeatureCache, cache_folder, decode, encode
from factorgraph_loc.vision.keypoints import Keypoints


@pytest.fixture
def cache(tmp_path):
    return FeatureCache(tmp_path)


def file_of(tmp_path, key):
    (path,) = (path for path in tmp_path.rglob(key) if path.is_file())
    return path


def test_what_is_kept_comes_back(cache, tmp_path):
    assert cache.read("key") is None
    cache.write("key", b"content")
    cache.write("empty", b"")
    assert cache.read("key") == b"content"
    assert FeatureCache(tmp_path).read("empty") == b""


@pytest.mark.parametrize("damage", ["shorter", "longer", "flipped", "emptied", "other file"])
def test_a_damaged_file_is_as_if_it_were_not_there(cache, tmp_path, damage):
    cache.write("key", b"content" * 100)
    path = file_of(tmp_path, "key")
    stored = path.read_bytes()
    flipped = bytes([*stored[:50], stored[50] ^ 1, *stored[51:]])
    path.write_bytes(
        {"shorter": stored[:-1], "longer": stored + b"x", "flipped": flipped, "emptied": b"", "other file": b"x" * 99}[
            damage
        ]
    )
    assert cache.read("key") is None
    cache.write("key", b"new")
    assert cache.read("key") == b"new"


def test_a_folder_that_cannot_be_written_keeps_nothing(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    cache = FeatureCache(tmp_path / "file")
    cache.write("key", b"content")
    assert cache.read("key") is None
    cache.trim()


def test_what_was_not_used_for_longest_goes_first(tmp_path, monkeypatch):
    monkeypatch.setattr(feature_cache, "LIMIT", 3100)
    cache = FeatureCache(tmp_path)
    keys = ["a1", "a2", "b1", "b2", "c1"]
    for i, key in enumerate(keys):
        cache.write(key, bytes(1000))
        os.utime(file_of(tmp_path, key), (i, i))
    assert cache.read("a1") is not None  # used now
    cache.trim()
    assert [key for key in keys if cache.read(key)] == ["a1", "b2", "c1"]


def test_two_that_write_the_same_leave_it_whole(tmp_path):
    content = bytes(range(256)) * 1000

    def write_and_read(_):
        cache = FeatureCache(tmp_path)
        cache.write("key", content)
        return cache.read("key")

    with ThreadPoolExecutor(8) as pool:
        assert all(found == content for found in pool.map(write_and_read, range(64)))
    assert len([path for path in tmp_path.rglob("*") if path.is_file()]) == 1  # no temporary file is left


def test_the_environment_names_the_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("FGLOC_CACHE", str(tmp_path))
    assert cache_folder() == tmp_path
    monkeypatch.delenv("FGLOC_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_folder().name == "factorgraph-loc"


KINDS = [np.uint8, np.float32]


@given(st.integers(0, 20), st.integers(1, 40), st.sampled_from(KINDS), st.booleans(), st.integers(0, 2**31))
def test_features_come_back(count, columns, kind, whole, seed):
    rng = np.random.default_rng(seed)
    values = rng.uniform(0.0, 255.0, (count, columns))
    descriptors = (np.rint(values) if whole else values).astype(kind)
    points, nothing = rng.uniform(0.0, 4000.0, (count, 2)), np.zeros(count)
    found = decode(encode(Keypoints(points, nothing, nothing, nothing), descriptors))
    assert found.descriptors.dtype == kind
    np.testing.assert_array_equal(found.descriptors, descriptors)
    np.testing.assert_allclose(found.pixels, points, atol=2.5e-4)


@given(hnp.arrays(np.uint8, st.integers(0, 60)))
def test_other_bytes_are_no_features(content):
    with pytest.raises(ValueError, match="no features"):
        decode(content.tobytes() + b"\x01")
