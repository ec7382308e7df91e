"""What a run does with images: features before the loop, timed apart; and what it does without them."""

from dataclasses import replace

import numpy as np
import pytest
from picture import SMALL, moved_over

from factorgraph_loc import ImageStream, InputError, PointMap, SightingStream, compare
from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.sensors.camera import frontend
from factorgraph_loc.sensors.camera.settings import FrontendSettings
from factorgraph_loc.sensors.camera.use import frontend_of

CAMERA = SMALL.model_copy(update={"frontend": FrontendSettings(feature="orb", count=30)})


@pytest.fixture(autouse=True)
def _cache(tmp_path, monkeypatch):
    monkeypatch.setenv("FGLOC_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def seeing(log, tmp_path):
    """The short log with a camera and eight images, the first of them 0.1 s after its begin."""
    files = moved_over(tmp_path, 8)
    rig = log.rig.model_copy(update={"camera": CAMERA, "sensors": ("odometry", "camera")})
    return replace(log, rig=rig, streams=dict(log.streams) | {"camera": ImageStream(0.1 + 0.2 * np.arange(8), files)})


@pytest.fixture
def sees(fake, monkeypatch):
    """The estimator of the tests as one that takes pixels."""
    monkeypatch.setattr(fake, "modalities", frozenset({"camera"}), raising=False)
    return fake


def frames_fed(fake):
    return [t for kind, t in fake.made.calls if kind == "CameraFrame"]


def test_features_are_found_before_the_loop_and_timed_apart(seeing, sees):
    shares = []
    result = run(seeing, RunConfig("fake"), shares.append)
    assert frames_fed(sees) == pytest.approx(0.1 + 0.2 * np.arange(8))
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0.0, 1.0)
    assert result.timings.images == 8
    assert result.timings.frontend_seconds > 0.0
    scores = score(result, seeing)
    assert scores["timing.images"] == 8
    assert scores["timing.frontend_seconds"] == result.timings.frontend_seconds


def test_what_is_wrong_with_images_is_a_warning_of_the_run(seeing, sees):
    seeing.streams["camera"].file[3].write_bytes(b"no image")
    result = run(seeing, RunConfig("fake"))
    assert ("unreadable_images", 1) in [(w.kind, w.fields.get("faults")) for w in result.warnings]
    assert len(frames_fed(sees)) == 8


def test_an_estimator_that_takes_no_pixels_waits_for_no_features(seeing, fake, monkeypatch):
    monkeypatch.setattr(frontend, "with_features", lambda *_: pytest.fail("features were looked for"))
    result = run(seeing, RunConfig("fake"))
    assert result.timings.images == 0
    assert len(frames_fed(fake)) == 8
    assert "straight: fake does not use images: all 8 are ignored" in map(str, result.warnings)


def test_a_rig_without_camera_leaves_images_out_unless_they_are_asked_for(seeing, sees):
    rig = seeing.rig.model_copy(update={"camera": None, "sensors": ("odometry", "camera", "sightings")})
    pixels = SightingStream(np.array([0.3]), ["door"], np.array([1.0]), np.array([2.0]))
    log = replace(seeing, rig=rig, streams=dict(seeing.streams) | {"sightings": pixels})
    result = run(log, RunConfig("fake"))
    assert sees.made.setup.sensors == ("odometry",)
    assert "straight: camera, sightings not used, because the rig rig has no [camera]" in map(str, result.warnings)
    for sensor in ("camera", "sightings"):
        with pytest.raises(InputError, match=f"straight: {sensor} needs \\[camera\\] in the rig, and rig has none"):
            run(log, RunConfig("fake", sensors=("odometry", sensor)))


def test_the_feature_is_that_of_the_map(seeing):
    assert frontend_of(seeing.rig, seeing.world) == FrontendSettings(feature="orb", count=30, everywhere=True)
    nothing = np.zeros((1, 3))
    points = PointMap(("a",), nothing, np.zeros((1, 3, 3)), "sift", np.array([0]), np.zeros((1, 128)), nothing)
    world = seeing.world.model_copy(update={"points": points})
    assert frontend_of(seeing.rig, world) == FrontendSettings(feature="sift", count=30)
    named = seeing.world.model_copy(update={"points": PointMap.of(["a"], nothing)})
    assert frontend_of(seeing.rig, named) == FrontendSettings(feature="orb", count=30, everywhere=True)


@pytest.mark.usefixtures("runs_here", "blank_pictures")
def test_a_comparison_finds_features_once(seeing, sees, tmp_path, monkeypatch):
    found = []
    find = frontend._find

    def noted(file, *rest):
        found.append(file.name)
        return find(file, *rest)

    monkeypatch.setattr(frontend, "_find", noted)
    monkeypatch.setattr(sees, "deterministic", False)
    rows = compare([seeing], ["fake"], tmp_path / "out", seeds=range(3)).rows
    assert [row["timing.images"] for row in rows] == [8, 8, 8]
    assert sorted(found) == [f"{k}.png" for k in range(8)]
