"""A short real log on disk, a small log with images, and a way to call the command line in this process."""

import dataclasses
import sys
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from in_short import blank_pictures, in_short, leave_blank, runs_here  # noqa: F401 - fixtures
from typer import testing
from typer.testing import CliRunner, Result

from factorgraph_loc import ImageStream, IncrementStream, Landmark, Log, Rig, Trajectory, World, load, write_native
from factorgraph_loc.cli.app import app
from factorgraph_loc.sensors.camera.settings import CameraSettings, FrontendSettings
from factors import se2
from factors.camera.model import camera_pose

testing._get_command = cache(testing._get_command)  # made once, not for each call, most of which take no longer
Fgloc = Callable[..., Result]
COMMAND = [sys.executable, "-c", "from factorgraph_loc.cli.main import main; main()"]  # in a process of its own
SECONDS = 60.0
WALL = 3.0  # m: the picture hangs on the plane x = 3, 4 m wide and 2.4 m high, 100 px a metre
CAMERA = CameraSettings(
    width=320, height=240, fx=260, fy=260, cx=160, cy=120, z=1.2, frontend=FrontendSettings(feature="sift", count=300)
)


@pytest.fixture(scope="session")
def short_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first minute of Plaza2 as a native folder; tests that change it take a copy."""
    (log,) = load("plaza2")
    start = log.span()[0]

    def cut(rows: object) -> object:
        """The columns of a stream or a trajectory, up to the end of the minute."""
        n = int((rows.t < start + SECONDS).sum())
        columns = {f.name: getattr(rows, f.name) for f in dataclasses.fields(rows)}
        return dataclasses.replace(rows, **{k: v[:n] for k, v in columns.items() if hasattr(v, "__len__")})

    folder = tmp_path_factory.mktemp("logs") / "short"
    streams = {name: cut(stream) for name, stream in log.streams.items()}
    write_native(dataclasses.replace(log, name="short", streams=streams, reference=cut(log.reference)), folder)
    return folder


@pytest.fixture
def fgloc() -> Fgloc:
    """``fgloc("info", path)``: runs the command and returns exit code, stdout and stderr."""

    def call(*args: object) -> Result:
        return CliRunner().invoke(app, [str(arg) for arg in args])

    return call


@pytest.fixture
def refused(fgloc: Fgloc) -> Callable[..., str]:
    """``refused("info", path)``: what a command that refuses what it is given says, in one line and nothing else."""

    def call(*args: object) -> str:
        result = fgloc(*args)
        assert (result.exit_code, result.stdout) == (2, ""), result.output
        (line,) = result.stderr.splitlines()
        assert line.startswith("error: ")
        return line

    return call


@pytest.fixture(scope="session")
def fgloc_once() -> Fgloc:
    """``fgloc`` for fixtures that several tests share, without pictures."""

    def call(*args: object) -> Result:
        with pytest.MonkeyPatch.context() as patch:
            leave_blank(patch)
            return CliRunner().invoke(app, [str(arg) for arg in args])

    return call


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
def written(tmp_path):
    """``written(log, **changes)``: the folder of a log with other fields."""

    def write(log, **changes):
        folder = tmp_path / f"log{len(list(tmp_path.glob('log*')))}"
        write_native(dataclasses.replace(log, **changes), folder)
        return folder

    return write


@pytest.fixture
def gallery_on_disk(gallery, written, tmp_path, monkeypatch):
    """``gallery_on_disk(**changes)``: the path of the log of the gallery with other fields."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return partial(written, gallery)
