"""`fgloc map` of RFID tags, from the arguments to the files, on a small simulated log."""

import json
from functools import partial

import numpy as np
import pytest
from PIL import Image

from factorgraph_loc import Tag, World, read_world
from factorgraph_loc.simulation.settings import preset
from factorgraph_loc.simulation.simulate import simulate

SETTINGS = {"world": {"width": 7.0, "depth": 6.5, "tags": 8}, "drive": {"duration": 40.0}}


@pytest.fixture(scope="session")
def room():
    return simulate(preset("office", SETTINGS), 1)


@pytest.fixture
def on_disk(room, written):
    """``on_disk(**changes)``: the path of the log with other fields."""
    return partial(written, room)


def rms(made, truth):
    both = [(made[n], truth[n]) for n in made if n in truth]
    return np.sqrt(np.mean([(a.x - b.x) ** 2 + (a.y - b.y) ** 2 for a, b in both]))


def test_a_map_along_the_reference_can_be_used(fgloc, on_disk, room, tmp_path):
    silent = room.world.model_copy(update={"tags": {**room.world.tags, "silent": Tag(x=60.0, y=0.0)}})
    folder, out = on_disk(world=silent), tmp_path / "new.world.toml"
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


def test_dead_tags_are_dropped_and_named(fgloc, refused, on_disk, room, tmp_path):
    """A tag in the middle of the room that is in no read; the others stay as they were, and one that is far away too."""
    x, y = room.reference.poses[len(room.reference) // 2, :2]
    tags = {**room.world.tags, "silent": Tag(x=x, y=y, z=1.0), "far": Tag(x=60.0, y=0.0)}
    folder, out = on_disk(world=room.world.model_copy(update={"tags": tags})), tmp_path / "new.world.toml"
    result = fgloc("map", folder, "--drop-dead", "-o", out)
    assert result.exit_code == 0, result.output
    assert "silent" in result.stdout
    assert "believed dead and not in the new map: 1 of 10 tags" in result.stdout
    del tags["silent"]
    assert read_world(out).tags == tags
    assert (tmp_path / "new.map.png").exists()
    other = tmp_path / "other.world.toml"
    assert "--drop-dead edits the log's map" in refused("map", folder, "--drop-dead", "--extend", "-o", other)


def test_without_reference_and_map_the_frame_is_the_start(fgloc, on_disk, tmp_path):
    folder = on_disk(world=World(), reference=None)
    result = fgloc("map", folder, "--prior", "1,2,0.5", "--tag-height", "1.2", "-o", tmp_path / "a.world.toml")
    assert result.exit_code == 0, result.output
    assert "the robot starts at (1.000 m, 2.000 m, 0.500 rad), from --prior" in result.stdout
    tags = read_world(tmp_path / "a.world.toml").tags
    assert tags
    assert {tag.z for tag in tags.values()} == {1.2}
