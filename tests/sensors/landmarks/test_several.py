"""Several sensors of landmarks on a robot: each has its own mounting and noise, in a rig, a log, a run and a calibration."""

import re
from dataclasses import replace

import numpy as np
import pytest
import tomli_w
from refusal import refusal

import factorgraph_loc as fgloc
from factorgraph_loc import BearingRange, Localizer, Rig
from factorgraph_loc.calibration.learn import learn
from factorgraph_loc.evaluation.inspect import inspect
from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.io.native.native import write_native
from factorgraph_loc.io.native.rig_file import read_rig, rig_text
from factorgraph_loc.model.measurement import of_sensor, selected
from factorgraph_loc.sensors.interfaces import marks
from factorgraph_loc.sensors.smoothed import Traced
from factorgraph_loc.simulation.settings import named_settings

LEFT, RIGHT = "bearing_range.left", "bearing_range.right"
RADIOS = {"left": {"x": 0.1, "y": 0.3, "range_sigma": 0.1}, "right": {"x": -0.2, "y": -0.3, "range_sigma": 0.1}}
CAMERAS = {
    "front": {"x": 0.3, "range_sigma": 0.1, "bearing_sigma": 0.02},
    "rear": {"x": -0.3, "heading": np.pi, "range_sigma": 0.1, "bearing_sigma": 0.02},
}


def rig_of(sensors):
    return Rig(name="r", odometry=named_settings("office").rig.odometry, bearing_range=sensors)


def drive(sensors, seed=1, view=6.3, rate=5.0, seconds=60.0):
    """A drive among landmarks with one sensor or several, within ``view`` [rad] of each."""
    changes = {
        "world": {"tags": 0, "landmarks": 12},
        "drive": {"duration": seconds},
        "sightings": {"rate": rate, "field_of_view": view, "max_range": 12.0},
    }
    office = named_settings("office", changes)
    rig = rig_of(sensors)
    log = fgloc.simulate(office.model_copy(update={"rig": rig.model_copy(update={"rfid": office.rig.rfid})}), seed)
    return replace(log, rig=rig, streams={name: stream for name, stream in log.streams.items() if name != "rfid"})


def without_bearings(log, kind="bearing_range"):
    silent = {
        name: replace(stream, bearing=np.full_like(stream.bearing, np.nan))
        for name, stream in log.streams.items()
        if name.startswith(kind)
    }
    return replace(log, streams={**log.streams, **silent})


def figures(logs, estimator="ekf"):
    """Position error [m] and ANEES over several drives."""
    scores = [score(run(log, RunConfig(estimator)), log) for log in logs]
    return np.mean([[s["causal.position_rmse"], s["causal.anees"]] for s in scores], axis=0)


@pytest.mark.parametrize("estimator", ["ekf", "smoother"])
@pytest.mark.parametrize(("sensors", "view"), [(RADIOS, 6.3), (CAMERAS, 1.5)], ids=["radios", "cameras"])
def test_two_sensors_are_as_good_as_one_with_all_rows(sensors, view, estimator):
    seeds = (1, 3, 5, 6)
    two = [drive(sensors, seed, view) for seed in seeds]
    one = [drive(sensor, seed, view, rate=10.0) for seed in seeds for sensor in sensors.values()]
    if sensors is RADIOS:
        two, one = ([without_bearings(log) for log in logs] for logs in (two, one))
    error, anees = figures(two, estimator)
    assert error < 1.1 * figures(one, estimator)[0]
    assert 1.5 < anees < 4.5


def test_radios_and_markers_have_noise_of_their_own():
    markers = {"range_sigma": 0.1, "bearing_sigma": 0.02, "x": 0.3}
    log = drive({"uwb": {"range_sigma": 0.3}, "markers": markers})
    log = without_bearings(log, "bearing_range.uwb")
    result = run(log, RunConfig("ekf"))
    residuals = result.diagnostics.residuals
    assert set(residuals) == {"bearing_range.uwb.range", "bearing_range.uwb.bearing"} | {
        "bearing_range.markers.range",
        "bearing_range.markers.bearing",
    }
    assert np.std(residuals["bearing_range.uwb.range"]) > 2.0 * np.std(residuals["bearing_range.markers.range"])
    assert 1.5 < score(result, log)["causal.anees"] < 4.5
    both = figures([log])[0]
    alone = run(log, RunConfig("ekf", sensors=("odometry", "bearing_range.uwb")))
    assert both < score(alone, log)["causal.position_rmse"]
    assert (
        run(log, RunConfig("ekf", sensors=("odometry", "bearing_range"))).config["sensors"] == result.config["sensors"]
    )


@pytest.mark.parametrize("seed", range(5))
def test_a_sensor_that_is_split_gives_the_same_estimate(seed):
    log = drive(RADIOS["left"], seed, seconds=20.0)
    stream = log.streams["bearing_range"]
    stamps, of_stamp = np.unique(stream.t, return_inverse=True)
    is_left = (np.random.default_rng(seed).random(len(stamps)) < 0.5)[of_stamp]
    parts = {name: of_sensor(selected(stream, rows), name) for name, rows in ((LEFT, is_left), (RIGHT, ~is_left))}
    rig = log.rig.model_copy(update={"bearing_range": dict.fromkeys(("left", "right"), log.rig.bearing_range)})
    rig = rig.model_copy(update={"sensors": rig.expanded(log.rig.sensors)})
    split = replace(log, rig=rig, streams={"odometry": log.streams["odometry"], **parts})
    config = RunConfig("ekf")
    np.testing.assert_allclose(run(split, config).final.poses, run(log, config).final.poses, atol=1e-9)


def test_sensors_share_the_landmarks_that_a_map_lacks():
    log = drive(CAMERAS, seconds=30.0)
    learnt = run(log, RunConfig("smoother", settings={"landmarks": "unknown"})).learnt.landmarks
    places = {name: (mark.x, mark.y) for name, mark in log.world.landmarks.items()}
    assert len(learnt) > 5
    for name, point in learnt.items():
        assert np.hypot(*(point.position - places[name])) < 0.5


def test_each_learns_constants_of_its_own():
    uncertain = {name: {**settings, "x": 0.0, "uncertainty": {"x": 0.3}} for name, settings in RADIOS.items()}
    log = drive(RADIOS)
    log = replace(log, rig=rig_of(uncertain))
    learnt = run(log, RunConfig("ekf")).learnt.values
    assert learnt[f"{LEFT}.x"][0] == pytest.approx(0.1, abs=0.05)
    assert learnt[f"{RIGHT}.x"][0] == pytest.approx(-0.2, abs=0.05)


def test_each_is_calibrated_by_itself():
    log = drive(RADIOS, seconds=120.0)
    start = rig_of({name: {"range_sigma": 0.2} for name in RADIOS})
    knowledge = learn([Traced(log)], start)
    for name, truth in RADIOS.items():
        settings = knowledge.rig.section(f"bearing_range.{name}")
        assert (settings.x, settings.y) == pytest.approx((truth["x"], truth["y"]), abs=0.04)
        assert settings.range_sigma == pytest.approx(0.1, rel=0.4)
    assert {constant.sensor for constant in knowledge.constants} >= {LEFT, RIGHT}


def test_a_log_has_a_table_for_each(tmp_path):
    log = drive(RADIOS, seconds=10.0)
    write_native(log, tmp_path / "log")
    assert {f"{LEFT}.csv", f"{RIGHT}.csv"} <= {file.name for file in (tmp_path / "log").iterdir()}
    again = fgloc.read_log(tmp_path / "log")
    assert again.rig == log.rig
    assert again.rig.sensors == ("odometry", LEFT, RIGHT)
    assert [m.source for m in again.measurements([LEFT])] == [m.source for m in log.measurements([LEFT])]
    np.testing.assert_array_equal(again.streams[RIGHT].range, log.streams[RIGHT].range)
    text = rig_text(log.rig)
    assert "[bearing_range.left]" in text
    assert "y = 0.3  # position of the sensor on the robot, to the left [m]" in text
    (tmp_path / "r.rig.toml").write_text(text)
    assert read_rig(tmp_path / "r.rig.toml") == log.rig


def test_what_a_rig_lacks_is_left_out_with_a_warning(tmp_path):
    log = drive(RADIOS, seconds=10.0)
    rig = rig_of({"left": RADIOS["left"]})
    result = run(replace(log, rig=rig), RunConfig("ekf"))
    assert f"{RIGHT} not used, because the rig r has no [{RIGHT}]" in " ".join(map(str, result.warnings))
    assert result.config["sensors"] == ["odometry", LEFT]
    refusal(
        lambda: run(replace(log, rig=rig), RunConfig("ekf", sensors=("odometry", RIGHT))),
        f"{RIGHT} needs [{RIGHT}] in the rig",
    )
    write_native(log, tmp_path / "log")
    (run_file := tmp_path / "log" / "run.toml").write_text(re.sub("^rig = .*", "", run_file.read_text(), flags=re.M))
    assert fgloc.read_log(tmp_path / "log").rig.sensors == ("odometry", LEFT, RIGHT)


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ({"left": {"range_sigma": 100.0}}, "bearing_range.left.range_sigma is 100"),
        ({"left": {"range_sgima": 0.1}}, "unknown key bearing_range.left.range_sgima: did you mean range_sigma?"),
        ({"range_sigma": 0.1, "front": {}}, "has settings and named tables (front), expected one of the two"),
        ({"range_sigma": 0.1, "uncertanty": {}}, "unknown key bearing_range.uncertanty: did you mean uncertainty?"),
        ({"a b": {"range_sigma": 0.1}}, "'a b' is no name, expected letters, digits, _ and -"),
        ({"a.b": {"range_sigma": 0.1}}, "'a.b' is no name"),
        ({"a": {"range_sigma": 0.1}, "A": {"range_sigma": 0.1}}, "differ only in capital letters"),
        ({"left": {}}, "bearing_range.left.range_sigma is missing"),
    ],
)
def test_unusable_tables_in_a_rig(tmp_path, tables, words):
    file = tmp_path / "r.rig.toml"
    file.write_text(tomli_w.dumps({"bearing_range": tables}))
    refusal(lambda: read_rig(file), "r.rig.toml", words)


def test_pushed_measurements_have_the_name_of_their_sensor():
    log = drive(RADIOS, seconds=20.0)
    localizer = Localizer(log.rig, log.world, "ekf")
    localizer.initialize(log.start.pose, np.diag(np.square(log.start.sigmas)), 0.0)
    for m in log.measurements(log.rig.sensors):
        localizer.push(m)
    result = run(log, RunConfig("ekf", prior="log"))
    np.testing.assert_allclose(localizer.estimate().pose, result.final.poses[-1], atol=1e-6)
    seen = BearingRange(21.0, ("1",), np.array([1.0]), np.array([0.0]), source="bearing_range.rear")
    localizer.push(seen)
    localizer.push(replace(seen, source="bearing_range"))
    ignored = localizer.diagnostics().ignored
    assert ignored["bearing_range.rear is not among the sensors"] == 1
    assert ignored["bearing_range is not among the sensors"] == 1


def test_problems_of_each_and_what_none_detects():
    log = drive(CAMERAS, view=0.5, seconds=10.0)
    seen = {name: set(log.streams[f"bearing_range.{name}"].landmark) for name in CAMERAS}
    nowhere = set(log.world.landmarks) - seen["front"] - seen["rear"]
    inspection = inspect(log)
    unseen = {line.split()[1] for line in map(str, inspection.problems) if line.endswith("is never seen")}
    assert unseen == nowhere
    assert set(inspection.found["bearing_range.front"]["unseen"]) == set(log.world.landmarks) - seen["front"]
    (layer,) = [layer for layer in marks(log) if layer.layer == "landmarks"]
    assert len(layer.t) == sum(len(log.streams[f"bearing_range.{name}"].t) for name in CAMERAS)
