"""The camera: agreement with GTSAM's camera and factor, Jacobians, what lies behind it, its noise."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numerical import by_each, by_pose, derivative

from factors import se2
from factors.camera import model as reprojection
from factors.camera.factor import ReprojectionFactor
from factors.camera.model import (
    FORWARD,
    PARAMETERS,
    TIME_OFFSET,
    CameraModel,
    by_tilt,
    camera_pose,
    carrier,
    in_camera,
    linearize,
    linearize_in_space,
    log_likelihood,
    mounted,
    mounting,
    predict,
    recalibrated,
)
from factors.robust import huber_loss, huber_weight

turn = st.floats(-0.5, 0.5)
offset = st.floats(-0.5, 0.5)
models = st.builds(
    CameraModel,
    fx=st.floats(300.0, 800.0),
    fy=st.floats(300.0, 800.0),
    cx=st.floats(300.0, 340.0),
    cy=st.floats(220.0, 260.0),
    width=st.just(640),
    height=st.just(480),
    distortion=st.tuples(
        st.floats(-0.15, 0.15), st.floats(-0.02, 0.02), st.floats(-0.005, 0.005), st.floats(-0.005, 0.005)
    ),
    position=st.tuples(offset, offset, st.floats(0.0, 1.5)).map(np.array),
    rotation=st.builds(mounting, turn, turn, turn),
    sigma=st.floats(0.3, 3.0),
    robust=st.floats(0.5, 4.0),
)
poses = st.tuples(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0), st.floats(-3.1, 3.1)).map(np.array)
ahead = st.tuples(st.floats(-0.6, 0.6), st.floats(-0.5, 0.5), st.floats(0.5, 8.0)).map(
    lambda p: np.array((p[0] * p[2], p[1] * p[2], p[2]))
)


def in_world(model, pose, local):
    """A point (3,) of the camera's frame in the world."""
    position, rotation = camera_pose(model, pose)
    return position + rotation @ local


def pose3(position, rotation):
    return gtsam.Pose3(gtsam.Rot3(rotation), position)


@given(models, poses, ahead)
def test_pixels_are_those_of_gtsam(model, pose, local):
    point = in_world(model, pose, local)
    camera = gtsam.PinholeCameraCal3DS2(pose3(*camera_pose(model, pose)), model.calibration())
    (pixel,), (depth,) = predict(model, pose, point[None])
    np.testing.assert_allclose(pixel, camera.project(point), atol=1e-6)
    assert depth == pytest.approx(local[2])
    np.testing.assert_allclose(in_camera(model, pose, point[None])[0], local, atol=1e-9)


def test_a_robot_that_looks_along_x_sees_left_at_the_left_and_up_at_the_top():
    model = CameraModel(500.0, 500.0, 320.0, 240.0, 640, 480)
    pixels, depths = predict(model, np.zeros(3), np.array(((2.0, 0.0, 0.0), (2.0, 1.0, 0.0), (2.0, 0.0, 1.0))))
    np.testing.assert_allclose(pixels, ((320.0, 240.0), (70.0, 240.0), (320.0, -10.0)))
    np.testing.assert_allclose(depths, 2.0)
    down = replace(model, rotation=mounting(0.0, 0.3, 0.0))
    assert predict(down, np.zeros(3), np.array(((2.0, 0.0, 0.0),)))[0][0, 1] < 240.0  # what is ahead moves up
    left = replace(model, rotation=mounting(0.0, 0.0, 0.3))
    assert predict(left, np.zeros(3), np.array(((2.0, 0.0, 0.0),)))[0][0, 0] > 320.0
    np.testing.assert_allclose(mounting(0.0, 0.0, 0.0), FORWARD)


@given(models, poses, ahead)
def test_jacobians_of_the_planar_pose_the_point_and_the_constants_are_the_numerical_ones(model, pose, local):
    point = in_world(model, pose, local)
    pixels, *found = linearize(model, pose, point[None])
    np.testing.assert_allclose(pixels[0], predict(model, pose, point[None])[0][0], atol=1e-9)
    numerical = by_each(
        lambda v: predict(recalibrated(model, v[2]), v[0], v[1][None])[0][0], [pose, point, np.zeros(8)]
    )
    for block, expected in zip(found, numerical, strict=True):
        np.testing.assert_allclose(block[0], expected, rtol=1e-4, atol=1e-2)
    assert np.all(found[2][0, :, TIME_OFFSET] == 0.0)


@given(models, poses, ahead)
def test_jacobians_of_a_camera_in_space_are_the_numerical_ones(model, pose, local):
    point = in_world(model, pose, local)
    camera = pose3(*camera_pose(model, pose))

    def seen(d, p):
        moved = camera.retract(d)
        return linearize_in_space(model, moved.translation(), moved.rotation().matrix(), p[None])[0][0]

    pixels, by_camera, by_point = linearize_in_space(
        model, camera.translation(), camera.rotation().matrix(), point[None]
    )
    np.testing.assert_allclose(pixels[0], predict(model, pose, point[None])[0][0], atol=1e-6)
    np.testing.assert_allclose(by_camera[0], derivative(lambda d: seen(d, point), 6), rtol=1e-4, atol=1e-2)
    np.testing.assert_allclose(by_point[0], derivative(lambda d: seen(np.zeros(6), point + d), 3), rtol=1e-4, atol=1e-2)


# every subset that is estimated, at changes that are not zero, through an offset and with a velocity
subsets = st.sets(st.integers(0, 7), min_size=1).map(lambda s: tuple(sorted(s)))
changes = st.tuples(*[st.floats(-0.2, 0.2)] * 8).map(np.array)


@given(models, poses, ahead, subsets, changes)
def test_a_factor_has_the_numerical_jacobians_of_pose_and_constants(model, pose, local, estimated, change):
    values = [pose, change[list(estimated)]]
    twist = np.array((0.4, 0.05, 0.3))
    moved = se2.compose(pose, np.array((0.1, 0.02, 0.05)))
    factor = ReprojectionFactor(
        model,
        in_world(model, moved, local)[None],
        np.array(((300.0, 200.0),)),
        offset=np.array((0.1, 0.02, 0.05)),
        estimated=estimated,
        twist=twist,
    )
    # where the changes turn the point out of sight the distortion's polynomial has no meaning
    full = np.zeros(8)
    full[list(estimated)] = values[1]
    here = factor.fixed([values[1]], None)
    seen = in_camera(here.model, se2.compose(pose, here.offset), here.points)[0]
    assume(seen[2] > 0.3 and np.hypot(seen[0], seen[1]) < 1.2 * seen[2])
    error, blocks = factor.whitened(values)
    for block, expected in zip(blocks, by_each(lambda v: factor.whitened(v)[0][0], values), strict=False):
        np.testing.assert_allclose(block[0], expected, rtol=2e-4, atol=2e-2)
    assert error.shape == (1, 2)


@given(models, poses, st.lists(ahead, min_size=3, max_size=5))
def test_points_are_displaced_together_or_each(model, pose, locals_):
    points = np.array([in_world(model, pose, local) for local in locals_])
    pixels = np.full((len(points), 2), 250.0)
    which = (0, -1, 1, 0, 1)[: len(points)]
    factor = ReprojectionFactor(model, points, pixels, np.array((0.1, -0.05, 0.2)), moved_by=which)
    by = [np.array((0.02, -0.01, 0.03)), np.array((-0.01, 0.0, 0.02))]
    residual, blocks = factor.whitened([pose, *by])
    shifts = np.array((*by, np.zeros(3)))[np.array(which)]
    moved = replace(factor, points=points + shifts, moved_by=()).whitened([pose])[0]
    np.testing.assert_allclose(residual, moved, rtol=1e-9, atol=1e-7)
    for block, numerical in zip(blocks, by_each(lambda v: factor.whitened(v)[0], [pose, *by]), strict=False):
        np.testing.assert_allclose(block, numerical, rtol=1e-4, atol=1e-2)


@given(models, poses, st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(-9.0, 0.2)).map(np.array))
def test_points_behind_the_camera_are_finite_and_never_throw(model, pose, local):
    point = in_world(model, pose, local)[None]
    for found in (*linearize(model, pose, point), *linearize_in_space(model, *camera_pose(model, pose), point)):
        assert np.all(np.isfinite(found))
    factor = ReprojectionFactor(model, point, np.array(((320.0, 240.0),)), point_covariances=0.01 * np.eye(3)[None])
    residual, (jacobian,) = factor.linearize([pose])
    assert np.all(np.isfinite(residual))
    assert np.all(np.isfinite(jacobian))
    tilts = by_tilt(model, linearize(model, pose, point)[3])
    assert np.all(np.isfinite(log_likelihood(model, pose[None], point, np.array(((320.0, 240.0),)), tilts)))


@given(models, st.tuples(turn, turn, turn), st.tuples(offset, offset, offset).map(np.array))
def test_the_robot_is_found_back_from_its_camera(model, turns, position):
    rotation = mounting(*turns)
    where = mounted(model, position, rotation)
    their = gtsam.Pose3(gtsam.Rot3(rotation), position) * pose3(model.position, model.rotation)
    np.testing.assert_allclose(where[0], their.translation(), atol=1e-12)
    np.testing.assert_allclose(where[1], their.rotation().matrix(), atol=1e-12)
    back = carrier(model, *where)
    np.testing.assert_allclose(back[0], position, atol=1e-12)
    np.testing.assert_allclose(back[1], rotation, atol=1e-12)


def scene(seed=0, count=12):
    rng = np.random.default_rng(seed)
    model = CameraModel(
        500.0, 480.0, 320.0, 240.0, 640, 480, (-0.1, 0.01, 0.001, 0.002), np.array((0.1, 0.0, 0.8)), sigma=0.7
    )
    pose = np.array((0.4, -0.3, 0.7))
    local = np.column_stack((rng.uniform(-1, 1, count), rng.uniform(-0.8, 0.8, count), rng.uniform(2, 5, count)))
    points = np.array([in_world(model, pose, p) for p in local])
    pixels = predict(model, pose, points)[0] + 3.0 * rng.standard_normal((count, 2))  # some beyond the loss's scale
    return model, pose, points, pixels, rng


@pytest.mark.parametrize(("tilt", "robust"), [(0.0, 2.0), (0.005, 1e3)])
def test_the_log_likelihood_of_many_poses_is_minus_the_factors_cost(tilt, robust):
    """With a tilt it is where nothing is an outlier: to find that of each particle robustly would take too long."""
    model, pose, points, pixels, rng = scene()
    model = replace(model, tilt=tilt, robust=robust, tempering=0.5)
    near = se2.compose(pose, se2.exp(0.02 * rng.standard_normal((7, 3))))
    factor = ReprojectionFactor(model, points, pixels)
    costs = [factor.cost([p]) for p in near]
    _, _, by_point, by_constants = linearize(model, pose, points)
    tilts = by_tilt(model, by_constants)
    np.testing.assert_allclose(log_likelihood(model, near, points, pixels, tilts), -np.array(costs), rtol=0.02)
    # the map's errors widen the noise of each pixel
    spreads = np.array([np.diag(s) for s in rng.uniform(0.0, 0.02, (len(points), 3)) ** 2])
    factor = replace(factor, point_covariances=spreads)
    noise = by_point @ spreads @ by_point.transpose(0, 2, 1) + model.sigma**2 * np.eye(2)
    found = log_likelihood(model, pose[None], points, pixels, tilts, noise)[0]
    assert found == pytest.approx(-factor.cost([pose]))
    assert found > -costs[0] / 10.0


def test_a_tilt_is_an_error_that_all_points_have_in_common():
    model, pose, points, pixels, _ = scene()
    factor = ReprojectionFactor(replace(model, tempering=0.5), points, pixels)
    error, (of_pose, tilts) = factor.whitened([pose])
    numerical = derivative(
        lambda d: linearize_in_space(model, *camera_pose(model, pose, d), points)[0].ravel() / model.sigma, 2
    )
    np.testing.assert_allclose(tilts.reshape(-1, 2), model.tilt * numerical, rtol=1e-4, atol=1e-6)

    levelled, tilt = factor.levelled([pose])
    np.testing.assert_allclose(levelled, error + tilts @ tilt)
    squared = np.sum(levelled**2, axis=1)
    weights = np.repeat(huber_weight(squared, model.robust), 2)
    pull = tilt + tilts.reshape(-1, 2).T @ (weights * levelled.ravel())
    np.testing.assert_allclose(pull, 0.0, atol=0.02 * np.linalg.norm(tilts))

    residual, (jacobian,) = factor.linearize([pose])
    flat = of_pose.reshape(-1, 3)
    covariance = np.diag(1.0 / weights) + tilts.reshape(-1, 2) @ tilts.reshape(-1, 2).T
    told = 0.5 * np.linalg.solve(covariance, np.column_stack((flat, error.ravel())))
    np.testing.assert_allclose(jacobian.T @ jacobian, flat.T @ told[:, :3], rtol=1e-3)
    np.testing.assert_allclose(jacobian.T @ residual, flat.T @ told[:, 3], rtol=1e-3)


def test_the_residual_is_that_of_gtsams_factor():
    model, pose, points, pixels, _ = scene()
    factor = ReprojectionFactor(model, points, pixels)
    error, (jacobian, _) = factor.whitened([pose])
    noise = gtsam.noiseModel.Isotropic.Sigma(2, model.sigma)
    mounted = pose3(model.position, model.rotation)
    values = gtsam.Values()
    values.insert(0, gtsam.Pose2(*pose))
    for i in range(len(points)):
        theirs = gtsam.PlanarProjectionFactor1(0, points[i], pixels[i], mounted, model.calibration(), noise)
        np.testing.assert_allclose(theirs.whitenedError(values), error[i], atol=1e-6)
        linear, offset = theirs.linearize(values).jacobian()
        np.testing.assert_allclose(linear, jacobian[i], atol=1e-4)
        np.testing.assert_allclose(-offset, error[i], atol=1e-6)


@given(st.floats(0.0, 100.0), st.floats(0.3, 5.0))
def test_the_loss_is_that_of_huber(squared, scale):
    theirs = gtsam.noiseModel.mEstimator.Huber.Create(scale)
    distance = np.sqrt(squared)
    assert huber_loss(np.array(squared), scale) == pytest.approx(theirs.loss(distance), abs=1e-12)
    assert huber_weight(np.array(squared), scale) == pytest.approx(theirs.weight(distance))


@pytest.mark.parametrize(("tilt", "close"), [(0.0, 1e-4), (0.005, 1e-2)])
def test_the_weighted_residual_has_the_gradient_of_the_cost(tilt, close):
    """But for how the effect of a tilt changes with the pose."""
    model, pose, points, pixels, _ = scene()
    factor = ReprojectionFactor(replace(model, tilt=tilt), points, pixels)
    residual, (jacobian,) = factor.linearize([pose])
    np.testing.assert_allclose(jacobian.T @ residual, by_pose(lambda p: factor.cost([p]), pose), rtol=close)


def test_the_names_of_the_constants_are_in_the_order_of_the_columns():
    assert PARAMETERS == ("x", "y", "z", "roll", "pitch", "yaw", "focal", "time_offset")
    model = CameraModel(500.0, 500.0, 320.0, 240.0, 640, 480)
    point = np.array(((2.0, 0.0, 0.0),))
    for name, before, after in (("pitch", 1, -1), ("yaw", 0, 1)):
        change = np.zeros(8)
        change[PARAMETERS.index(name)] = 0.1
        moved = predict(recalibrated(model, change), np.zeros(3), point)[0][0] - (320.0, 240.0)
        assert np.sign(moved[before]) == after
    change = np.eye(8)[reprojection.FOCAL] * np.log(1.05)
    assert recalibrated(model, change).fx == pytest.approx(525.0)
