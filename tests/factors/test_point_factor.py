"""A point of unknown position in an image: agreement with GTSAM's factor in space, Jacobians, what lies behind the camera."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from mounted_camera import MODEL
from numerical import by_each

from factors import se2
from factors.camera.model import camera_pose, lens_of, linearize_in_space
from factors.camera.point import PointFactor, PointPrior
from factors.graph import VectorPriorFactor, gaussian_factor, jacobian_factors
from factors.robust import huber_loss

POSE, TILT, POINT = np.array((0.1, 0.2, 0.3)), np.array((0.02, -0.03)), np.array((5.0, 2.5, 1.4))
ESTIMATED = (0, 3, 5, 6, 7)
CHANGES = np.array((0.02, -0.03, 0.04, 0.02, 0.1))
TWIST = np.array((0.4, 0.05, -0.5))


def seen(error=(0.0, 0.0), tilt=TILT):
    pixel = linearize_in_space(MODEL, *camera_pose(MODEL, POSE, tilt), POINT[None])[0][0] + error
    return PointFactor(MODEL, lens_of(MODEL), pixel)


@pytest.mark.parametrize("error", [(0.4, -0.3), (5.0, 8.0)])
@pytest.mark.parametrize("tilt", [np.zeros(2), TILT])
def test_it_is_gtsam_s_factor_of_a_robot_in_space(error, tilt):
    factor = seen(error, tilt)
    robot = gtsam.Pose3(gtsam.Rot3.Rz(POSE[2]) * gtsam.Rot3.Expmap(np.append(tilt, 0.0)), (POSE[0], POSE[1], 0.0))
    loss = gtsam.noiseModel.mEstimator.Huber.Create(MODEL.robust)
    noise = gtsam.noiseModel.Robust.Create(loss, gtsam.noiseModel.Isotropic.Sigma(2, MODEL.sigma))
    mounted = gtsam.Pose3(gtsam.Rot3(MODEL.rotation), MODEL.position)
    theirs = gtsam.GenericProjectionFactorCal3DS2(factor.pixel, noise, 0, 1, MODEL.calibration(), mounted)
    values = gtsam.Values()
    values.insert(0, robot)
    values.insert(1, POINT)
    assert theirs.error(values) == pytest.approx(factor.cost([POSE, tilt, POINT]))
    residual, (_, _, by_point) = factor.linearize([POSE, tilt, POINT])
    linear = theirs.linearize(values)
    np.testing.assert_allclose(by_point, linear.jacobian()[0][:, 6:], atol=1e-6)
    np.testing.assert_allclose(residual, -linear.jacobian()[1], atol=1e-6)


@pytest.mark.parametrize("estimated", [(), ESTIMATED])
def test_its_jacobians_are_the_numerical_ones(estimated):
    factor = replace(seen((0.5, -0.4)), estimated=estimated, twist=TWIST)
    values = [POSE, *([CHANGES] if estimated else []), TILT, POINT]
    residual, blocks = factor.linearize(values)
    for block, slopes in zip(blocks, by_each(factor.cost, values), strict=True):
        assert residual @ block == pytest.approx(slopes, rel=1e-2, abs=1e-2)


@pytest.mark.parametrize("estimated", [(), ESTIMATED])
def test_many_are_linearised_as_each_by_itself(estimated):
    rng = np.random.default_rng(0)
    pixels = seen().pixel + rng.normal(0.0, 5.0, (4, 2))
    factors = [
        PointFactor(MODEL, lens_of(MODEL), pixel, estimated, (1.0 + i) * TWIST) for i, pixel in enumerate(pixels)
    ]
    constants = {9: CHANGES} if estimated else {}
    values = constants | {i: POSE + rng.normal(0.0, 0.01, 3) for i in range(4)}
    values |= {10 + i: TILT + rng.normal(0.0, 0.01, 2) for i in range(4)} | {20: POINT, 21: POINT + 0.1}
    keys = [(i, *constants, 10 + i, 20 + i % 2) for i in range(4)]
    mixed = [*zip(factors, keys, strict=True), (VectorPriorFactor(POINT, np.ones(3)), (20,))]
    for (factor, on), together in zip(mixed, jacobian_factors(mixed, values), strict=True):
        alone = gaussian_factor(on, *factor.linearize([values[key] for key in on]))
        np.testing.assert_allclose(together.augmentedJacobian(), alone.augmentedJacobian(), rtol=1e-12)
        assert together.keys() == alone.keys()


def test_a_point_behind_the_camera_is_astray_and_pulls_at_nothing():
    factor = seen()
    position, rotation = camera_pose(MODEL, POSE, TILT)
    behind = position + rotation @ (0.1, 0.2, -2.0)
    assert not factor.is_astray([POSE, TILT, POINT])
    assert not factor.is_astray([POSE, TILT, POINT + 0.1])
    assert factor.is_astray([POSE, TILT, behind])
    assert factor.is_astray([POSE, TILT, position + rotation @ (2.0, 0.2, 2.0)])
    _, blocks = factor.linearize([POSE, TILT, behind])
    assert not np.any(np.concatenate(blocks, axis=1))
    assert factor.cost([POSE, TILT, behind]) > factor.cost([POSE, TILT, POINT + 0.1]) > huber_loss(0.0, MODEL.robust)


def test_the_jacobians_of_a_prior_are_the_numerical_ones():
    prior = PointPrior.of(POSE, POINT + np.array((0.3, -0.2, 0.1)), 0.5)
    residual, blocks = prior.linearize([POSE, POINT])
    assert prior.cost([POSE, POINT]) == pytest.approx(0.5 * residual @ residual) == pytest.approx(0.5 * 0.14 / 0.25)
    for block, numerical in zip(blocks, by_each(lambda v: prior.linearize(v)[0], [POSE, POINT]), strict=True):
        np.testing.assert_allclose(block, numerical, rtol=0.0, atol=1e-6)
    moved = se2.compose(np.array((3.0, -2.0, 1.0)), POSE)
    point = np.append(se2.transform_from(np.array((3.0, -2.0, 1.0)), POINT[:2]), POINT[2])
    np.testing.assert_allclose(prior.linearize([moved, point])[0], residual)  # it tells nothing of the frame
