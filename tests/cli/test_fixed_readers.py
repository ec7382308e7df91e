"""Fixed antennas in a log on disk, and in tables of another program with a manifest."""

import json

import pytest
from mapped_hall import VELOCITIES

from factorgraph_loc import read_log

MANIFEST = f"""\
title = "a gate"
reader = "mapped"
path = "run"
licence = "none stated"
origin = "made by hand"
rig = "cart.rig.toml"
world = "gate.world.toml"
{VELOCITIES}
[options.rfid]
file = "reads.csv"
columns = {{ t = "time", antenna = "port", epc = "tag" }}
units = {{ t = "s" }}
antennas = {{ 1 = "gate1", 2 = "gate2" }}
"""
RIG = """\
name = "cart"
sensors = ["odometry", "rfid"]
[rfid.tags.E2001]
x = 0.2
z = 1.0
facing = 0.0
"""
WORLD = """\
[antennas]
gate1 = { x = 3.0, y = 1.5, z = 2.0, yaw = -1.5708, pitch = -0.5 }
gate2 = { x = 6.0, y = -1.5, z = 2.0, yaw = 1.5708, pitch = -0.5 }
"""


@pytest.fixture(scope="module")
def log(tmp_path_factory, fgloc_once):
    folder = tmp_path_factory.mktemp("gates") / "log"
    made = fgloc_once("simulate", "gates", "-o", folder, "--seed", 2, "--duration", 60)
    assert made.exit_code == 0, made.output
    return folder


def test_a_simulated_log_is_read_run_and_plotted(fgloc, log, tmp_path):
    again = read_log(log)
    assert len(again.world.antennas) == 16
    assert list(again.rig.rfid.tags) == ["front", "back"]
    info = fgloc("info", log)
    assert "16 antennas" in info.stdout
    assert "of 2 tags on the robot" in info.stdout
    run = fgloc("run", log, "-e", "smoother", "-o", tmp_path / "run", "--json")
    assert json.loads(run.stdout)["causal.position_rmse"] < 0.3
    assert list((tmp_path / "run" / "plots").iterdir())


def test_reads_of_another_program_by_a_manifest(fgloc, tmp_path):
    """Two gates read the tag while the robot drives 8 m straight on, with wheels that report a tenth too much."""
    (tmp_path / "run").mkdir()
    times = [0.1 * i for i in range(161)]
    wheels = "t,v,w\n" + "".join(f"{t:.1f},0.55,0\n" for t in times)
    reads = [(t, gate, "E2001") for t in times for gate, x in ((1, 3.0), (2, 6.0)) if abs(0.5 * t + 0.2 - x) < 1.2]
    (tmp_path / "run" / "wheels.csv").write_text(wheels)
    rows = "".join(f"{t:.1f},{gate},{epc}\n" for t, gate, epc in [*reads, (8.0, 1, "E2999")])
    (tmp_path / "run" / "reads.csv").write_text("time,port,tag\n" + rows)
    for name, text in (("gates.toml", MANIFEST), ("cart.rig.toml", RIG), ("gate.world.toml", WORLD)):
        (tmp_path / name).write_text(text)
    done = fgloc("run", tmp_path / "gates.toml", "-e", "ekf", "--prior", "0,0,0", "-o", tmp_path / "out")
    assert done.exit_code == 0, done.output
    x = float((tmp_path / "out" / "final.tum").read_text().splitlines()[-1].split()[1])
    assert 7.8 < x < 8.7  # 8.8 by the wheels
    info = fgloc("info", tmp_path / "gates.toml")
    assert "reads of 1 tags on the robot and of 1 others" in info.stdout


def test_commands_that_need_antennas_on_the_robot_refuse(refused, log, tmp_path):
    assert "antennas in the map are not calibrated" in refused("calibrate", log, "-o", tmp_path / "a.rig.toml")
    assert "[rfid.antennas]" in refused("map", log, "--of", "tags", "-o", tmp_path / "a.world.toml")
    assert "antennas in the map" in refused("active", "gates", "-o", tmp_path / "active")
    line = refused("simulate", "gates", "-o", tmp_path / "b", "--set", "world.antennas=0")
    assert "world.antennas and rig.rfid.tags" in line


def test_a_rig_has_antennas_or_tags(refused, log, tmp_path):
    rig = tmp_path / "both.rig.toml"
    rig.write_text(
        'name = "both"\nsensors = ["odometry", "rfid"]\n[rfid.tags.A]\nz = 1.0\n[rfid.antennas.left]\nz = 1.0\n'
    )
    assert "expected exactly one of antennas, preset and tags" in refused("info", log, "--rig", rig)
