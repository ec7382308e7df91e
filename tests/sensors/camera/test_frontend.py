"""From images to features: what is found, kept, computed again, and what bad images do."""

import ast
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from picture import SMALL

from factorgraph_loc import FeatureStream, ImageStream, InputError, Log, Rig, World
from factorgraph_loc.sensors.camera import frontend
from factorgraph_loc.sensors.camera.frontend import with_features
from factorgraph_loc.sensors.camera.settings import FrontendSettings
from factorgraph_loc.vision import feature_cache
from factorgraph_loc.vision.features import EXTRACTORS, extractor

ORB = FrontendSettings(feature="orb", count=100)
SOURCE = Path(frontend.__file__).parents[2] / "vision"


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """An empty cache."""
    monkeypatch.setenv("FGLOC_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def computed(monkeypatch):
    """The names of the files whose features are computed, as they are."""
    names = []
    find = frontend._find

    def noted(file, *rest):
        names.append(file.name)
        return find(file, *rest)

    monkeypatch.setattr(frontend, "_find", noted)
    return names


@pytest.fixture
def log(tmp_path, picture):
    """A camera that moves over a picture by 4 px from image to image, of which there are ten."""
    files = [tmp_path / f"{k}.png" for k in range(10)]
    for k, file in enumerate(files):
        cv2.imwrite(str(file), picture[20:140, 4 * k : 4 * k + 160])
    return log_of(files)


def log_of(files, t=None):
    camera = SMALL.model_copy(update={"time_offset": 0.5})
    stamps = 0.2 * np.arange(len(files)) if t is None else t
    return Log("pictures", Rig(camera=camera), World(), {"camera": ImageStream(stamps, files)})


def frames(log, settings=ORB):
    found, warnings = with_features(log, settings)
    stream = found.streams["camera"]
    assert isinstance(stream, FeatureStream)
    np.testing.assert_array_equal(stream.t, log.streams["camera"].t)
    return stream.frame, warnings


def same(a, b):
    return all(np.array_equal(getattr(a, n), getattr(b, n)) for n in ("pixels", "descriptors", "tracks"))


@pytest.mark.parametrize("feature", list(EXTRACTORS))
def test_what_is_found_is_what_the_extractor_finds(log, feature):
    found, warnings = frames(log, FrontendSettings(feature=feature, count=50))
    assert warnings == ()
    keypoints, descriptors = extractor(feature, 50).detectAndCompute(cv2.imread(str(log.streams["camera"].file[3])))
    assert len(keypoints) > 20
    np.testing.assert_allclose(found[3].pixels, keypoints.points, atol=1e-4)
    np.testing.assert_array_equal(found[3].descriptors, descriptors)
    assert found[3].descriptors.dtype == descriptors.dtype
    assert {frame.feature for frame in found} == {feature}


def test_tracks_follow_the_picture(log):
    found, _ = frames(log)
    steps = []
    for a, b in pairwise(found):
        _, i, j = np.intersect1d(a.tracks, b.tracks, return_indices=True)
        assert len(i) > 20
        steps.append(b.pixels[j] - a.pixels[i])
    moved = np.concatenate(steps) - (-4.0, 0.0)
    assert np.quantile(np.hypot(*moved.T), 0.9) < 1.0


def test_measurements_have_the_corrected_stamp(log):
    found, _ = with_features(log, ORB)
    assert [m.t for m in found.measurements(("camera",))][:2] == pytest.approx([0.5, 0.7])


def test_the_second_time_nothing_is_computed_nor_of_another_log_with_the_same_images(log, computed, tmp_path):
    first, _ = frames(log)
    assert len(computed) == 10
    computed.clear()
    second, _ = frames(log)
    assert all(same(a, b) for a, b in zip(first, second, strict=True))
    copies = [tmp_path / f"copy{k}.png" for k in range(3)]
    for copy, file in zip(copies, log.streams["camera"].file, strict=False):
        copy.write_bytes(file.read_bytes())
    frames(log_of(copies))
    assert computed == []


def test_other_settings_other_images_and_other_code_compute_again(log, computed, monkeypatch):
    frames(log)
    computed.clear()
    frames(log, FrontendSettings(feature="orb", count=101))
    assert len(computed) == 10
    computed.clear()
    file = log.streams["camera"].file[4]
    cv2.imwrite(str(file), cv2.imread(str(file))[::-1])
    frames(log)
    assert computed == ["4.png"]
    computed.clear()
    monkeypatch.setattr(frontend, "code_version", lambda _: "changed")
    frames(log)
    assert len(computed) == 10


def test_a_damaged_cache_is_computed_again(log, computed, cache):
    first, _ = frames(log)
    for path in cache.rglob("*"):
        if path.is_file():
            path.write_bytes(path.read_bytes()[:-3])
    computed.clear()
    second, _ = frames(log)
    assert len(computed) == 10
    assert all(same(a, b) for a, b in zip(first, second, strict=True))


def test_without_a_cache_it_works_as_well(log, tmp_path, monkeypatch):
    first, _ = frames(log)
    (tmp_path / "file").write_bytes(b"")
    monkeypatch.setenv("FGLOC_CACHE", str(tmp_path / "file"))
    second, (warning,) = frames(log)
    assert all(same(a, b) for a, b in zip(first, second, strict=True))
    assert (
        str(warning) == f"features are not cached, {tmp_path / 'file' / 'features'}: cannot be written: Not a directory"
    )


def test_the_cache_does_not_grow_without_end(log, cache, monkeypatch):
    frames(log)
    kept = {path for path in cache.rglob("*") if path.is_file()}
    size = sum(path.stat().st_size for path in kept)
    monkeypatch.setattr(feature_cache, "LIMIT", size)
    frames(log, FrontendSettings(feature="orb", count=90))
    assert any(not path.exists() for path in kept)
    assert sum(path.stat().st_size for path in cache.rglob("*") if path.is_file()) < 1.1 * size


def test_threads_find_the_same(log, monkeypatch):
    first, _ = frames(log)
    monkeypatch.setenv("FGLOC_CACHE", str(log.streams["camera"].file[0].parent / "other"))
    monkeypatch.setattr(frontend.os, "cpu_count", lambda: 4)
    shares = []
    found, _ = with_features(log, ORB, shares.append)
    assert all(same(a, b) for a, b in zip(first, found.streams["camera"].frame, strict=True))
    assert shares == pytest.approx(np.arange(11) / 10)


def test_a_log_without_images_stays_as_it_is(log):
    without = replace(log, streams={})
    assert with_features(without, ORB) == (without, ())
    found, _ = with_features(log, ORB)
    assert with_features(found, ORB)[0] is found
    assert frames(log_of([])) == ([], ())


def test_a_rig_without_camera(log):
    with pytest.raises(InputError, match=r"pictures: has images, but its rig rig has no section \[camera\]"):
        with_features(replace(log, rig=Rig()), ORB)


def test_bad_images_are_frames_without_features(log):
    files = log.streams["camera"].file
    good, _ = frames(log)
    files[2].unlink()
    files[4].write_bytes(files[4].read_bytes()[:2000])
    files[5].write_bytes(b"no image")
    cv2.imwrite(str(files[7]), cv2.imread(str(files[7]))[:-10])
    found, warnings = frames(log)
    assert [len(f.pixels) == 0 for f in found] == [k in (2, 4, 5, 7) for k in range(10)]
    assert {f.descriptors.shape[1] for f in found} == {32}
    assert all(np.array_equal(found[k].pixels, good[k].pixels) for k in (0, 1, 3, 6, 8, 9))
    unread, other = map(str, warnings)
    assert unread.startswith("pictures: 3 of 10 images cannot be read and are without features, the first is ")
    assert "2.png: cannot be read: No such file" in unread
    assert other.startswith("pictures: 1 of 10 images have another size")
    assert other.endswith("7.png: has 160 x 110 px, expected 160 x 120")
    _, i, _ = np.intersect1d(found[1].tracks, found[3].tracks, return_indices=True)
    assert len(i) > 10  # bridged


def test_a_hundred_black_images(log, tmp_path, computed):
    black = tmp_path / "black.png"
    cv2.imwrite(str(black), np.zeros((120, 160, 3), dtype=np.uint8))
    files = log.streams["camera"].file
    found, (warning,) = frames(log_of([*files[:5], *[black] * 100, *files[5:]]))
    assert [len(f.pixels) > 0 for f in found] == [True] * 5 + [False] * 100 + [True] * 5
    assert computed.count("black.png") == 1
    assert str(warning) == "pictures: 100 of 110 images show no features"
    assert not np.intersect1d(found[4].tracks, found[105].tracks).size


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_a_calibration_of_another_resolution_is_an_error(log, scale):
    for file in log.streams["camera"].file:
        cv2.imwrite(str(file), cv2.resize(cv2.imread(str(file)), None, fx=scale, fy=scale))
    size = f"{round(160 * scale)} x {round(120 * scale)}"
    with pytest.raises(
        InputError, match=f"calibrated for images of 160 x 120 px, but the images of the log have {size} px"
    ):
        with_features(log, ORB)


def test_late_images_are_followed_in_the_order_of_their_stamps(log):
    files, t = log.streams["camera"].file, log.streams["camera"].t
    swapped = [0, 1, 4, 2, 3, 5, 6, 7, 9, 8]
    found, _ = frames(log_of([files[i] for i in swapped], t[swapped]))
    good, _ = frames(log)
    for k, frame in zip(swapped, found, strict=True):
        assert same(frame, good[k])


def test_grey_and_16_bit_images(log, tmp_path):
    grey = cv2.imread(str(log.streams["camera"].file[0]), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(tmp_path / "grey.png"), grey)
    cv2.imwrite(str(tmp_path / "deep.png"), grey.astype(np.uint16) * 257)
    found, _ = frames(log_of([tmp_path / "grey.png", tmp_path / "deep.png"]))
    np.testing.assert_array_equal(found[0].descriptors, found[1].descriptors)


def test_the_version_is_of_all_code_that_features_come_from():
    """What the extractors import, directly or not, and what encodes them, must be in the hash that names them in the cache."""
    prefix = "factorgraph_loc.vision."
    seen, open_ = set(), {"features", "feature_cache", "images"}
    while open_:
        name = open_.pop()
        seen.add(name)
        for node in ast.walk(ast.parse((SOURCE / f"{name}.py").read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module.removeprefix(prefix)] if node.module.startswith(prefix) else []
                names += [a.name for a in node.names] if node.module == prefix.rstrip(".") else []
                open_ |= set(names) - seen
    assert {f"{name}.py" for name in seen} | {"weights.npz"} == set(frontend.FEATURE_CODE)
    assert frontend.code_version(frontend.FEATURE_CODE) != frontend.code_version(frontend.TRACK_CODE)
