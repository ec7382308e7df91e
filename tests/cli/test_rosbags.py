"""From a bag of a robot that nobody knows to a comparison, as docs/rosbags.md tells."""

import json
from pathlib import Path

import pytest
from scripts_here import run_script


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
