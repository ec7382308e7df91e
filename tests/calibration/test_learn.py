"""What is learnt of a robot whose constants are known."""

from dataclasses import replace

import numpy as np
import pytest

from factorgraph_loc.calibration.calibrate import check
from factorgraph_loc.calibration.learn import learn
from factorgraph_loc.errors import InputError
from factorgraph_loc.sensors.landmarks.calibrator import correlation, sightings_of
from factorgraph_loc.sensors.odometry.measurement import IncrementStream
from factors import se2

WHEELS = {"scale_distance": 0.95, "scale_rotation": 1.04, "speed_bias": -0.02, "direction": 0.06}
SENSOR = {"x": 0.2, "y": -0.05, "bearing_bias": 0.02, "range_scale": 1.03, "time_offset": -0.08}


@pytest.fixture(scope="module")
def knowledge(simulate):
    """Of one log with a fiftieth of gross outliers."""
    log = simulate(seconds=240.0, outliers=0.02, **WHEELS, **SENSOR)
    return learn([log], log.rig)


@pytest.mark.parametrize(("name", "truth"), [*WHEELS.items(), *SENSOR.items()])
def test_the_constants_are_found(knowledge, name, truth):
    """Within four standard errors: less than one false alarm in 1,000 for the nine constants together.

    Gross ranges are more often too long than too short, which may move a constant by half a thousandth besides.
    """
    (found,) = (c for c in knowledge.constants if c.name == name)
    assert found.kept
    assert found.fitted == pytest.approx(truth, abs=4.0 * found.error + 5e-4)
    assert found.error < 0.1 * abs(truth - found.before)


def test_the_scatter_is_found_without_the_outliers(knowledge):
    sensor = knowledge.rig.bearing_range
    at_4_m = np.hypot(sensor.range_sigma, 4.0 * sensor.range_sigma_relative)
    assert at_4_m == pytest.approx(0.03, rel=0.1)
    assert sensor.bearing_sigma == pytest.approx(0.01, rel=0.1)


def test_white_errors_have_no_correlation(knowledge):
    """The correlation of 7,000 pairs has a standard error of 0.012: 0.06 are five of them."""
    (correlation,) = knowledge.details["landmarks"]
    np.testing.assert_allclose(correlation.next_one, 0.0, atol=0.06)


def test_errors_that_last_for_seconds_have_their_correlation(simulate):
    """Of a Gauss-Markov process with a time constant of 3 s: exp(-lag / 3 s) within .15, some five standard errors."""
    log = simulate(seconds=240.0, range_sigma=1e-6)
    seen, rng = log.streams["bearing_range"], np.random.default_rng(3)
    errors = np.zeros(len(seen.t))
    for name in set(seen.landmark):
        rows = np.flatnonzero(np.array(seen.landmark) == name)
        value, before = rng.standard_normal(), seen.t[rows[0]]
        for row in rows.tolist():
            kept = np.exp((before - seen.t[row]) / 3.0)
            value, before = kept * value + np.sqrt(1.0 - kept**2) * rng.standard_normal(), seen.t[row]
            errors[row] = 0.1 * value
    one = replace(log, streams={**log.streams, "bearing_range": replace(seen, range=seen.range + errors)})
    found = correlation(sightings_of(one), log.rig.bearing_range.model_copy(update={"range_sigma": 0.1}))
    known = (found.lags < 6.0) & np.isfinite(found.function[:, 0])
    assert np.count_nonzero(known) >= 4
    np.testing.assert_allclose(found.function[known, 0], np.exp(-found.lags[known] / 3.0), atol=0.15)
    assert found.time[0] == pytest.approx(3.0, rel=0.3)


def test_a_constant_that_the_robot_does_not_have_is_not_kept(simulate):
    """A false constant passes only if it helps in three of five stretches; a speed bias, besides, only if it helps at rest."""
    log = simulate(seconds=200.0, scale_distance=0.95)
    constants = {c.name: c for c in learn([log], log.rig).constants}
    assert constants["scale_distance"].kept
    assert not constants["speed_bias"].kept
    assert not constants["heading_rate_bias"].kept
    assert all(abs(c.value - c.before) < 4.0 * c.error for c in constants.values() if c.name != "scale_distance")


def test_late_commands_have_a_delay(simulate):
    log = simulate(seconds=200.0, delay=0.2)
    constants = {c.name: c for c in learn([log], log.rig).constants}
    assert constants["delay"].value + constants["lag"].value == pytest.approx(0.2, abs=0.02)


def test_increments_have_neither_delay_nor_lag(simulate):
    log = simulate(seconds=200.0, scale_rotation=1.04)
    odometry = log.streams["odometry"]
    twists = np.column_stack((odometry.v, 0.0 * odometry.v, odometry.w)) * 0.05
    motion = se2.exp(np.vstack((np.zeros(3), twists[:-1])))
    increments = replace(log, streams={**log.streams, "odometry": IncrementStream(odometry.t, *motion.T)})
    constants = {c.name: c for c in learn([increments], log.rig).constants}
    assert "delay" not in constants
    assert "lag" not in constants
    assert constants["scale_rotation"].fitted == pytest.approx(1.04, abs=4.0 * constants["scale_rotation"].error)


@pytest.mark.parametrize(("depth", "kind"), [(True, "depth"), (False, "distance")])
def test_depths_are_told_from_distances(simulate, depth, kind):
    log = simulate(seconds=100.0, depth=depth)
    knowledge = learn([log], log.rig)
    assert knowledge.rig.bearing_range.range_kind == kind
    assert any("fit better as the depth" in note for note in knowledge.notes) == depth
    scatter = np.hypot(knowledge.rig.bearing_range.range_sigma, 4.0 * knowledge.rig.bearing_range.range_sigma_relative)
    assert scatter == pytest.approx(0.03, rel=0.15)


def test_what_differs_between_logs_becomes_an_uncertainty(simulate):
    logs = [simulate(seed=i, seconds=100.0, x=x) for i, x in enumerate((0.1, 0.2, 0.3))]
    knowledge = learn(logs, logs[0].rig)
    assert knowledge.rig.bearing_range.x == pytest.approx(0.2, abs=0.02)
    assert knowledge.rig.bearing_range.uncertainty.x == pytest.approx(0.1, abs=0.02)
    assert knowledge.rig.bearing_range.uncertainty.y < 0.02


def test_without_headings_and_bearings_only_the_range_scale_is_learnt(simulate, headless):
    log = headless(simulate(seconds=60.0, range_scale=1.07, scale_distance=0.95))
    knowledge = learn([log], log.rig)
    (scale,) = knowledge.constants
    assert scale.value == pytest.approx(1.07, abs=0.005)
    assert knowledge.rig.odometry == log.rig.odometry
    assert knowledge.rig.bearing_range.bearing_sigma == log.rig.bearing_range.bearing_sigma
    assert any("no headings" in note for note in knowledge.notes)


def test_logs_that_do_not_go_together_are_refused(simulate, headless):
    log, other = simulate(seconds=30.0), simulate(seed=2, seconds=30.0)
    with pytest.raises(InputError, match=r"simulated-2: has no reference"):
        check([log, replace(other, reference=None)])
    with pytest.raises(InputError, match=r"simulated-2: has no bearing_range"):
        check([log, replace(other, streams={"odometry": other.streams["odometry"]})])
    with pytest.raises(InputError, match=r"only one has headings"):
        check([log, headless(other)])
    with pytest.raises(InputError, match=r"given twice"):
        check([log, log])
    odometry = other.streams["odometry"]
    increments = IncrementStream(odometry.t, odometry.v, odometry.v, odometry.w)
    with pytest.raises(InputError, match=r"simulated-2: its odometry has increments, that of simulated-1 velocities"):
        check([log, replace(other, streams={**other.streams, "odometry": increments})])
    with pytest.raises(InputError, match=r"simulated-1: odometry and reference overlap in 14 windows"):
        learn([log], log.rig)
