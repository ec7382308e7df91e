"""``fgloc simulate``: folders that can be read back, the same bytes for the same seed, and errors of one line."""

import cv2
import pytest

from factorgraph_loc.io.readers import load
from factorgraph_loc.simulation import preset, simulate


def test_a_log_is_written_and_read_back(fgloc, tmp_path):
    done = fgloc("simulate", "sparse", "-o", tmp_path / "log", "--seed", 4, "--duration", 30, "--set", "world.tags=12")
    assert done.exit_code == 0, done.stderr
    assert str(tmp_path / "log") in done.stdout
    (log,) = load(str(tmp_path / "log"))
    made = simulate(preset("sparse", {"drive": {"duration": 30.0}, "world": {"tags": 12}}), 4)
    assert log.world.tags == made.world.tags
    assert list(log.streams["rfid"].epc) == list(made.streams["rfid"].epc)
    assert list(log.streams["rfid"].antenna) == list(made.streams["rfid"].antenna)
    assert log.streams["rfid"].t.tolist() == made.streams["rfid"].t.tolist()
    assert log.streams["odometry"].dtheta.tolist() == made.streams["odometry"].dtheta.tolist()
    assert log.rig == made.rig
    assert log.metadata == made.metadata


def test_a_file_of_settings_takes_the_place_of_a_preset(fgloc, tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('preset = "warehouse"\n[drive]\nduration = 500\nspeed = 1.0\n')
    done = fgloc("simulate", path, "-o", tmp_path / "log", "--duration", 5)
    assert done.exit_code == 0, done.stderr
    (log,) = load(str(tmp_path / "log"))
    assert log.name == "mine-0"
    assert log.span()[1] == 5.0


def test_images_are_written_with_the_log(fgloc, tmp_path):
    small = ("--set", "world.width=9", "--set", "world.depth=8")
    options = ("--images", "--set", "images.rate=2", "--duration", 1, "--set", "world_seed=5", *small)
    done = fgloc("simulate", "office", "-o", tmp_path / "new" / "log", "--seed", 3, *options)
    assert done.exit_code == 0, done.stderr
    assert [folder.name for folder in (tmp_path / "new").iterdir()] == ["log"]
    (log,) = load(str(tmp_path / "new" / "log"))
    assert log.streams["camera"].t.tolist() == [0.5, 1.0]
    assert log.rig.sensors == ("odometry", "rfid", "camera")
    assert cv2.imread(str(log.streams["camera"].file[1])).shape == (480, 640, 3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("office", "--set", "images.rate=5"), "has no effect without --images"),
        (("office", "--set", "world.tgas=3"), "unknown key world.tgas: did you mean tags?"),
    ],
)
def test_what_is_wrong_is_told_in_one_line(refused, tmp_path, arguments, message):
    assert message in refused("simulate", *arguments, "-o", tmp_path / "log")
    assert not (tmp_path / "log").exists()
