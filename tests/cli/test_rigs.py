"""Rigs are listed, printed with the meaning of their keys, and written for a robot of one's own."""

import json
import math

import pytest

from factorgraph_loc import read_rig
from factorgraph_loc.cli import completion
from factorgraph_loc.sensors.rfid.settings import rackham
from factorgraph_loc.simulation import PRESETS


def test_the_list_has_shipped_rigs_and_those_of_simulations(fgloc):
    listed = json.loads(fgloc("rigs", "--json").stdout)
    names = [one["name"] for one in listed]
    assert {"default", "plaza", "rfid-aisle", *PRESETS} <= set(names)
    assert names == completion.rig("")
    assert "fgloc simulate" in fgloc("rigs").stdout


@pytest.mark.parametrize("name", [name for name in completion.rig("") if name != "rfid-aisle"])
def test_a_rig_that_is_printed_can_be_used(fgloc, tmp_path, name):
    file = tmp_path / "a.rig.toml"
    file.write_text(fgloc("rigs", "show", name).stdout)
    printed = json.loads(fgloc("rigs", "show", name, "--json").stdout)
    assert read_rig(file).model_dump(mode="json", exclude_none=True) == printed
    assert fgloc("rigs", "show", file).stdout == file.read_text()


def test_a_new_rig_has_the_sensors_that_are_named(fgloc, tmp_path):
    file = tmp_path / "cart.rig.toml"
    options = ("--odometry", "omnidirectional", "--imu", "--landmarks", 0.2, "--antennas", 2, "--camera", "640x480")
    made = json.loads(fgloc("rigs", "new", *options, "-o", file, "--json").stdout)
    rig = read_rig(file)
    assert made["rig"] == rig.model_dump(mode="json", exclude_none=True)
    assert rig.name == "cart"
    assert rig.sensors == ("odometry", "imu", "bearing_range", "rfid", "camera")
    assert rig.odometry.noise.lateral == rig.odometry.noise.along
    assert rig.bearing_range.range_sigma == 0.2
    assert [antenna.yaw for antenna in rig.rfid.antennas.values()] == pytest.approx([math.pi / 2.0, -math.pi / 2.0])
    assert (rig.camera.width, rig.camera.cx) == (640, 319.5)
    assert fgloc("rigs", "new", "-o", file).stderr.endswith("exists already; choose another name or give --overwrite\n")
    assert fgloc("rigs", "new", "-o", file, "--overwrite").exit_code == 0
    assert read_rig(file).sensors == ("odometry",)


def test_antennas_have_the_given_names(fgloc, refused, tmp_path):
    assert fgloc("rigs", "new", "--antennas", "A,B", "-o", tmp_path / "a.toml").exit_code == 0
    assert list(read_rig(tmp_path / "a.toml").rfid.antennas) == ["A", "B"]
    assert "--antennas is 'A,A'" in refused("rigs", "new", "--antennas", "A,A", "-o", tmp_path / "b.toml")


def test_eight_antennas_stand_as_on_the_robot_of_the_paper(fgloc, tmp_path):
    fgloc("rigs", "new", "--antennas", 8, "-o", tmp_path / "a.toml")
    made, published = read_rig(tmp_path / "a.toml").rfid.antennas, rackham()
    assert list(made) == list(published)
    for name, antenna in made.items():
        expected = published[name].model_dump()
        assert antenna.model_dump() == {
            k: v if k == "model" else pytest.approx(v, abs=1e-4) for k, v in expected.items()
        }


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ((), "--out is missing"),
        (("--odometry", "tracks"), "--odometry is 'tracks', expected one of differential"),
        (("--camera", "640"), "--camera is '640', expected a size"),
        (("--camera", "8x480", "-o", "a.toml"), "camera.width is 8"),
        (("--odometry", "none", "-o", "a.toml"), "the new rig has no sensors"),
    ],
)
def test_wrong_options_are_one_line(refused, tmp_path, monkeypatch, options, why):
    monkeypatch.chdir(tmp_path)
    assert why in refused("rigs", "new", *options)
    assert not list(tmp_path.iterdir())
