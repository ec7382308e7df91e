"""What there is to choose from, and its settings."""

import fcntl
import json
import os
import pty
import struct
import subprocess
import sys
import termios
from collections import Counter

import pytest

from factorgraph_loc.fusion.registry import settings_of
from factorgraph_loc.io.readers import reader
from factorgraph_loc.planning.policies import POLICIES
from factorgraph_loc.plugins import ESTIMATORS, READERS, SENSORS
from factorgraph_loc.sensors.registry import channels
from factorgraph_loc.simulation import PRESETS, preset


def test_the_list_names_all_estimators(fgloc):
    found = json.loads(fgloc("estimators", "--json").stdout)
    assert [one["name"] for one in found] == list(ESTIMATORS)
    assert all(one["about"].endswith(".") for one in found)
    printed = fgloc("estimators")
    assert printed.exit_code == 0
    assert all(one["about"] in printed.stdout for one in found)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_every_setting_of_an_estimator_is_told(fgloc, name):
    found = json.loads(fgloc("estimators", name, "--json").stdout)
    defaults = settings_of(name, {}).model_dump(mode="json")
    assert {one["key"]: one["default"] for one in found["settings"]} == defaults
    assert all(one["meaning"] for one in found["settings"])
    printed = fgloc("estimators", name)
    assert all(one["meaning"] in printed.stdout for one in found["settings"])


def test_a_bad_name_is_told_with_the_nearest(fgloc):
    done = fgloc("estimators", "smother")
    assert done.exit_code == 2
    assert done.stderr == "error: no estimator is called 'smother': did you mean smoother?\n"
    assert "known: batch, dead_reckoning, ekf" in fgloc("estimators", "zzz").stderr


def test_the_list_of_sensors_has_their_channels(fgloc):
    found = json.loads(fgloc("sensors", "--json").stdout)
    assert [one["name"] for one in found] == list(SENSORS)
    assert [name for one in found for name in one["channels"]] == list(channels())
    printed = fgloc("sensors")
    assert printed.exit_code == 0
    assert "rfid, rssi, phase" in printed.stdout


def test_a_sensor_has_columns_with_units_and_the_keys_of_the_rig(fgloc):
    found = json.loads(fgloc("sensors", "rfid", "--json").stdout)
    tables = {table["name"]: {column["name"]: column for column in table["columns"]} for table in found["tables"]}
    assert list(tables) == ["rfid", "inventories", "reads", "tags"]
    assert (tables["rfid"]["rssi"]["unit"], tables["rfid"]["rssi"]["may_lack"]) == ("dBm", True)
    assert tables["rfid"]["epc"]["high"] is None
    keys = {setting["key"]: setting for setting in found["settings"]["rfid"]}
    assert (keys["round_gap"]["default"], keys["round_gap"]["unit"]) == (0.05, "s")
    printed = fgloc("sensors", "rfid").stdout
    assert "-200 to 200 dBm, or empty" in printed
    assert "models.*.sigma_phi" in printed


def test_a_channel_stands_for_its_sensor(fgloc):
    assert fgloc("sensors", "sightings").stdout == fgloc("sensors", "camera").stdout
    assert "did you mean bearing_range?" in fgloc("sensors", "bearing_rang").stderr
    assert "did you mean landmarks?" in fgloc("sensors", "landmark").stderr


@pytest.mark.parametrize("name", READERS)
def test_every_option_of_a_reader_is_told(fgloc, name):
    found = json.loads(fgloc("readers", name, "--json").stdout)
    assert {one["key"].partition(".")[0] for one in found["options"]} == set(reader(name).options.model_fields)
    assert all(one["meaning"] for one in found["options"])
    assert fgloc("readers", name).exit_code == 0


def test_the_list_of_readers(fgloc):
    found = json.loads(fgloc("readers", "--json").stdout)
    assert [one["name"] for one in found] == list(READERS)
    assert all(one["about"] in fgloc("readers").stdout for one in found)
    assert "did you mean rosbag?" in fgloc("readers", "rosbags").stderr


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_has_its_own_values(fgloc, name):
    found = json.loads(fgloc("presets", name, "--json").stdout)
    values = {one["key"]: one["default"] for one in found["settings"]}
    settings = preset(name)
    expected = (settings.world.plan, settings.world.tags, settings.faults.fading.share)
    assert (values["world.plan"], values["world.tags"], values["faults.fading.share"]) == expected
    assert not [key for key in values if key.startswith("rig.")]
    printed = fgloc("presets", name)
    assert f"fgloc rigs show {name}" in printed.stdout
    assert all(one["meaning"] in printed.stdout for one in found["settings"])


def test_the_list_of_presets(fgloc):
    found = json.loads(fgloc("presets", "--json").stdout)
    assert [one["name"] for one in found] == list(PRESETS)
    assert all(one["about"] in fgloc("presets").stdout for one in found)
    assert "did you mean office?" in fgloc("presets", "offce").stderr


def test_policies_and_what_is_set_of_active_runs(fgloc):
    found = json.loads(fgloc("policies", "--json").stdout)
    assert list(found["policies"]) == list(POLICIES)
    printed = fgloc("policies").stdout
    assert all(about in printed for about in found["policies"].values())
    assert "policy.horizon" in printed
    assert "above 0 to 100 m" in printed


@pytest.mark.parametrize("columns", [90, 140])
def test_a_terminal_wraps_long_texts_and_loses_none(fgloc, columns):
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 40, columns, 0, 0))
    code = "from factorgraph_loc.cli.main import main; main()"
    environment = {name: value for name, value in os.environ.items() if name != "COLUMNS"} | {"TERM": "dumb"}
    with subprocess.Popen([sys.executable, "-c", code, "sensors", "rfid"], stdout=theirs, env=environment):
        os.close(theirs)
        told = b""
        try:
            while part := os.read(ours, 4096):
                told += part
        except OSError:  # the end
            pass
    os.close(ours)
    lines = told.decode().splitlines()
    assert columns - 20 < max(map(len, lines)) <= columns
    words = [line.split() for line in lines]
    expected = fgloc("sensors", "rfid").stdout.split()
    assert Counter(word for line in words for word in line) == Counter(expected)
