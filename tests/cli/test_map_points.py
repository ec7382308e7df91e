"""`fgloc map` of points, from images to files and back to a run's map."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image

from factorgraph_loc.camera_settings import CameraSettings, FrontendSettings
from factorgraph_loc.log import ImageStream, IncrementStream, Log
from factorgraph_loc.readers import write_native
from factorgraph_loc.rig import Rig
from factorgraph_loc.trajectory import Trajectory
from factorgraph_loc.world import Landmark, World, read_world
from factors import se2
from factors.reprojection import camera_pose

WALL = 3.0  # m: the picture hangs on the plane x = 3, 4 m wide and 2.4 m high, 100 px a metre
CAMERA = CameraSettings(
    width=320, height=240, fx=260, fy=260, cx=160, cy=120, z=1.2, frontend=FrontendSettings(feature="sift", count=300)
)


@pytest.fixture(scope="session")
def gallery(tmp_path_factory):
    """A log of a robot that passes a picture at 2 m to 3 m, sideways, as it looks at it: ten images of it."""
    rng = np.random.default_rng(4)
    picture = cv2.GaussianBlur(rng.integers(0, 255, (240, 400, 3), dtype=np.uint8), (0, 0), 2.5)
    picture = cv2.normalize(picture, None, 0, 255, cv2.NORM_MINMAX)
    t = np.arange(10) * 0.5
    poses = np.column_stack((0.1 * np.sin(t), 0.15 * np.arange(10) - 0.7, 0.03 * np.cos(2.0 * t)))
    folder = tmp_path_factory.mktemp("images")
    model = CAMERA.model()
    # from the picture's pixels to the wall: u to the right is -y, v downwards is -z
    to_wall = np.array(((0.0, 0.0, WALL), (-0.01, 0.0, 2.0), (0.0, -0.01, 2.4)))
    files = []
    for i, pose in enumerate(poses):
        position, rotation = camera_pose(model, pose)
        local = rotation.T @ (to_wall - np.outer(position, (0.0, 0.0, 1.0)))
        image = cv2.warpPerspective(picture, model.matrix() @ local, (320, 240), borderValue=(90, 90, 90))
        files.append(folder / f"{i:03d}.png")
        cv2.imwrite(str(files[-1]), image)
    steps = se2.between(poses[:-1], poses[1:])
    odometry = IncrementStream(t, *np.vstack((np.zeros(3), steps)).T)
    world = World(landmarks={"door": Landmark(x=0.0, y=1.0)}, walls=((WALL, -2.0, WALL, 2.0),))
    streams = {"odometry": odometry, "camera": ImageStream(t, files)}
    rig = Rig(sensors=("odometry", "camera"), camera=CAMERA)
    return Log("gallery", rig, world, streams, Trajectory(t, poses))


@pytest.fixture
def on_disk(gallery, tmp_path, monkeypatch):
    """``on_disk(**changes)``: the path of the log with other fields."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    def write(**changes):
        folder = tmp_path / f"log{len(list(tmp_path.glob('log*')))}"
        write_native(replace(gallery, **changes), folder)
        return folder

    return write


@pytest.mark.parametrize("poses", ["reference", "odometry"])
def test_points_lie_on_the_wall(fgloc, on_disk, tmp_path, poses):
    out = tmp_path / "hall.world.toml"
    result = fgloc("map", on_disk(), "-o", out, "--poses", poses, "--json")
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    world = read_world(out)
    assert report["points"] == len(world.points) > 60
    assert report["rms"] < 1.0
    assert world.points.feature == "sift"
    assert set(world.landmarks) == {"door"}
    assert world.walls == ((WALL, -2.0, WALL, 2.0),)
    off = world.points.positions[:, 0] - WALL
    assert np.median(np.abs(off)) < 0.05
    sigma = np.sqrt(world.points.covariances[:, 0, 0])
    assert np.mean(np.abs(off) < 3.0 * sigma) > 0.9
    with Image.open(tmp_path / "hall.map.png") as picture:
        assert picture.width == 1600
    frame = "that of the reference" if poses == "reference" else "that of the start"
    assert report["frame"].startswith(frame)


def test_points_are_mapped_where_nothing_else_is_asked_for(fgloc, on_disk, tmp_path):
    result = fgloc("map", on_disk(), "-o", tmp_path / "a.world.toml")
    assert result.exit_code == 0, result.output
    assert "points are in the new map" in result.stdout
    assert "the frame of the new map is that of the reference" in result.stdout


def test_bad_input(fgloc, on_disk, tmp_path, gallery):
    out = tmp_path / "a.world.toml"

    def refused(*args, **changes):
        result = fgloc("map", on_disk(**changes), "-o", out, *args)
        assert result.exit_code == 2
        assert "Traceback" not in result.output
        assert not out.exists()
        return result.stderr

    assert "expected landmarks, tags or points" in refused("--of", "lines")
    assert "expected reference or odometry" in refused("--poses", "guess")
    assert "are for other maps" in refused("--of", "points", "--tag-height", "1.0")
    blind = {name: s for name, s in gallery.streams.items() if name != "camera"}
    assert "has no images" in refused("--of", "points", streams=blind)
    assert "has no [camera]" in refused("--of", "points", rig=Rig(sensors=("odometry",)))
