"""What ``inspect`` says about images and identified pixels."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from picture import SMALL, moved_over

from factorgraph_loc import ImageStream, Log, PointMap, Rig, SightingStream, Trajectory, VelocityStream, World
from factorgraph_loc.evaluation.inspect import inspect
from factorgraph_loc.sensors.camera.settings import FrontendSettings
from factorgraph_loc.sensors.camera.summary import mounting_problems

CAMERA = SMALL.model_copy(update={"frontend": FrontendSettings(feature="orb", count=30)})


@pytest.fixture
def log(tmp_path):
    """Fifty images, and two points that are seen twice."""
    files = moved_over(tmp_path, 50)
    t = np.arange(50) * 0.2
    seen = np.repeat((1.0, 2.0), 2)
    pixels = SightingStream(
        seen, ["door", "lamp"] * 2, np.array((1.0, 40.0, 2.0, 41.0)), np.array((5.0, 6.0, 5.0, 6.0))
    )
    return Log(
        "room",
        Rig(camera=CAMERA, sensors=("odometry", "camera", "sightings")),
        World(points=PointMap.of(("door", "lamp"), np.zeros((2, 3)))),
        {"odometry": VelocityStream(t, t, t), "camera": ImageStream(t, files), "sightings": pixels},
    )


def test_counts(log):
    found = inspect(log)
    assert found.problems == ()
    images, pixels = found.found["images"], found.found["pixels"]
    assert (images.images, images.looked_at, images.readable) == (50, 40, 40)
    assert images.sizes == {"160x120": 40}
    assert images.feature == "orb"
    assert 10 <= images.features <= 30
    assert (pixels.rows, pixels.frames, pixels.known, pixels.unknown) == (4, 2, 2, {})
    assert found.streams["camera"].rate == pytest.approx(5.0)


def test_sizes(log):
    files = log.streams["camera"].file
    for file in files[:25]:
        cv2.imwrite(str(file), cv2.resize(cv2.imread(str(file)), (320, 240)))
    (problem,) = inspect(log).problems
    assert str(problem) == "images have several sizes: 320x240, 160x120"
    doubled = replace(
        log, streams=dict(log.streams) | {"camera": ImageStream(log.streams["camera"].t[:25], files[:25])}
    )
    assert tuple(map(str, inspect(doubled).problems)) == (
        "the camera is calibrated for images of 160x120 px, but the images of the log have 320x240 px",
    )


def test_a_rig_without_camera(log):
    problems = inspect(replace(log, rig=log.rig.model_copy(update={"camera": None}))).problems
    assert tuple(map(str, problems)) == (
        "the log has images, which are not used, because its rig has no [camera]",
        "the log has named points, which are not used, because its rig has no [camera]",
    )


def test_points_that_the_map_lacks_and_pixels_outside(log):
    s = log.streams["sightings"]
    pixels = SightingStream(s.t, ["door", "chair"] * 2, s.u + np.array((0.0, 0.0, 0.0, 200.0)), s.v)
    found = inspect(replace(log, streams=dict(log.streams) | {"sightings": pixels}))
    assert tuple(map(str, found.problems)) == (
        "2 sightings are of 1 points that the map lacks: chair",
        "1 of 4 sightings lie outside of the camera's image",
    )


def turning(tmp_path, pitch, way):
    """A robot that turns on the spot; its images turn ``way`` times as much as it does, about their centre."""
    texture = np.random.default_rng(2).integers(0, 256, (400, 400), dtype=np.uint8)
    texture = cv2.GaussianBlur(texture, (0, 0), 2.5)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
    t = np.arange(12) * 0.2
    headings = 0.2 * np.arange(12)
    files = [tmp_path / f"turning-{k}.png" for k in range(12)]
    for file, heading in zip(files, headings, strict=True):
        # the floor turns clockwise as the robot turns to the left
        turned = cv2.getRotationMatrix2D((199.5, 199.5), -np.degrees(way * heading), 1.0)
        cv2.imwrite(str(file), cv2.warpAffine(texture, turned, (400, 400))[140:260, 120:280])
    camera = CAMERA.model_copy(update={"pitch": pitch})
    return Log(
        "floor",
        Rig(camera=camera, sensors=("odometry", "camera")),
        World(),
        {"odometry": VelocityStream(t, 0 * t, np.ones(12)), "camera": ImageStream(t, files)},
        reference=Trajectory(t, np.column_stack((0 * t, 0 * t, headings))),
    )


@pytest.mark.parametrize(("pitch", "way"), [(np.pi / 2, 1.0), (0.0, 0.0), (-np.pi / 2, -1.0), (0.3, 0.3)])
def test_a_camera_that_looks_where_its_rig_says(tmp_path, pitch, way):
    assert mounting_problems(turning(tmp_path, pitch, way)) == []


def test_a_camera_that_looks_at_the_floor_though_its_rig_says_ahead(tmp_path):
    (problem,) = mounting_problems(turning(tmp_path, 0.0, 1.0))
    assert re.fullmatch(
        r"images rotate (1\.00|0\.9\d) times as much as the robot, as if the camera points at the floor; by the "
        r"mounting the ratio is -?0\.00: is camera\.pitch about 1\.[3-6], not 0\.0\?",
        str(problem),
    )
    (problem,) = mounting_problems(turning(tmp_path, np.pi / 2, 0.0))
    assert "as if the camera points ahead; by the mounting the ratio is 1.00" in str(problem)
    (problem,) = mounting_problems(turning(tmp_path, np.pi / 2, -1.0))
    assert problem.fields["where"] == "at the ceiling"
