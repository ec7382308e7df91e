"""What a compass can be used for where its package is installed: run by ``test_compass.py``, which puts it on the path."""

import dataclasses
import json
import math
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from bag_maker import BagMaker
from compass.settings import CompassSettings
from compass.stream import Heading, HeadingStream
from in_short import blank_pictures, in_short, runs_here  # noqa: F401 - fixtures
from mapped_hall import VELOCITIES, write_mapped
from typer.testing import CliRunner

import factorgraph_loc as fgloc
from factorgraph_loc.cli.app import app
from factors import se2

T = np.arange(50) / 10.0
UNIX = 1_700_000_000_000_000_000
RIG = fgloc.Rig(
    name="cart", sensors=("odometry", "compass"), compass=CompassSettings(bias=0.1, uncertainty={"bias": 0.3})
)


def made_log() -> fgloc.Log:
    """Five seconds along an arc, with a compass that reports 0.1 rad too much, twice a second."""
    truth = np.column_stack((np.sin(0.2 * T) / 0.2, (1.0 - np.cos(0.2 * T)) / 0.2, 0.2 * T))
    streams = {
        "odometry": fgloc.VelocityStream(T, np.ones(50), np.full(50, 0.2)),
        "compass": HeadingStream(T[::5] + 0.03, 0.2 * (T[::5] + 0.03) + 0.1),
    }
    start = fgloc.StartPose(0.0, np.zeros(3), np.full(3, 0.01))
    return fgloc.Log("arc", RIG, fgloc.World(), streams, fgloc.Trajectory(T, truth), start, t0_ns=UNIX)


def command(*words: object) -> SimpleNamespace:
    """What a command prints, and its exit code."""
    done = CliRunner().invoke(app, [str(word) for word in words])
    return SimpleNamespace(stdout=done.stdout, stderr=done.stderr, returncode=done.exit_code)


def test_a_rig_has_its_section(tmp_path):
    file = tmp_path / "a.rig.toml"
    fgloc.write_rig(RIG, file)
    assert fgloc.read_rig(file) == RIG
    assert RIG.compass is RIG.find(CompassSettings)
    assert RIG.estimated("compass").names == ("bias",)
    assert fgloc.Rig().compass is None
    assert fgloc.Rig(compass=CompassSettings(time_offset=0.2)).time_offset("compass") == 0.2
    file.write_text("[compass]\nsigma = 2\n")
    with pytest.raises(fgloc.InputError, match=r"a\.rig\.toml: compass\.sigma is 2: input should be less than"):
        fgloc.read_rig(file)
    file.write_text("[compas]\n")
    with pytest.raises(fgloc.InputError, match="unknown key compas: did you mean compass"):
        fgloc.read_rig(file)


@pytest.mark.parametrize("format", ["csv", "parquet"])
def test_a_log_comes_back_from_its_folder(tmp_path, format):
    log = made_log()
    fgloc.write_native(log, tmp_path / "arc", format=format)
    found = fgloc.read_log(tmp_path / "arc")
    assert found.rig == log.rig
    assert not [warning for warning in found.warnings if "compass" in str(warning)]
    np.testing.assert_array_equal(found.streams["compass"].heading, log.streams["compass"].heading)
    np.testing.assert_allclose(found.streams["compass"].t, log.streams["compass"].t, atol=1e-9)


def test_a_table_of_another_program_by_a_mapping(tmp_path):
    options = (
        '[options.compass]\nfile = "kvh.csv"\nseparator = ";"\ncolumns = { t = "time", heading = "yaw" }\n'
        'units = { t = "s", heading = "deg" }\nclock_offset = 0.25\n'
    )
    tables = {"wheels": "t,v,w\n0.0,1,0\n1.0,1,0\n", "kvh": "time;yaw\n0.0;90\n0.5;-45\n"}
    stream = fgloc.read_log(write_mapped(tmp_path, VELOCITIES + options, **tables)).streams["compass"]
    np.testing.assert_allclose(stream.t, (0.25, 0.75))
    np.testing.assert_allclose(stream.heading, (math.pi / 2.0, -math.pi / 4.0))


def test_a_topic_of_a_bag_by_a_mapping(tmp_path):
    with BagMaker(tmp_path / "arc.bag") as made:
        for i, heading in enumerate((0.1, 0.2)):
            t = UNIX + i * 10**9
            made.odometry("/odom", t, (0.1 * i, 0.0, 0.0))
            vector = made.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=heading)
            made.stamped("/kvh", t, "geometry_msgs/msg/Vector3Stamped", vector=vector)
    (tmp_path / "arc.toml").write_text(
        'title = "arc"\nreader = "rosbag"\nlicence = "none"\norigin = "made"\npath = "arc.bag"\n'
        '[options.odometry]\ntopic = "/odom"\n'
        '[options.compass]\ntopic = "/kvh"\nfields = { heading = "vector.z" }\nunits = { heading = 0.5 }\n'
    )
    found = fgloc.read_log(tmp_path / "arc.toml").streams["compass"]
    np.testing.assert_allclose(found.heading, (0.05, 0.1))
    np.testing.assert_allclose(found.t, (0.0, 1.0))


def drifting_log() -> fgloc.Log:
    """Half a minute around a circle, with odometry that turns a tenth too fast and a compass of an unknown bias, 0.1 rad."""
    t = np.arange(300) / 10.0
    heading = 0.2 * t
    truth = np.column_stack((np.sin(heading) / 0.2, (1.0 - np.cos(heading)) / 0.2, se2.wrap(heading)))
    at = t[::5] + 0.03
    noise = 0.02 * np.random.default_rng(0).standard_normal(len(at))
    streams = {
        "odometry": fgloc.VelocityStream(t, np.ones(300), np.full(300, 0.22)),
        "compass": HeadingStream(at, se2.wrap(0.2 * at + 0.1 + noise)),
    }
    rig = RIG.model_copy(update={"compass": CompassSettings(uncertainty={"bias": 0.3})})
    start = fgloc.StartPose(0.0, np.zeros(3), np.full(3, 0.01))
    return fgloc.Log("circle", rig, fgloc.World(), streams, fgloc.Trajectory(t, truth), start)


@cache
def scores_without() -> dict[str, object]:
    """Those of odometry alone."""
    return fgloc.run(drifting_log(), "dead_reckoning", sensors=["odometry"]).scores


@pytest.mark.parametrize("estimator", ["ekf", "particle_filter", "smoother"])
def test_estimators_use_it_and_learn_its_bias(estimator):
    log = drifting_log()
    without = scores_without()
    run = fgloc.run(log, estimator)
    bias, sigma = run.result.learnt.values["compass.bias"]
    assert sigma < 0.05
    assert abs(bias - 0.1) < 2.0 * sigma
    assert run.scores["final.heading_rmse"] < 0.1 * without["final.heading_rmse"]
    assert run.scores["final.position_rmse"] < 0.1 * without["final.position_rmse"]
    assert run.scores["nis.compass.count"] == 60


def test_a_robot_with_two_learns_the_bias_of_each(tmp_path):
    log = drifting_log()
    first = log.streams["compass"]
    second = dataclasses.replace(first, heading=se2.wrap(first.heading - 0.3), source="compass.mast")
    streams = {
        "odometry": log.streams["odometry"],
        "compass.low": dataclasses.replace(first, source="compass.low"),
        "compass.mast": second,
    }
    rig = fgloc.Rig(
        name="cart", sensors=("odometry", "compass"), compass=dict.fromkeys(("low", "mast"), log.rig.compass)
    )
    fgloc.write_native(dataclasses.replace(log, rig=rig, streams=streams), tmp_path / "two")
    two = fgloc.read_log(tmp_path / "two")
    assert two.rig == rig
    learnt = fgloc.run(two, "ekf").result.learnt.values
    assert learnt["compass.low.bias"][0] == pytest.approx(0.1, abs=0.03)
    assert learnt["compass.mast.bias"][0] == pytest.approx(-0.2, abs=0.03)
    assert "compass.mast: the compass reports -0.198" in command("info", tmp_path / "two").stdout


def test_it_is_pushed():
    localizer = fgloc.Localizer(RIG, estimator="ekf")
    localizer.initialize((0.0, 0.0, 0.0), t=0.0)
    localizer.push(fgloc.VelocityOdometry(0.0, 1.0, 0.0))
    localizer.push(Heading(0.5, 0.1))
    assert localizer.estimate().t == 0.5
    with pytest.raises(
        fgloc.InputError, match=r"^Heading at 0\.600 s: heading is nan, expected a finite number of radians"
    ):
        localizer.push(Heading(0.6, math.nan))


def test_info_tells_of_it(tmp_path):
    fgloc.write_native(made_log(), tmp_path / "arc")
    done = command("info", tmp_path / "arc", "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["streams"]["compass"]["rows"] == 10
    assert told["rig"]["compass"]["bias"] == 0.1
    assert told["compass"]["bias"] == pytest.approx(0.1, abs=1e-6)
    assert "the compass reports 0.100 rad too much" in command("info", tmp_path / "arc").stdout


def test_a_simulated_drive_has_it():
    changes = {
        "drive": {"duration": 6.0},
        "rig": {"compass": {"bias": 0.1, "uncertainty": {"bias": 0.2}}},
        "compass": {"rate": 5.0},
    }
    logs = [fgloc.simulate("office", seed, changes=changes) for seed in (1, 1, 2)]
    assert logs[0].rig.sensors[-1] == "compass"
    assert len(logs[0].streams["compass"].t) == 30
    np.testing.assert_array_equal(*(log.streams["compass"].heading for log in logs[:2]))
    biases = [fgloc.info(log).found["compass"]["bias"] for log in logs]
    assert biases[1] != biases[2]
    assert all(abs(bias - 0.1) < 0.8 for bias in biases)


def test_it_helps_to_find_an_unknown_start():
    changes = {
        "drive": {"duration": 20.0},
        "world": {"tags": 6},
        "rig": {"compass": {"bias": 0.1, "uncertainty": {"bias": 0.05}}},
        "compass": {"rate": 2.0},
    }
    log = fgloc.simulate("office", 10, changes=changes)
    alone, together = (
        fgloc.run(log, "smoother", prior="unknown", sensors=["odometry", "rfid", *more]).scores
        for more in ([], ["compass"])
    )
    assert together["time_to_localized"] < (alone["time_to_localized"] or math.inf)
    assert together["causal.position_rmse"] < 0.5


def test_its_bias_is_calibrated(tmp_path):
    changes = {
        "drive": {"duration": 60.0},
        "world": {"landmarks": 12, "tags": 0},
        "rig": {"compass": {"bias": 0.25, "sigma": 0.02}, "sensors": ["odometry", "bearing_range"]},
    }
    log = fgloc.simulate("office", 3, changes=changes)
    streams = {name: stream for name, stream in log.streams.items() if name != "rfid"}
    rig = log.rig.model_copy(update={"rfid": None, "compass": CompassSettings(sigma=0.02)})
    given = dataclasses.replace(log, streams=streams, rig=rig)
    found = fgloc.calibrate(given, tmp_path / "a.rig.toml")
    (bias,) = (one for one in found.knowledge.constants if one.sensor == "compass")
    assert bias.fitted == pytest.approx(0.25, abs=5.0 * bias.error)
    assert bias.error < 0.01
    assert found.rig.compass.bias == (found.input_rig.compass.bias if found.refused else bias.fitted)
    assert "compass.bias [rad]" in (tmp_path / "a.report.html").read_text()
