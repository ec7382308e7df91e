"""What there is to choose from, and its settings."""

import json

import pytest

from factorgraph_loc.fusion.registry import settings_of
from factorgraph_loc.io.readers import reader
from factorgraph_loc.plugins import ESTIMATORS, POLICIES, READERS, SENSORS
from factorgraph_loc.sensors.registry import channels


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


def test_a_bad_name_is_told_with_the_nearest(refused):
    assert "did you mean smoother?" in refused("estimators", "smother")
    assert "known: batch, dead_reckoning, ekf" in refused("estimators", "zzz")


def test_the_list_of_sensors_has_their_channels(fgloc):
    found = json.loads(fgloc("sensors", "--json").stdout)
    assert [one["name"] for one in found] == list(SENSORS)
    assert [name for one in found for name in one["channels"]] == list(channels())
    printed = fgloc("sensors")
    assert printed.exit_code == 0
    assert "rfid, rssi, phase" in printed.stdout


def test_a_sensor_has_columns_with_units_and_the_keys_of_the_rig(fgloc):
    found = json.loads(fgloc("sensors", "rfid", "--json").stdout)
    tables = {name: {column["name"]: column for column in columns} for name, columns in found["tables"].items()}
    assert list(tables) == ["rfid", "inventories", "reads", "tags"]
    assert (next(iter(tables["rfid"]["rssi"]["units"])), tables["rfid"]["rssi"]["may_lack"]) == ("dBm", True)
    assert tables["rfid"]["epc"]["high"] is None
    keys = {setting["key"]: setting for setting in found["rig"]["rfid"]}
    assert (keys["round_gap"]["default"], keys["round_gap"]["unit"]) == (0.05, "s")
    printed = fgloc("sensors", "rfid").stdout
    assert "-200 to 200 dBm, or empty" in printed
    assert "models.*.sigma_phi" in printed


@pytest.mark.parametrize("name", READERS)
def test_every_option_of_a_reader_is_told(fgloc, name):
    found = json.loads(fgloc("readers", name, "--json").stdout)
    assert {one["key"].partition(".")[0] for one in found["settings"]} == set(reader(name).Options.model_fields)
    assert all(one["meaning"] for one in found["settings"])
    assert fgloc("readers", name).exit_code == 0


def test_policies_and_what_is_set_of_active_runs(fgloc):
    found = json.loads(fgloc("policies", "--json").stdout)
    assert [one["name"] for one in found] == list(POLICIES)
    printed = fgloc("policies").stdout
    assert all(one["about"] in printed for one in found)
    assert "policy.horizon" in printed
    assert "above 0 to 100 m" in printed
