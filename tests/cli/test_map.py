"""`fgloc map`, from the arguments to the files, on a small simulated log."""

import json
from functools import partial

import numpy as np
import pytest
from landmark_world import WORLD, simulate, swapped
from PIL import Image

from factorgraph_loc.io.native.world_file import read_world
from factorgraph_loc.model.log import StartPose
from factorgraph_loc.model.world import World
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
        (["-o", "OUT/a.world.toml", "--set", "batch.landmarks=known"], "--set is batch.landmarks"),
        (["-o", "OUT/there.world.toml"], "exists already"),
        (["-o", "OUT/a.world.toml"], "from a range alone a landmark cannot be located"),
    ],
)
def test_what_cannot_be_mapped_is_one_line(refused, short_log, tmp_path, options, message):
    (tmp_path / "there.world.toml").write_text("")
    assert message in refused("map", short_log, *(option.replace("OUT", str(tmp_path)) for option in options))
    assert not list(tmp_path.glob("a.*"))
