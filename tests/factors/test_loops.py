"""Loops as factors on two poses."""

import numpy as np
import pytest
from numerical import by_each

from factors import se2
from factors.loops.factor import LoopFactor
from factors.motion import Increment


def increment(rng):
    return Increment(0.3 * rng.normal(size=3), np.diag((1e-3, 2e-3, 1e-4)), 1.0)


def factors(rng):
    return [
        LoopFactor(None, np.array((0.5,)), increment(rng), increment(rng)),
        LoopFactor(np.array((0.3, -0.2, 0.5)), np.array((0.1, 0.1, 0.05)), increment(rng), increment(rng)),
        LoopFactor(np.array((0.3, -0.2, 0.5)), np.array((0.1, 0.1, 0.05))),
    ]


@pytest.mark.parametrize("which", range(3))
def test_jacobians_are_those_of_finite_differences(which):
    rng = np.random.default_rng(1)
    factor, values = factors(rng)[which], [rng.normal(size=3), rng.normal(size=3)]
    _, *blocks = factor.whitened(values)
    numerical = by_each(lambda v: factor.whitened(v)[0], values, (0, 1))
    for block, expected in zip(blocks, numerical, strict=True):
        np.testing.assert_allclose(block, expected, atol=1e-6)


def test_the_residual_of_one_place_is_the_distance_and_of_a_pose_its_error():
    here, there = np.array((1.0, 2.0, 0.7)), np.array((1.3, 2.4, -2.0))
    place = LoopFactor(None, np.array((0.5,)))
    assert np.linalg.norm(place.whitened([here, there])[0]) == pytest.approx(1.0)
    measured = se2.compose(se2.between(there, here), se2.exp(np.array((0.2, 0.0, 0.0))))
    pose = LoopFactor(measured, np.array((0.1, 0.1, 0.05)))
    np.testing.assert_allclose(pose.whitened([here, there])[0], (-2.0, 0.0, 0.0), atol=1e-12)


def test_what_the_odometry_adds_widens_the_noise():
    moved = Increment(np.zeros(3), np.diag((0.3, 0.3, 0.0)), 1.0)
    values = [np.array((1.0, 0.0, 0.0)), np.zeros(3)]
    alone, carried = LoopFactor(None, np.array((0.1,))), LoopFactor(None, np.array((0.1,)), moved, moved)
    assert alone.whitened(values)[0][0] == pytest.approx(10.0)
    assert carried.whitened(values)[0][0] == pytest.approx(0.61**-0.5)


def test_far_loops_have_no_influence_until_the_loss_is_wide():
    factor, values = LoopFactor(None, np.array((0.1,))), [np.array((10.0, 0.0, 0.0)), np.zeros(3)]
    pull = [np.linalg.norm(f.linearize(values)[0]) for f in (factor, factor.widened(factor.convex_width(values)))]
    assert pull[0] < 0.1
    assert pull[1] > 10.0
    assert factor.cost(values) == pytest.approx(4.5, rel=0.01)
