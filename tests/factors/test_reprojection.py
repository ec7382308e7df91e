"""The camera: agreement with GTSAM's camera and factor, Jacobians, what lies behind it, its noise."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from factors import se2
from factors.camera import model as reprojection
from factors.camera.factor import ReprojectionFactor
from factors.camera.model import (
    FORWARD,
    PARAMETERS,
    TIME_OFFSET,
    CameraModel,
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

STEP = 1e-6
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


def derivative(function, size):
    return np.stack([(function(d) - function(-d)) / (2.0 * STEP) for d in STEP * np.eye(size)], axis=-1)


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
def test_jacobians_of_the_planar_pose_and_the_point_are_the_numerical_ones(model, pose, local):
    point = in_world(model, pose, local)
    pixels, by_pose, by_point, _ = linearize(model, pose, point[None])
    np.testing.assert_allclose(pixels[0], predict(model, pose, point[None])[0][0], atol=1e-9)
    numerical = derivative(lambda d: predict(model, se2.compose(pose, se2.exp(d)), point[None])[0][0], 3)
    np.testing.assert_allclose(by_pose[0], numerical, rtol=1e-4, atol=1e-2)
    numerical = derivative(lambda d: predict(model, pose, (point + d)[None])[0][0], 3)
    np.testing.assert_allclose(by_point[0], numerical, rtol=1e-4, atol=1e-2)


@given(models, poses, ahead)
def test_jacobians_of_the_constants_are_the_numerical_ones(model, pose, local):
    point = in_world(model, pose, local)
    _, _, _, by_constants = linearize(model, pose, point[None])
    numerical = derivative(lambda d: predict(recalibrated(model, d), pose, point[None])[0][0], 8)
    np.testing.assert_allclose(by_constants[0], numerical, rtol=1e-4, atol=1e-2)
    assert np.all(by_constants[0, :, TIME_OFFSET] == 0.0)


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

    def at(d, which):
        near = list(values)
        near[which] = se2.compose(pose, se2.exp(d)) if which == 0 else values[1] + d
        return factor.whitened(near)[0][0]

    np.testing.assert_allclose(blocks[0][0], derivative(lambda d: at(d, 0), 3), rtol=2e-4, atol=2e-2)
    numerical = derivative(lambda d: at(d, 1), len(estimated))
    np.testing.assert_allclose(blocks[1][0], numerical, rtol=2e-4, atol=2e-2)
    assert error.shape == (1, 2)


@given(models, poses, ahead)
def test_a_free_point_is_a_variable(model, pose, local):
    point = in_world(model, pose, local)
    factor = ReprojectionFactor(model, np.zeros((1, 3)), np.array(((300.0, 200.0),)), free=True)
    _, blocks = factor.whitened([pose, point])
    numerical = derivative(lambda d: factor.whitened([pose, point + d])[0][0], 3)
    np.testing.assert_allclose(blocks[1][0], numerical, rtol=1e-4, atol=1e-2)


@given(models, poses, st.lists(ahead, min_size=2, max_size=4))
def test_free_points_are_displaced_together_or_each(model, pose, locals_):
    points = np.array([in_world(model, pose, local) for local in locals_])
    pixels, offset = np.full((len(points), 2), 250.0), np.array((0.1, -0.05, 0.2))
    noise = np.diag((0.02, 0.01, 0.01)) ** 2
    free = ReprojectionFactor(model, points, pixels, offset, noise, free=True)
    by = np.array((0.02, -0.01, 0.03))
    one, each = free.whitened([pose, by]), free.whitened([pose, np.tile(by, (len(points), 1))])
    np.testing.assert_allclose(one[0], each[0], atol=1e-9)
    np.testing.assert_allclose(one[1][1], each[1][1], atol=1e-9)
    # with a noise that does not change with the points
    free = replace(free, offset_covariance=None)
    residual, (_, by_point) = free.whitened([pose, by])
    moved = replace(free, points=points + by, free=False).whitened([pose])[0]
    np.testing.assert_allclose(residual, moved, rtol=1e-9, atol=1e-7)
    for row in range(len(points)):
        numerical = derivative(lambda d, row=row: free.whitened([pose, by + d])[0][row], 3)
        np.testing.assert_allclose(by_point[row], numerical, rtol=1e-4, atol=1e-2)


@given(models, poses, st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(-9.0, 0.2)).map(np.array))
def test_points_behind_the_camera_are_finite_and_never_throw(model, pose, local):
    point = in_world(model, pose, local)[None]
    for found in (*linearize(model, pose, point), *linearize_in_space(model, *camera_pose(model, pose), point)):
        assert np.all(np.isfinite(found))
    factor = ReprojectionFactor(model, point, np.array(((320.0, 240.0),)), point_covariances=0.01 * np.eye(3)[None])
    residual, (jacobian,) = factor.linearize([pose])
    assert np.all(np.isfinite(residual))
    assert np.all(np.isfinite(jacobian))
    assert np.all(np.isfinite(log_likelihood(model, pose[None], point, np.array(((320.0, 240.0),)))))


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


def test_the_log_likelihood_of_many_poses_is_minus_the_factors_cost():
    model, pose, points, pixels, rng = scene()
    near = se2.compose(pose, se2.exp(0.02 * rng.standard_normal((7, 3))))
    factor = ReprojectionFactor(model, points, pixels)
    costs = [factor.cost([p]) for p in near]
    np.testing.assert_allclose(log_likelihood(model, near, points, pixels), -np.array(costs), rtol=1e-9)
    # the map's errors widen the noise of each pixel
    spreads = np.array([np.diag(s) for s in rng.uniform(0.0, 0.02, (len(points), 3)) ** 2])
    factor = replace(factor, point_covariances=spreads)
    _, _, by_point, _ = linearize(model, pose, points)
    noise = by_point @ spreads @ by_point.transpose(0, 2, 1) + model.sigma**2 * np.eye(2)
    found = log_likelihood(model, pose[None], points, pixels, noise)[0]
    assert found == pytest.approx(-factor.cost([pose]))
    assert found > -costs[0] / 10.0


def test_the_residual_is_that_of_gtsams_factor():
    model, pose, points, pixels, _ = scene()
    factor = ReprojectionFactor(model, points, pixels)
    error, (jacobian,) = factor.whitened([pose])
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


def test_the_weighted_residual_has_the_gradient_of_the_cost():
    model, pose, points, pixels, _ = scene()
    factor = ReprojectionFactor(model, points, pixels)
    residual, (jacobian,) = factor.linearize([pose])
    gradient = derivative(lambda d: np.array(factor.cost([se2.compose(pose, se2.exp(d))])), 3)
    np.testing.assert_allclose(jacobian.T @ residual, gradient, rtol=1e-4)


def test_what_is_known_of_the_motion_and_the_map_widens_the_noise():
    model, pose, points, pixels, _ = scene()
    sharp, _ = ReprojectionFactor(model, points, pixels).whitened([pose])
    wide, _ = ReprojectionFactor(
        model,
        points,
        pixels,
        offset=np.zeros(3),
        offset_covariance=np.diag((0.02, 0.02, 0.01)) ** 2,
        point_covariances=np.broadcast_to(0.01**2 * np.eye(3), (len(points), 3, 3)),
    ).whitened([pose])
    assert np.all(np.linalg.norm(wide, axis=1) < 0.5 * np.linalg.norm(sharp, axis=1))


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


def test_a_free_point_behind_the_camera_is_astray_and_pulls_at_nothing():
    model = CameraModel(300.0, 300.0, 320.0, 240.0, 640, 480, (-0.3, 0.09, 0.0, 0.0))
    pose = np.array((0.5, -0.2, 0.3))
    position, rotation = reprojection.camera_pose(model, pose)
    ahead, behind = position + rotation @ (0.1, 0.2, 2.0), position + rotation @ (0.1, 0.2, -2.0)
    pixel = reprojection.predict(model, pose, ahead[None])[0]
    factor = ReprojectionFactor(model, np.zeros((1, 3)), pixel, free=True)
    assert not factor.is_astray(pose, ahead)
    assert not factor.is_astray(pose, ahead + rotation @ (0.1, 0.0, 0.0))
    assert factor.is_astray(pose, behind)
    assert factor.is_astray(pose, position + rotation @ (2.0, 0.2, 2.0))
    _, blocks = factor.linearize([pose, behind])
    assert not np.any(np.concatenate(blocks, axis=1))
    assert factor.cost([pose, behind]) > factor.cost([pose, ahead + rotation @ (0.1, 0.0, 0.0)])
