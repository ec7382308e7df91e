"""The landmark sensor: prediction, Jacobians, the compiled twin, agreement with GTSAM's factors."""

import gtsam
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numerical import by_each

from factors import positive, se2
from factors.graph import jacobian_factors
from factors.landmarks.factor import BearingRangeFactor
from factors.landmarks.kernels import linearize_each
from factors.landmarks.model import (
    CONSTANTS,
    POINT,
    WIDTH,
    BearingRangeModel,
    located,
    log_likelihood,
    predict,
    recalibrated,
    residuals,
    sigmas,
    whitened_into,
)
from factors.robust import geman_mcclure_loss, geman_mcclure_weight

place = st.floats(-8.0, 8.0)
poses = st.tuples(place, place, st.floats(-3.1, 3.1)).map(np.array)
points = st.tuples(place, place).map(np.array)
models = st.builds(
    BearingRangeModel,
    mounting=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-3.0, 3.0)),
    range_scale=st.floats(0.8, 1.2),
    range_sigma=st.floats(0.05, 0.5),
    range_sigma_relative=st.floats(0.0, 0.3),
    bearing_bias=st.floats(-0.2, 0.2),
    bearing_sigma=st.floats(0.01, 0.2),
    robust=st.floats(0.5, 5.0),
    depth=st.booleans(),
    depth_axis=st.floats(-0.3, 0.3),
)


def apart(model, pose, point):
    """Not at the sensor itself, where bearing has no derivative, nor where it wraps."""
    _, bearing = predict(model, pose, point)
    distance = np.hypot(*se2.transform_to(se2.compose(pose, np.array(model.mounting)), point))
    return distance > 0.3 and abs(bearing) < 3.0


def whitened(model, pose, seen, ranges, bearings):
    """Whitened residuals (K, 2) and their Jacobian by pose, points and constants, by compiled code."""
    noise = model.range_sigma, model.range_sigma_relative, model.bearing_bias, model.bearing_sigma
    known = model.mounting, (model.range_scale, *noise), model.depth, model.depth_axis
    found = np.zeros((len(seen), 2)), np.zeros((len(seen), 2, WIDTH))
    whitened_into(pose, *known, seen, ranges, bearings, *found)
    return found


def test_prediction_by_hand():
    model = BearingRangeModel(mounting=(1.0, 0.0, np.pi / 2), range_scale=2.0, bearing_bias=0.1)
    distance, bearing = predict(model, np.array((0.0, 0.0, np.pi / 2)), np.array((-3.0, 1.0)))
    assert distance == pytest.approx(6.0)
    assert bearing == pytest.approx(0.1)


@given(models, poses, points)
def test_jacobians_are_the_numerical_ones(model, pose, point):
    assume(apart(model, pose, point))
    seen = point[None], *(np.array([value]) for value in predict(model, pose, point))
    error, jacobian = whitened(model, pose, *seen)
    sigma = sigmas(model, seen[1])[0]
    by_pose, by_point, by_sensor = np.split(sigma[:, None] * jacobian[0], (POINT, CONSTANTS), axis=1)
    np.testing.assert_allclose(error, 0.0, atol=1e-8)
    expected = by_each(lambda v: np.array(predict(recalibrated(model, v[2]), *v[:2])), [pose, point, np.zeros(6)])
    for found, numerical in zip((by_pose, by_point, by_sensor), expected, strict=True):
        np.testing.assert_allclose(found, numerical, atol=1e-5)


@given(models, poses, st.integers(0, 10_000))
def test_the_compiled_function_gives_what_its_plain_twins_give(model, pose, seed):
    rng = np.random.default_rng(seed)
    seen = rng.uniform(-8.0, 8.0, (4, 2))
    ranges, bearings = rng.uniform(0.2, 9.0, 4), rng.uniform(-3.1, 3.1, 4)
    ranges[1] = bearings[2] = np.nan
    assume(all(apart(model, pose, p) for p in seen))
    error, jacobian = whitened(model, pose, seen, ranges, bearings)
    each = linearize_each(model.packed, np.tile(pose, (4, 1)), seen, ranges, bearings)
    np.testing.assert_allclose(error, residuals(model, pose, seen, ranges, bearings), atol=1e-8)
    assert not jacobian[1, 0].any()
    assert not jacobian[2, 1].any()
    for found, by_itself in zip((error, jacobian), each, strict=True):
        np.testing.assert_allclose(found, by_itself, rtol=1e-12, atol=1e-12)


def test_depth_is_the_distance_along_the_axis():
    model = BearingRangeModel(depth=True, depth_axis=np.pi / 2, range_scale=1.1)
    depth, bearing = predict(model, np.zeros(3), np.array((3.0, 2.0)))
    assert depth == pytest.approx(2.2)
    assert bearing == pytest.approx(np.arctan2(2.0, 3.0))


@given(models, st.integers(0, 10_000))
def test_what_is_located_is_what_was_seen(model, seed):
    rng = np.random.default_rng(seed)
    directions, distances = rng.uniform(-0.8, 0.8, 5), rng.uniform(0.5, 9.0, 5)
    local = np.column_stack((distances * np.cos(directions), distances * np.sin(directions)))
    seen = se2.transform_from(np.array(model.mounting), local)
    ranges, bearings = predict(model, np.zeros(3), seen)
    np.testing.assert_allclose(located(model, ranges, bearings), seen, atol=1e-9)


@given(models, poses, st.integers(0, 10_000), st.booleans())
def test_jacobians_of_the_factor_by_all_values_are_the_numerical_ones(model, pose, seed, displaced):
    rng = np.random.default_rng(seed)
    offset = np.array((0.1, 0.02, 0.1)) if displaced else None
    point = rng.uniform(-8.0, 8.0, 2)
    at = pose if offset is None else se2.compose(pose, offset)
    assume(apart(model, at, point))
    measured = [value + rng.normal(0.0, 0.01) for value in predict(model, at, point)]
    factor = BearingRangeFactor(
        model,
        np.zeros((1, 2)),
        np.array([measured[0]]),
        np.array([measured[1]]),
        offset,
        estimated=(0, 2, 3, 4, 5),
        free=True,
        biased=True,
        twist=np.array((0.3, 0.01, 0.2)),
    )
    values = [pose, np.zeros(5), np.array([0.01]), point]
    _, blocks = factor.whitened(values)
    for block, numerical in zip(blocks, by_each(lambda v: factor.whitened(v)[0], values), strict=True):
        np.testing.assert_allclose(block, numerical, rtol=1e-3, atol=2e-3)


@given(models, poses, st.integers(0, 10_000))
def test_a_located_landmark_has_the_spread_of_its_pose_and_noise(model, pose, seed):
    rng = np.random.default_rng(seed)
    sensor = se2.compose(pose, np.array(model.mounting))
    point = se2.transform_from(sensor, np.array((3.0, rng.uniform(-1.0, 1.0))))
    assume(apart(model, pose, point))
    measured = predict(model, pose, point)
    factor = BearingRangeFactor(
        model, np.zeros((1, 2)), np.array([measured[0]]), np.array([measured[1]]), estimated=(2,), free=True
    )
    located_at, blocks, noise = factor.locate([pose, np.zeros(1)])
    np.testing.assert_allclose(located_at, point, atol=1e-9)
    assert np.all(np.linalg.eigvalsh(noise) > 0.0)
    numerical = by_each(lambda v: factor.locate(v)[0], [pose, np.zeros(1)])
    for block, expected in zip(blocks, numerical, strict=True):
        np.testing.assert_allclose(block, expected, atol=1e-3)


@pytest.mark.parametrize("split", [False, True])
@pytest.mark.parametrize(("around", "most"), [(0.001, 1.01), (np.pi, 1.5)])
def test_landmarks_of_one_look_do_not_average_the_odometry_error_away(split, around, most):
    """Twenty landmarks, seen 0.1 m of odometry error after the keyframe, cannot place it any better than that.

    Close together they tell what their joint covariance says; in different directions they may tell less, but never more.
    """
    angles = np.linspace(-around, around, 20, endpoint=False)
    ring = 5.0 * np.column_stack((np.cos(angles), np.sin(angles)))
    model = BearingRangeModel(range_sigma=0.05, bearing_sigma=0.01, robust=100.0)
    offset, noise = np.array((0.5, 0.0, 0.0)), np.diag((0.1, 0.1, 0.02)) ** 2
    ranges, bearings = predict(model, offset, ring)
    rows = [[i] for i in range(20)] if split else [list(range(20))]
    information = prior = np.linalg.inv(np.diag((3.0, 3.0, 0.001)) ** 2)
    for i in rows:
        seen = ring[i], ranges[i], bearings[i]
        factor = BearingRangeFactor(model, *seen, offset, noise, simultaneous=20 if split else None)
        _, (jacobian,) = factor.linearize([np.zeros(3)])
        information = information + jacobian.T @ jacobian
    # by the joint covariance of all forty values: the error of the odometry is one
    stacked = whitened(model, offset, ring, ranges, bearings)[1][..., :POINT].reshape(-1, 3)
    stacked_back = stacked @ se2.adjoint(se2.inverse(offset))
    told = stacked_back.T @ np.linalg.inv(np.eye(40) + stacked @ noise @ stacked.T) @ stacked_back
    exact = np.sqrt(np.diag(np.linalg.inv(prior + told)))
    found = np.sqrt(np.diag(np.linalg.inv(information)))
    assert exact[0] == pytest.approx(0.1, rel=0.05)
    assert np.all(found >= 0.999 * exact)
    assert np.all(found <= most * exact)


@given(poses, points)
def test_residuals_are_those_of_gtsams_factors(pose, point):
    model = BearingRangeModel(range_sigma=0.3, bearing_sigma=0.05)
    assume(apart(model, pose, point))
    values = gtsam.Values()
    values.insert(0, gtsam.Pose2(*pose))
    values.insert(1, point)
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array((0.05, 0.3)))
    theirs = gtsam.BearingRangeFactor2D(0, 1, gtsam.Rot2(0.4), 3.0, noise).error(values)
    error = residuals(model, pose, point[None], np.array([3.0]), np.array([0.4]))
    assert 0.5 * np.sum(error**2) == pytest.approx(theirs, rel=1e-6, abs=1e-9)


@given(st.floats(0.0, 100.0), st.floats(0.5, 5.0))
def test_the_weight_is_the_slope_of_the_loss(squared, scale):
    step = 1e-5
    slope = (geman_mcclure_loss(squared + step, scale) - geman_mcclure_loss(max(squared - step, 0.0), scale)) / (
        squared + step - max(squared - step, 0.0)
    )
    assert 2.0 * slope == pytest.approx(float(geman_mcclure_weight(np.array(squared), scale)), rel=1e-3)


@given(models, st.integers(0, 10_000))
def test_each_particle_has_the_likelihood_of_its_own_sensor(model, seed):
    rng = np.random.default_rng(seed)
    seen, particles = rng.uniform(-8.0, 8.0, (3, 2)), rng.uniform(-3.0, 3.0, (4, 3))
    ranges, bearings = rng.uniform(0.2, 9.0, 3), rng.uniform(-3.1, 3.1, 3)
    ranges[1] = bearings[2] = np.nan
    changes = 0.1 * rng.standard_normal((4, 6))
    expected = []
    for particle, change in zip(particles, changes, strict=True):
        error = residuals(recalibrated(model, change), particle, seen, ranges, bearings)
        expected.append(-np.sum(geman_mcclure_loss(np.sum(error**2, axis=-1), model.robust)))
    found = log_likelihood(model, particles, seen, ranges, bearings, changes)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)


@given(models, st.integers(0, 10_000))
def test_the_likelihood_of_particles_knows_how_sure_the_map_is(model, seed):
    rng = np.random.default_rng(seed)
    seen, particles = rng.uniform(-8.0, 8.0, (4, 2)), rng.uniform(-3.0, 3.0, (3, 3))
    ranges, bearings = rng.uniform(0.2, 9.0, 4), rng.uniform(-3.1, 3.1, 4)
    ranges[1] = bearings[2] = np.nan
    roots = rng.normal(size=(4, 2, 2))
    spreads = roots @ roots.transpose(0, 2, 1)
    spreads[3] = 0.0
    expected = []
    for particle in particles:
        error = residuals(model, particle, seen, ranges, bearings)
        by_point = whitened(model, particle, seen, ranges, bearings)[1][..., POINT:CONSTANTS]
        noise = np.eye(2) + by_point @ spreads @ by_point.transpose(0, 2, 1)
        squared = np.einsum("ki,kij,kj->k", error, np.linalg.inv(noise), error)
        expected.append(-np.sum(geman_mcclure_loss(squared, model.robust) + 0.5 * np.linalg.slogdet(noise)[1]))
    found = log_likelihood(model, particles, seen, ranges, bearings, None, spreads)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize(("rows", "x", "why"), [(2, np.nan, "not finite"), (4, 0.0, "shapes")])
def test_a_factor_that_fails_is_silent_and_says_so(rows, x, why):
    factor = BearingRangeFactor(BearingRangeModel(), np.array(((1.0, 2.0),)), np.array((2.0,)), np.array((0.1,)))
    failures: list[str] = []
    (linear,) = jacobian_factors([(factor, (7,), rows)], {7: np.array((x, 0.0, 0.0))}, failures.append)
    block, residual = linear.jacobian()
    assert (residual.shape, block.shape) == ((rows,), (rows, 3))
    assert not residual.any()
    assert not block.any()
    assert why in failures[0]


@pytest.mark.parametrize("distance", [0.0, 1e-12, 1e-3])
def test_a_landmark_where_the_sensor_is_has_a_place_and_a_spread(distance):
    model = BearingRangeModel(bearing_sigma=0.02)
    factor = BearingRangeFactor(model, np.zeros((1, 2)), np.array([distance]), np.zeros(1))
    point, blocks, spread = factor.locate([np.zeros(3)])
    assert np.hypot(*point) == pytest.approx(distance)
    assert np.all(np.isfinite(blocks[0]))
    assert np.all(np.linalg.eigvalsh(spread) > 0.0)


def test_landmarks_beyond_a_gate_are_counted_by_their_own_innovations():
    rng = np.random.default_rng(3)
    pose, covariance = np.array((0.1, -0.2, 0.4)), np.diag((0.1, 0.2, 0.1)) ** 2
    points = 4.0 * rng.standard_normal((20, 2))
    ranges, bearings = predict(BearingRangeModel(), pose, points)
    factor = BearingRangeFactor(BearingRangeModel(), points, ranges + 0.3 * rng.standard_normal(20), bearings + 0.1)
    residual, (jacobian,) = factor.whitened([pose])
    squared = positive.squared(residual, np.eye(2) + jacobian @ covariance @ jacobian.transpose(0, 2, 1))
    limit = float(np.median(squared))
    assert factor.count_beyond(limit, pose, covariance) == np.count_nonzero(squared > limit) == 10
