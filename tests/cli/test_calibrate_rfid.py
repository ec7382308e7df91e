"""``fgloc calibrate`` on a native log with reads of tags, and a rig that states the antennas' places alone."""

import json

import numpy as np
import pytest

from factorgraph_loc.io.native.native import write_native
from factorgraph_loc.io.native.rig_file import read_rig
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.odometry.measurement import IncrementStream
from factorgraph_loc.sensors.rfid.map import Tag
from factorgraph_loc.sensors.rfid.settings import AntennaSettings, RfidSettings
from factorgraph_loc.sensors.rfid.stream import RfidStream
from factors import se2
from factors.rfid.detection import RfidLikelihood, TagArray
from factors.rfid.model import BeamModel

SIDES = {"left": np.pi / 2, "right": -np.pi / 2}


def a_log(seconds=70.0):
    """A robot in circles among 16 tags, with an antenna on each side."""
    rng = np.random.default_rng(0)
    t = 0.1 * np.arange(round(seconds / 0.1))
    twists = np.column_stack((np.full_like(t, 0.05), 0.0 * t, 0.02 + 0.015 * np.sin(0.3 * t)))
    poses = np.zeros((len(t), 3))
    for i in range(1, len(t)):
        poses[i] = se2.compose(poses[i - 1], se2.exp(twists[i]))
    truth = Trajectory(t, poses)
    places = np.mean(poses[:, :2], axis=0) + rng.uniform(-5.0, 5.0, (16, 2))
    rig = Rig(rfid=RfidSettings(antennas={name: AntennaSettings(yaw=yaw) for name, yaw in SIDES.items()}))
    model = RfidLikelihood(
        rig.rfid.model(), TagArray(np.column_stack((places, 0.0 * places[:, 0])), np.full(16, np.nan))
    )
    assert model.model.models == (BeamModel(),)
    rows = []
    for k, stamp in enumerate(np.arange(0.5, t[-1], 0.25)):
        q = model.probabilities(truth.at(np.array((stamp,))), k % 2)[0]
        read = [f"T{i}" for i in np.flatnonzero(rng.random(16) < q)]
        rows += [(stamp, k, list(SIDES)[k % 2], epc) for epc in read or [""]]
    stamps, numbers, antennas, tags = zip(*rows, strict=True)
    unknown = np.full(len(rows), np.nan)
    reads = RfidStream(np.array(stamps), np.array(numbers), antennas, tags, np.zeros(len(rows)), *(unknown,) * 3)
    motion = np.vstack((np.zeros(3), se2.between(poses[:-1], poses[1:]) + rng.normal(0.0, 0.001, (len(t) - 1, 3))))
    world = World(tags={f"T{i}": Tag(x=x, y=y) for i, (x, y) in enumerate(places.tolist())})
    return Log("circles", rig, world, {"odometry": IncrementStream(t, *motion.T), "rfid": reads}, truth)


@pytest.fixture(scope="module")
def calibrated(fgloc_once, tmp_path_factory):
    folder = tmp_path_factory.mktemp("rfid")
    write_native(a_log(), folder / "circles")
    rig = folder / "places.rig.toml"
    rig.write_text("[rfid.antennas]\nleft = { yaw = 1.5708 }\nright = { yaw = -1.5708 }\n")
    out = folder / "cart.rig.toml"
    result = fgloc_once("calibrate", folder / "circles", "--rig", rig, "-o", out, "--json")
    assert result.exit_code == 0, result.output
    return folder / "circles", out, json.loads(result.stdout)


def test_the_rig_is_complete_and_runs(fgloc, calibrated, tmp_path):
    log, out, found = calibrated
    rig = read_rig(out)
    assert "rfid" in rig.sensors
    assert "bearing_range" not in rig.sensors
    rig.rfid.model()
    result = fgloc("run", log, "-e", "smoother", "--rig", out, "-o", tmp_path / "run", "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["final.position_rmse"] < 0.3
    assert found["after"]["circles"]["final.position_rmse"] < 0.3


def test_without_places_of_antennas_nothing_is_learnt(fgloc, calibrated, tmp_path):
    log, _, _ = calibrated
    empty = tmp_path / "empty.rig.toml"
    empty.write_text('name = "empty"\n')
    result = fgloc("calibrate", log, "--rig", empty, "-o", tmp_path / "a.rig.toml")
    assert result.exit_code == 2
    assert "its rig has no RFID antennas, expected their mounting in [rfid.antennas]" in result.stderr
