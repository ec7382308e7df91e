"""What there is to choose from, and its settings."""

import json
import math
import os
import subprocess
import sys

import pytest

from factorgraph_loc import plugins, read_rig
from factorgraph_loc.cli import completion
from factorgraph_loc.files.settings import settings_in
from factorgraph_loc.files.shipped import manifests
from factorgraph_loc.fusion.registry import settings_of
from factorgraph_loc.io.readers import reader
from factorgraph_loc.planning.policies import policy
from factorgraph_loc.planning.settings import ActiveSettings
from factorgraph_loc.plugins import ESTIMATORS, POLICIES, READERS, SENSORS
from factorgraph_loc.sensors.registry import channels
from factorgraph_loc.sensors.rfid.settings import rackham
from factorgraph_loc.simulation import PRESETS, SimulationSettings


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
    assert fgloc("rigs", "new", "-o", file).stderr.endswith("exists already: choose another name, or use --overwrite\n")
    assert fgloc("rigs", "new", "-o", file, "--overwrite").exit_code == 0
    assert read_rig(file).sensors == ("odometry",)


def test_antennas_have_the_given_names(fgloc, refused, tmp_path):
    assert fgloc("rigs", "new", "--antennas", "A,B", "-o", tmp_path / "a.toml").exit_code == 0
    assert list(read_rig(tmp_path / "a.toml").rfid.antennas) == ["A", "B"]
    assert "--antennas is 'A,A'" in refused("rigs", "new", "--antennas", "A,A", "-o", tmp_path / "b.toml")


def test_several_radios_and_positions_get_their_sections(fgloc, refused, tmp_path):
    options = ("--landmarks", "front=0.1,rear=0.2", "--position", 0.3)
    assert fgloc("rigs", "new", *options, "-o", tmp_path / "a.toml").exit_code == 0
    rig = read_rig(tmp_path / "a.toml")
    assert rig.sensors == ("odometry", "bearing_range.front", "bearing_range.rear", "position")
    assert [rig.section(f"bearing_range.{name}").range_sigma for name in ("front", "rear")] == [0.1, 0.2]
    assert rig.section("position").sigma == 0.3
    for wrong in ("front=0.1,front=0.2", "front=", "=0.1", "front=0.1=0.2"):
        assert f"--landmarks is '{wrong}'" in refused("rigs", "new", "--landmarks", wrong, "-o", tmp_path / "b.toml")


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


FGLOC = [sys.executable, "-c", "from factorgraph_loc.cli.main import main; main()"]


def completed(line: str) -> list[str]:
    """What bash would be given for the last word of a line."""
    words = line.split(" ")
    about = {"_FGLOC_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1)}
    command = [sys.executable, "-c", "import sys; sys.argv[0] = 'fgloc'\n" + FGLOC[2]]
    done = subprocess.run(command, env=os.environ | about, capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_the_names_are_those_of_the_registries():
    assert list(plugins.PRESETS) == list(PRESETS)
    assert all(policy(name) for name in plugins.POLICIES)
    assert completion.logs("") == list(manifests())


def test_the_settings_of_simulations_and_active_runs_are_those_of_the_models():
    keys = {s.key for s in settings_in(SimulationSettings) if not s.key.startswith("rig.")}
    assert {key.removesuffix("=") for key in completion.simulation_setting("")} == keys
    found = completion.active_setting("")
    assert {key.removesuffix("=") for key in found} == keys | {s.key for s in settings_in(ActiveSettings)}


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("fgloc simu", ["simulate"]),
        ("fgloc compare plaza2 -e ekf,smoother,s", ["ekf,smoother,switching"]),
        ("fgloc run no-such-log", []),  # the shell goes on with files
    ],
)
def test_a_shell_completes_words(line, expected):
    assert completed(line) == expected


@pytest.mark.parametrize(
    ("complete", "word", "expected"),
    [
        ("logs", "mrclam6-robot", ["mrclam6-robot1", "mrclam6-robot3", "mrclam6-robot5"]),
        (
            "setting",
            "particle_filter.smoothing",
            ["particle_filter.smoothing_trajectories=", "particle_filter.smoothing_interval="],
        ),
        ("sensors", "odometry,rfid,r", ["odometry,rfid,rssi"]),
        ("reader", "m", ["mapped", "mrclam"]),
        ("simulation_setting", "world.ta", ["world.tags=", "world.tag_height="]),
        ("policies", "random,p", ["random,paper_literal", "random,patrol"]),
    ],
)
def test_words_of_options_are_completed(complete, word, expected):
    assert getattr(completion, complete)(word) == expected


def test_completion_loads_no_numerical_libraries():
    code = (
        "import sys, factorgraph_loc.cli.app\n"
        "from factorgraph_loc.cli import completion\n"
        "assert completion.logs('plaza') and completion.estimators('ekf,') and completion.preset('')\n"
        "assert completion.setting('smo') and completion.reader('m')\n"
        "print(sorted({'numpy', 'gtsam', 'polars', 'scipy', 'pydantic'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
