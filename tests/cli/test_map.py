"""`fgloc map`, from the arguments to the files, on a small simulated log."""

import dataclasses
import json
from functools import partial

import numpy as np
import pytest
from landmark_world import WORLD, simulate, swapped
from PIL import Image

from factorgraph_loc import StartPose, Tag, World, read_world
from factorgraph_loc.simulation.settings import preset
from factorgraph_loc.simulation.simulate import simulate as simulate_office
from factors import se2

PLACES = WORLD.positions()


@pytest.fixture(scope="session")
def loop():
    """A robot that drives a loop from (0, 0, 0), among eight landmarks."""
    return simulate()


@pytest.fixture
def on_disk(loop, written):
    """``on_disk(**changes)``: the path of the log with other fields."""
    return partial(written, loop)


def test_a_map_with_swapped_landmarks_is_corrected_and_can_be_used(fgloc, loop, on_disk, tmp_path):
    folder, out = on_disk(world=swapped(loop, "b", "e").world), tmp_path / "new.world.toml"
    result = fgloc("map", folder, "-o", out)
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert any(line.startswith("b ") and line.endswith("swapped with e") for line in map(str.rstrip, lines))
    assert any("2 wrong in the given map (b, e)" in line for line in lines)
    made = read_world(out)
    np.testing.assert_allclose(made.positions(), PLACES, atol=0.15)
    assert all(landmark.covariance for landmark in made.landmarks.values())
    with Image.open(tmp_path / "new.map.png") as picture:
        assert picture.width == 1600
    run = fgloc("run", folder, "-e", "ekf", "--world", out, "-o", tmp_path / "run", "--json")
    assert json.loads(run.stdout)["causal.position_rmse"] < 0.15


def test_without_a_map_the_frame_is_the_start(fgloc, on_disk, tmp_path):
    folder = on_disk(world=World(), reference=None)
    result = fgloc("map", folder, "-e", "ekf", "-o", tmp_path / "a.world.toml")
    assert result.exit_code == 0, result.output
    assert "that of the start: the first pose is the origin (0, 0, 0)" in result.stdout
    np.testing.assert_allclose(read_world(tmp_path / "a.world.toml").positions(), PLACES, atol=0.3)
    result = fgloc("map", folder, "-e", "ekf", "-o", tmp_path / "b.world.toml", "--prior", "10,20,1.5")
    assert "the robot starts at (10.000 m, 20.000 m, 1.500 rad), from --prior" in result.stdout
    there = se2.transform_from(np.array((10.0, 20.0, 1.5)), PLACES)
    np.testing.assert_allclose(read_world(tmp_path / "b.world.toml").positions(), there, atol=0.3)


def test_a_map_is_extended(fgloc, on_disk, tmp_path):
    part = World(landmarks=dict(list(WORLD.landmarks.items())[:4]))
    start = StartPose(0.0, np.zeros(3), np.full(3, 0.05))
    folder = on_disk(world=part, reference=None, start=start)
    result = fgloc("map", folder, "-e", "ekf", "--extend", "-o", tmp_path / "a.world.toml")
    assert result.exit_code == 0, result.output
    assert "8 landmarks are in the new map: 4 as given, 4 new" in result.stdout
    made = read_world(tmp_path / "a.world.toml")
    assert made.landmarks["a"] == part.landmarks["a"]
    np.testing.assert_allclose(made.positions(), PLACES, atol=0.15)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["-o", "OUT/a.toml"], "expected a name that ends in .world.toml"),
        (["-o", "OUT/none/a.world.toml"], "there is no folder"),
        (["-o", "OUT/a.world.toml", "-e", "particle_filter"], "expected one that estimates landmarks"),
        (
            ["-o", "OUT/a.world.toml", "--set", "batch.landmarks=known"],
            "--set batch.landmarks cannot be used to make a map",
        ),
        (["-o", "OUT/there.world.toml"], "exists already"),
        (
            ["-o", "OUT/a.world.toml", "-e", "ekf"],
            "no sighting has a bearing, and ekf needs range and bearing to locate a landmark",
        ),
    ],
)
def test_what_cannot_be_mapped_is_one_line(refused, short_log, tmp_path, options, message):
    (tmp_path / "there.world.toml").write_text("")
    assert message in refused("map", short_log, *(option.replace("OUT", str(tmp_path)) for option in options))
    assert not list(tmp_path.glob("a.*"))


SETTINGS = {"world": {"width": 7.0, "depth": 6.5, "tags": 8}, "drive": {"duration": 40.0}}


@pytest.fixture(scope="session")
def room():
    return simulate_office(preset("office", SETTINGS), 1)


@pytest.fixture
def room_on_disk(room, written):
    """``on_disk(**changes)``: the path of the log with other fields."""
    return partial(written, room)


def rms(made, truth):
    both = [(made[n], truth[n]) for n in made if n in truth]
    return np.sqrt(np.mean([(a.x - b.x) ** 2 + (a.y - b.y) ** 2 for a, b in both]))


def test_a_map_along_the_reference_can_be_used(fgloc, room_on_disk, room, tmp_path):
    silent = room.world.model_copy(update={"tags": {**room.world.tags, "silent": Tag(x=60.0, y=0.0)}})
    folder, out = room_on_disk(world=silent), tmp_path / "new.world.toml"
    result = fgloc("map", folder, "-o", out)
    assert result.exit_code == 0, result.output
    assert "never read: silent" in result.stdout
    assert "root mean square distance from the given positions: 0." in result.stdout
    assert "the frame of the new map is that of the reference" in result.stdout
    made = read_world(out)
    assert rms(made.tags, room.world.tags) < 0.6
    assert sum(tag.covariance is not None for tag in made.tags.values()) >= 5
    with Image.open(tmp_path / "new.map.png") as picture:
        assert picture.width == 1600
    errors = []
    for world in ((), ("--world", out)):
        run = fgloc("run", folder, "-e", "smoother", *world, "-o", tmp_path / f"run{len(errors)}", "--json")
        assert run.exit_code == 0, run.output
        errors.append(json.loads(run.stdout)["final.position_rmse"])
    assert errors[1] < max(2.0 * errors[0], 0.2)


def test_dead_tags_are_dropped_and_named(fgloc, refused, room_on_disk, room, tmp_path):
    """A tag in the middle of the room that is in no read; the others stay as they were, and one that is far away too."""
    x, y = room.reference.poses[len(room.reference) // 2, :2]
    tags = {**room.world.tags, "silent": Tag(x=x, y=y, z=1.0), "far": Tag(x=60.0, y=0.0)}
    folder, out = room_on_disk(world=room.world.model_copy(update={"tags": tags})), tmp_path / "new.world.toml"
    result = fgloc("map", folder, "--drop-dead", "-o", out)
    assert result.exit_code == 0, result.output
    assert "silent" in result.stdout
    assert "believed dead and not in the new map: 1 of 10 tags" in result.stdout
    del tags["silent"]
    assert read_world(out).tags == tags
    assert (tmp_path / "new.map.png").exists()
    other = tmp_path / "other.world.toml"
    assert "--drop-dead only removes dead tags" in refused("map", folder, "--drop-dead", "--extend", "-o", other)


def test_without_reference_and_map_the_frame_is_the_start(fgloc, room_on_disk, tmp_path):
    folder = room_on_disk(world=World(), reference=None)
    result = fgloc("map", folder, "--prior", "1,2,0.5", "--height", "1.2", "-o", tmp_path / "a.world.toml")
    assert result.exit_code == 0, result.output
    assert "the robot starts at (1.000 m, 2.000 m, 0.500 rad), from --prior" in result.stdout
    tags = read_world(tmp_path / "a.world.toml").tags
    assert tags
    assert {tag.z for tag in tags.values()} == {1.2}


WALL = 3.0  # m, where the picture hangs


def test_points_lie_on_the_wall(fgloc, gallery_on_disk, tmp_path):
    out = tmp_path / "hall.world.toml"
    result = fgloc("map", gallery_on_disk(), "-o", out, "--json")
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
    assert report["frame"] == "that of the reference"


def test_a_map_is_thinned_extended_and_exported(fgloc, gallery_on_disk, tmp_path):
    log, few, both = gallery_on_disk(), tmp_path / "few.world.toml", tmp_path / "both.world.toml"
    assert fgloc("map", log, "-o", few, "--set", "points.most=40").exit_code == 0
    assert len(read_world(few).points) == 40
    result = fgloc("map", log, "--world", few, "--extend", "--of", "points", "-o", both, "--json")
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert report["points"] == len(read_world(both).points) > 60
    assert 30 <= report["fused"] <= 40
    result = fgloc("export", log, "--world", both, "-o", tmp_path / "both.ply")
    assert result.exit_code == 0, result.output
    header, _, body = (tmp_path / "both.ply").read_text().partition("end_header\n")
    assert f"element vertex {report['points']}\n" in header
    rows = np.array([line.split() for line in body.splitlines()], dtype=float)
    np.testing.assert_allclose(rows[:, :3], read_world(both).points.positions, atol=1e-6)
    assert (rows[:, 4] >= 1).all()


UNKNOWN = ("-e", "smoother", "--set", "smoother.landmarks=unknown")


def test_a_run_without_a_map_writes_one(fgloc, gallery, gallery_on_disk, tmp_path):
    """Wheels that report a turn of 0.1 rad where there is none; images correct it, so that the points lie on the wall."""
    wheels = gallery.streams["odometry"]
    bent = dataclasses.replace(wheels, dtheta=wheels.dtheta + np.where(np.arange(len(wheels.t)) == 5, 0.1, 0.0))
    log = gallery_on_disk(streams={**gallery.streams, "odometry": bent})
    out = tmp_path / "monday"
    result = fgloc("run", log, *UNKNOWN, "-o", out)
    assert result.exit_code == 0, result.output
    world = read_world(out / "map.world.toml")
    assert (
        f"a map with the {len(world.points)} points that the run estimated is in {out / 'map.world.toml'}"
        in result.stdout
    )
    assert set(world.landmarks) == {"door"}
    off = world.points.positions[:, 0] - WALL
    assert np.median(np.abs(off)) < 0.05
    assert np.mean(np.abs(off) < 3.0 * np.sqrt(world.points.covariances[:, 0, 0])) > 0.9
    assert world.points.common.shape == (len(world.points.owners), 3, 3)
    result = fgloc(
        "run", gallery_on_disk(), "-e", "smoother", "--world", out / "map.world.toml", "-o", tmp_path / "tuesday"
    )
    assert result.exit_code == 0, result.output
    assert (
        "the map was made without a reference. Along the trajectory the map's error has a standard deviation of 0.0"
        in result.stderr
    )
    scores = json.loads((tmp_path / "tuesday" / "metrics.json").read_text())
    assert scores["final.anees"] < 9.0  # wheels without noise: the odds are far better than one in a hundred
    assert scores["final.position_rmse"] < 0.05
    assert not list((tmp_path / "tuesday").glob("map.*"))
    # a map is not left behind where a run without one is written over it
    assert fgloc("run", log, "-e", "ekf", "--sensors", "odometry", "-o", out, "--overwrite").exit_code == 0
    assert not list(out.glob("map.*"))
