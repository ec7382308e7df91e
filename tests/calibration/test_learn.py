"""Calibration of a simulated robot with known constants."""

from dataclasses import replace

import numpy as np
import pytest
from changed_logs import with_stream

import factorgraph_loc as fgloc
from factorgraph_loc import IncrementStream, InputError
from factorgraph_loc.calibration import learn as learning
from factorgraph_loc.calibration import report
from factorgraph_loc.calibration.calibrate import check
from factorgraph_loc.calibration.held_out import growth
from factorgraph_loc.sensors.odometry.settings import DifferentialDrive
from factorgraph_loc.sensors.smoothed import Traced
from factors import se2

WHEELS = {"scale_distance": 0.95, "scale_rotation": 1.04, "speed_bias": -0.02, "direction": 0.06}
SENSOR = {"x": 0.2, "y": -0.05, "bearing_bias": 0.02, "range_scale": 1.03, "time_offset": -0.08}


def learn(*logs):
    return learning.learn([Traced(log) for log in logs], logs[0].rig)


def constants(*logs):
    return {c.name: c for c in learn(*logs).constants}


@pytest.fixture(scope="module")
def knowledge(simulate):
    """Of one log with a fiftieth of gross outliers."""
    log = simulate(seconds=360.0, outliers=0.02, **WHEELS, **SENSOR)
    return learn(log)


@pytest.mark.parametrize(("name", "truth"), [*WHEELS.items(), *SENSOR.items()])
def test_the_constants_are_found(knowledge, name, truth):
    """Within four standard errors: less than one false alarm in 1,000 for the nine constants together.

    Gross ranges are more often too long than too short, which may move a constant by half a thousandth besides.
    """
    (result,) = (c for c in knowledge.constants if c.name == name)
    assert result.is_determined
    assert result.fitted == pytest.approx(truth, abs=4.0 * result.error + 5e-4)
    assert result.error < 0.1 * abs(truth - result.initial)


def widened(knowledge):
    """How much the noise of the landmarks is widened for correlated errors."""
    return knowledge.sensors["landmarks"].figures["noise_factor"]


def test_the_scatter_is_found_without_the_outliers(knowledge):
    sensor = knowledge.rig.bearing_range
    at_4_m = np.hypot(sensor.range_sigma, 4.0 * sensor.range_sigma_relative)
    assert at_4_m / widened(knowledge) == pytest.approx(0.03, rel=0.1)
    assert sensor.bearing_sigma / widened(knowledge) == pytest.approx(0.01, rel=0.1)


def test_white_errors_are_worth_independent_ones(knowledge, simulate):
    """Errors of a landmark that last for 3 s, as of a Gauss-Markov process, are not."""
    assert widened(knowledge) ** -2 > 0.6
    log = simulate(seconds=240.0, range_sigma=1e-6)
    sightings, rng = log.streams["bearing_range"], np.random.default_rng(3)
    errors = np.zeros(len(sightings.t))
    for name in set(sightings.landmark):
        rows = np.flatnonzero(np.array(sightings.landmark) == name)
        value, last = rng.standard_normal(), sightings.t[rows[0]]
        for row in rows.tolist():
            kept = np.exp((last - sightings.t[row]) / 3.0)
            value, last = kept * value + np.sqrt(1.0 - kept**2) * rng.standard_normal(), sightings.t[row]
            errors[row] = 0.1 * value
    with_errors = replace(
        log,
        streams={
            "odometry": log.streams["odometry"],
            "bearing_range": replace(sightings, range=sightings.range + errors),
        },
    )
    assert widened(learn(with_errors)) ** -2 < 0.3


def test_constants_that_the_robot_does_not_have_are_within_chance(simulate):
    result = constants(simulate(seconds=200.0, scale_distance=0.95))
    assert result["scale_distance"].fitted == pytest.approx(0.95, abs=0.005)
    assert all(abs(c.fitted - c.initial) < 4.0 * c.error for c in result.values() if c.name != "scale_distance")


def test_late_commands_have_a_delay(simulate):
    result = constants(simulate(seconds=200.0, delay=0.2))
    assert result["delay"].fitted + result["lag"].fitted == pytest.approx(0.2, abs=0.02)


def test_increments_have_neither_delay_nor_lag(simulate):
    log = simulate(seconds=200.0, scale_rotation=1.04)
    odometry = log.streams["odometry"]
    twists = np.column_stack((odometry.v, 0.0 * odometry.v, odometry.w)) * 0.05
    motion = se2.exp(np.vstack((np.zeros(3), twists[:-1])))
    result = constants(replace(log, streams={**log.streams, "odometry": IncrementStream(odometry.t, *motion.T)}))
    assert not {"delay", "lag"} & set(result)
    assert result["scale_rotation"].fitted == pytest.approx(1.04, abs=4.0 * result["scale_rotation"].error)


def test_gross_ranges_do_not_widen_the_noise(simulate):
    """A quarter is 5 m too long: scale and scatter are those of the others."""
    log = simulate(seconds=120.0)
    sightings, rng = log.streams["bearing_range"], np.random.default_rng(1)
    long = np.where(rng.random(len(sightings.t)) < 0.25, rng.exponential(5.0, len(sightings.t)), 0.0)
    result = learn(with_stream(log, "bearing_range", range=sightings.range + long))
    (scale,) = (c for c in result.constants if c.name == "range_scale")
    assert scale.fitted == pytest.approx(1.0, abs=4.0 * scale.error + 1e-3)
    assert result.rig.bearing_range.range_sigma / widened(result) < 0.06


@pytest.mark.parametrize(("depth", "kind"), [(True, "depth"), (False, "distance")])
def test_depths_are_told_from_distances(simulate, depth, kind):
    log = simulate(seconds=100.0, depth=depth)
    knowledge = learn(log)
    assert knowledge.rig.bearing_range.range_kind == kind
    fit = knowledge.rig.bearing_range
    scatter = np.hypot(fit.range_sigma, 4.0 * fit.range_sigma_relative)
    assert scatter / widened(knowledge) == pytest.approx(0.03, rel=0.15)


def test_what_differs_between_logs_becomes_an_uncertainty(simulate):
    logs = [simulate(seed=i, seconds=100.0, x=x) for i, x in enumerate((0.1, 0.2, 0.3))]
    knowledge = learn(*logs)
    assert knowledge.rig.bearing_range.x == pytest.approx(0.2, abs=0.02)
    assert knowledge.rig.bearing_range.uncertainty.x == pytest.approx(0.1, abs=0.02)
    assert knowledge.rig.bearing_range.uncertainty.y < 0.02


def test_without_headings_and_bearings_only_the_range_scale_is_learnt(simulate, headless):
    log = headless(simulate(seconds=60.0, range_scale=1.07, scale_distance=0.95))
    knowledge = learn(log)
    (scale,) = knowledge.constants
    assert scale.fitted == pytest.approx(1.07, abs=0.005)
    assert knowledge.rig.odometry == log.rig.odometry


def test_logs_that_do_not_go_together_are_refused(simulate, headless):
    log, second = simulate(seconds=30.0), simulate(seed=2, seconds=30.0)
    with pytest.raises(InputError, match=r"simulated-2: has no reference"):
        check([log, replace(second, reference=None)])
    with pytest.raises(InputError, match=r"simulated-2: has no bearing_range"):
        check([log, replace(second, streams={"odometry": second.streams["odometry"]})])
    with pytest.raises(InputError, match=r"only one has headings"):
        check([log, headless(second)])
    with pytest.raises(InputError, match=r"given twice"):
        check([log, log])
    odometry = second.streams["odometry"]
    increments = IncrementStream(odometry.t, odometry.v, odometry.v, odometry.w)
    with pytest.raises(
        InputError,
        match=r"simulated-2: the type of odometry is IncrementStream, but in simulated-1 it is VelocityStream: calib",
    ):
        check([log, replace(second, streams={**second.streams, "odometry": increments})])
    with pytest.raises(InputError, match=r"simulated-1: odometry and reference overlap in 14 windows"):
        learn(log)


RADIUS, TRACK = 0.1, 0.5  # m, as the log was converted


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return tmp_path_factory.mktemp("wheels") / "cart.rig.toml"


@pytest.fixture(scope="module")
def calibrated(simulate, file):
    """From two drives with wheels that are 6 % larger and 4 % further apart than in the rig."""
    logs = []
    for seed in (1, 2):
        log = simulate(seed=seed, seconds=120.0, scale_distance=1.06, scale_rotation=1.06 / 1.04)
        rig = log.rig.model_copy(update={"bearing_range": None, "sensors": ("odometry",)})
        wheels = rig.odometry.model_copy(update={"wheels": DifferentialDrive(radius=RADIUS, track=TRACK)})
        odometry = {"odometry": log.streams["odometry"]}
        logs.append(replace(log, rig=rig.model_copy(update={"odometry": wheels}), streams=odometry))
    return fgloc.calibrate(logs, file)


def test_radius_and_track_are_found(calibrated):
    wheels = report.document(calibrated)["figures"]["odometry"]
    assert wheels["radius"] == pytest.approx(1.06 * RADIUS, rel=0.01)
    assert wheels["track"] == pytest.approx(1.04 * TRACK, rel=0.015)
    assert calibrated.rig.odometry.wheels == DifferentialDrive(radius=RADIUS, track=TRACK)
    assert "radius" in report.page(calibrated)


def test_rig_and_report_are_written_once(calibrated, file):
    assert fgloc.read_rig(file).odometry == calibrated.rig.odometry
    assert file.with_name("cart.report.html").is_file()
    with pytest.raises(fgloc.InputError, match="exists already"):
        fgloc.calibrate([], file)


def test_dead_reckoning_gains_by_it(calibrated):
    assert len(calibrated.trials) == 4
    assert growth(calibrated.trials) < 0.75
    lines = report.summary(calibrated)
    assert any("odometry.scale_distance 1.0000 -> 1.0" in line for line in lines)
    assert lines[-1].endswith("times those with the input rig")


def test_a_reference_without_headings_calibrates_no_wheels(simulate, tmp_path):
    log = simulate(seconds=60.0)
    log = replace(log, streams={"odometry": log.streams["odometry"]})
    log = replace(log, reference=replace(log.reference, has_heading=False))
    with pytest.raises(fgloc.InputError, match="expected some, or headings in the reference to calibrate the wheels"):
        fgloc.calibrate(log, tmp_path / "cart.rig.toml")
