"""Factors of a graph that belong to no sensor."""

import gtsam
import numpy as np
import pytest
from numerical import by_each

from factors import se2
from factors.graph import PriorFactor, VectorPriorFactor, gaussian_factor

MEAN, SIGMAS = np.array((0.5, -2.0, 0.1)), np.array((0.1, 0.5, 2.0))


@pytest.mark.parametrize("value", [MEAN, np.array((0.7, -2.0, 5.0)), np.zeros(3)])
def test_a_prior_on_a_vector_is_gtsams(value):
    factor = VectorPriorFactor(MEAN, SIGMAS)
    twin = gtsam.PriorFactorVector(7, MEAN, gtsam.noiseModel.Diagonal.Sigmas(SIGMAS))
    values = gtsam.Values()
    values.insert(7, value)
    ours, theirs = gaussian_factor((7,), *factor.linearize([value])), twin.linearize(values)
    np.testing.assert_allclose(ours.jacobian()[0], theirs.jacobian()[0], atol=1e-12)
    np.testing.assert_allclose(ours.jacobian()[1], theirs.jacobian()[1], atol=1e-12)
    assert factor.cost([value]) == pytest.approx(twin.error(values))


def test_a_prior_on_a_pose_is_gtsams():
    mean, covariance = np.array((1.0, -2.0, 3.0)), np.diag((0.1, 0.2, 0.05)) ** 2 + 1e-3
    pose = se2.compose(mean, se2.exp(np.array((0.3, -0.2, 0.4))))
    factor = PriorFactor(mean, covariance)
    twin = gtsam.PriorFactorPose2(7, gtsam.Pose2(*mean), gtsam.noiseModel.Gaussian.Covariance(covariance))
    values = gtsam.Values()
    values.insert(7, gtsam.Pose2(*pose))
    # the root of the information by which GTSAM whitens is another, so that only costs compare
    assert factor.cost([pose]) == pytest.approx(twin.error(values), rel=1e-9)


def test_costs_are_half_the_squared_residuals_and_jacobians_the_numerical_ones():
    pose = np.array((1.0, -2.0, 3.0))
    for factor, value, poses in (
        (VectorPriorFactor(MEAN, SIGMAS), np.array((0.7, -1.0, 5.0)), ()),
        (PriorFactor(pose, np.diag((0.1, 0.2, 0.05)) ** 2), np.array((1.2, -2.1, -3.1)), (0,)),
    ):
        residual, (jacobian,) = factor.linearize([value])
        assert factor.cost([value]) == pytest.approx(0.5 * residual @ residual)
        (numerical,) = by_each(lambda v, factor=factor: factor.linearize(v)[0], [value], poses)
        np.testing.assert_allclose(jacobian, numerical, atol=1e-5)
