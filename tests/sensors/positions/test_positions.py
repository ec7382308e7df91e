"""Measured positions as a sensor: its factor, its runs, and positions that are wrong."""

from dataclasses import replace

import numpy as np
import pytest
from numerical import by_pose

import factorgraph_loc as fgloc
from factorgraph_loc.evaluation.inspect import inspect
from factorgraph_loc.sensors.positions.measurement import PositionSettings, PositionStream, on_map
from factors.motion import Increment
from factors.positions.factor import PositionFactor

RIG = {"position": {"x": 0.3, "y": 0.1, "sigma": 0.2}}
SENSORS = ("odometry", "position")


def drive(seed=1):
    return fgloc.simulate("office", seed, changes={"drive": {"duration": 90.0}, "rig": RIG})


@pytest.fixture(scope="module")
def log():
    return drive()


def with_positions(log, **columns):
    """The log with other columns of its positions."""
    return replace(log, streams=log.streams | {"position": replace(log.streams["position"], **columns)})


@pytest.mark.parametrize("moved", [False, True])
def test_the_jacobian_is_the_derivative(moved):
    offset = Increment(np.array((0.2, -0.1, 0.3)), np.zeros((3, 3)), 0.1) if moved else None
    covariance = np.array(((0.04, 0.01), (0.01, 0.09)))
    factor = PositionFactor(np.array((1.0, 2.0)), covariance, np.array((0.3, -0.2)), 4.0, offset)
    pose = np.array((1.3, 1.8, 0.7))
    (residual,), (jacobian,) = factor.whitened([pose])
    np.testing.assert_allclose(jacobian[0], by_pose(lambda at: factor.whitened([at])[0][0], pose), atol=1e-7)
    (error,) = factor.errors(pose[None])
    assert residual @ residual == pytest.approx(error @ np.linalg.solve(covariance, error))


@pytest.mark.parametrize("estimator", ["ekf", "particle_filter", "smoother"])
def test_estimators_are_accurate_and_consistent(estimator):
    """ANEES of three drives of 90 s, with about 30 independent errors: within 1.5 to 5 with a false-alarm rate below 1e-3."""
    runs = [fgloc.run(drive(seed), estimator, sensors=SENSORS).scores for seed in (1, 2, 3)]
    assert max(scores["causal.position_rmse"] for scores in runs) < 0.15
    assert 1.5 < np.mean([scores["causal.anees"] for scores in runs]) < 5.0


@pytest.mark.parametrize(
    ("estimator", "prior"), [("smoother", "unknown"), ("particle_filter", "unknown"), ("ekf", "position")]
)
def test_the_heading_is_estimated_from_a_stretch_of_path(log, estimator, prior):
    start = "{:.2f},{:.2f}".format(*log.reference.poses[0]) if prior == "position" else prior
    scores = fgloc.run(log, estimator, sensors=SENSORS, prior=start).scores
    assert scores["causal.position_rmse"] < 0.2
    assert scores["final.position_rmse"] < 0.1


@pytest.mark.parametrize("estimator", ["ekf", "smoother"])
def test_a_wrong_fix_of_some_seconds_is_no_new_place(log, estimator):
    stream = log.streams["position"]
    wrong = with_positions(log, x=stream.x + 50.0 * ((stream.t > 40.0) & (stream.t < 45.0)))
    scores = fgloc.run(wrong, estimator, sensors=SENSORS).scores
    assert scores["causal.position_rmse"] < 0.2


@pytest.mark.parametrize("estimator", ["smoother", "particle_filter"])
def test_a_carried_robot_is_followed(log, estimator):
    """Everything after 45 s lies 10 m away: the robot was carried there."""
    stream, after = log.streams["position"], 45.0
    reference = log.reference
    poses = reference.poses + 10.0 * (reference.t > after)[:, None] * np.array((1.0, 0.0, 0.0))
    carried = with_positions(
        replace(log, reference=replace(reference, poses=poses)), x=stream.x + 10.0 * (stream.t > after)
    )
    run = fgloc.run(carried, estimator, sensors=SENSORS)
    late = run.result.causal().t > after + 20.0
    error = run.result.causal().poses[late, :2] - carried.reference.at(run.result.causal().t[late])[:, :2]
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.3


def test_positions_that_freeze_are_not_used(log):
    stream = log.streams["position"]
    frozen = stream.t > 40.0
    first = int(np.argmax(frozen))
    still = with_positions(
        log, x=np.where(frozen, stream.x[first], stream.x), y=np.where(frozen, stream.y[first], stream.y)
    )
    run = fgloc.run(still, "ekf", sensors=SENSORS)
    assert sum(run.result.diagnostics.ignored.values()) == np.count_nonzero(frozen) - 1
    assert any(problem.kind == "repeated_positions" for problem in inspect(still).problems)


@pytest.mark.parametrize("variance", [0.0, 9999.0, 1e308, np.nan])
def test_an_implausible_variance_is_replaced_by_the_rigs(log, variance):
    count = len(log.streams["position"].t)
    stated = with_positions(log, var_x=np.full(count, variance), var_y=np.full(count, variance), cov_xy=np.zeros(count))
    expected, run = (fgloc.run(of, "ekf", sensors=SENSORS).result.causal().poses for of in (log, stated))
    np.testing.assert_array_equal(run, expected)
    kinds = [problem.kind for problem in inspect(stated).problems]
    assert ("implausible_variance" in kinds) == np.isfinite(variance)


def test_a_plausible_covariance_is_used():
    m = next(PositionStream(*np.array([[1.0], [2.0], [3.0], [0.04], [0.01], [0.09]])).measurements(0.0))
    np.testing.assert_allclose(PositionSettings().covariance(m), ((0.04, 0.01), (0.01, 0.09)))


def test_latitudes_and_longitudes_become_metres():
    """A minute of latitude is a nautical mile, 1852 m within half a per cent; one of longitude is shorter by the cosine."""
    metres = on_map(np.array(((60.0 + 1.0 / 60.0, 10.0), (60.0, 10.0 + 1.0 / 60.0))), np.array(((60.0, 10.0),)))
    np.testing.assert_allclose(metres, ((0.0, 1852.0), (926.0, 0.0)), rtol=5e-3, atol=1e-9)


def test_a_native_log_keeps_its_positions(log, tmp_path):
    fgloc.write_native(log, tmp_path / "log")
    read = fgloc.read_log(tmp_path / "log").streams["position"]
    np.testing.assert_allclose(read.x, log.streams["position"].x)
    assert np.isnan(read.var_x).all()


def test_headings_of_a_system_that_has_none_are_ignored(log, tmp_path):
    poses = log.reference.poses * np.array((1.0, 1.0, 0.0))
    fgloc.write_native(replace(log, reference=replace(log.reference, poses=poses)), tmp_path / "log")
    read = fgloc.read_log(tmp_path / "log")
    assert not read.reference.has_heading
    assert "false_headings" in [warning.kind for warning in read.warnings]


def test_two_points_of_a_robot_have_their_own_mounting(tmp_path):
    tags = {"front": {"x": 0.4, "sigma": 0.1}, "rear": {"x": -0.4, "sigma": 0.1}}
    log = fgloc.simulate("office", 1, changes={"drive": {"duration": 60.0}, "rig": {"position": tags}})
    fgloc.write_native(log, tmp_path / "log")
    log = fgloc.read_log(tmp_path / "log")
    sensors = ("odometry", "position")
    both = fgloc.run(log, "ekf", sensors=sensors).scores
    one = fgloc.run(log, "ekf", sensors=("odometry", "position.front")).scores
    assert both["causal.heading_rmse"] < one["causal.heading_rmse"]
    assert both["causal.position_rmse"] < one["causal.position_rmse"]
    assert 1.5 < both["causal.anees"] < 5.0
    assert fgloc.run(log, "smoother", sensors=sensors, prior="unknown").scores["final.position_rmse"] < 0.1
