"""From a bag of a robot that nobody knows to a comparison, as docs/rosbags.md tells."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from scripts_here import run_script

from factorgraph_loc.io.readers import load


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A bag with reads in a message type of its own, a rig and a map beside it."""
    bag = tmp_path_factory.mktemp("recorded") / "drive.bag"
    run_script("example_bag", bag, "--seconds", 15)
    return bag


def test_from_a_bag_to_a_comparison(recorded, fgloc, monkeypatch):
    monkeypatch.chdir(recorded.parent)
    told = fgloc("info", "drive.bag")
    assert told.exit_code == 0
    assert "shop_msgs/msg/TagReport" in told.stdout
    assert "fgloc manifest drive.bag > run.toml" in told.stdout
    proposed = fgloc("manifest", "drive.bag")
    assert (proposed.exit_code, proposed.stderr) == (0, "")
    Path("run.toml").write_text(proposed.stdout)
    document = json.loads(fgloc("info", "run.toml", "--json").stdout)
    assert (document["log"], document["rig"]["name"], document["world"]["tags"]) == ("drive", "cart", 40)
    assert document["rfid"]["rounds"] == 240
    compared = fgloc("compare", "run.toml", "-e", "dead_reckoning,smoother", "-o", "out", "--json")
    assert compared.exit_code == 0
    error = {row["estimator"]: row["final.position_rmse"] for row in json.loads(compared.stdout)["runs"]}
    assert error["smoother"] < 0.3
    assert error["smoother"] < error["dead_reckoning"]
    pytest.importorskip("rerun", reason="needs the extra viewer")
    assert fgloc("view", "out", "run.toml", "--rrd", "drive.rrd").exit_code == 0
    assert Path("drive.rrd").stat().st_size > 10_000


def test_the_wheels_and_what_is_not_read(recorded, fgloc, monkeypatch):
    monkeypatch.chdir(recorded.parent)
    manifest = tomllib.loads(fgloc("manifest", "drive.bag").stdout)
    wheels = {"left": "wheel_left_joint", "right": "wheel_right_joint", "radius": 0.1, "track": 0.4}
    manifest["options"]["odometry"] = {"topic": "/joint_states", "wheels": wheels}
    Path("wheels.toml").write_text(tomli_w.dumps(manifest))
    (by_wheels,), (by_poses,) = load(Path("wheels.toml")), load(Path("run.toml"))
    assert by_wheels.metadata["not read"] == "/odom (nav_msgs/msg/Odometry), /scan (sensor_msgs/msg/LaserScan)"
    moved = [log.streams["odometry"] for log in (by_wheels, by_poses)]
    np.testing.assert_allclose(moved[0].dtheta, moved[1].dtheta, atol=1e-6)
    assert "not read" in fgloc("info", "wheels.toml").stdout
