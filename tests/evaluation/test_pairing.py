"""What is compared with what: stamps of the reference, and estimates between those of the grid."""

import numpy as np
import pytest

from factorgraph_loc.evaluation.metrics import accuracy, errors
from factorgraph_loc.evaluation.pairing import pairs, pauses, thinned
from factorgraph_loc.model.trajectory import Trajectory

RADIUS, TURN = 2.0, 0.4  # m, rad/s


def circle(t, covariance=None):
    """A drive on a circle, and a covariance of all its poses."""
    a = TURN * t
    poses = np.stack((RADIUS * np.sin(a), RADIUS * (1.0 - np.cos(a)), np.angle(np.exp(1j * a))), axis=1)
    return Trajectory(t, poses, None if covariance is None else np.tile(covariance, (len(t), 1, 1)))


GRID = 0.1 * np.arange(601)


@pytest.mark.parametrize("step", [0.01, 0.02, 1 / 30, 0.1, 0.128, 0.5, 2.0, 5.0])
@pytest.mark.parametrize("begin", [0.0, 0.037])
def test_each_pose_of_a_reference_however_sparse_is_scored(step, begin):
    t = np.arange(begin, 60.0, step)
    figures = accuracy(circle(GRID, np.eye(3)), circle(t))
    assert figures["scored"] == pytest.approx(min(len(t), 600), abs=1)
    # an arc is what is interpolated along
    assert figures["position_max"] < 1e-9
    assert figures["heading_max"] < 1e-9
    assert figures["anees"] == pytest.approx(0.0, abs=1e-12)


def test_stamps_that_jitter_by_less_than_a_millisecond_are_all_kept():
    rng = np.random.default_rng(0)
    t = 0.1 * np.arange(1000) + rng.uniform(-4e-4, 4e-4, 1000)
    assert len(thinned(t)) == 1000
    assert np.diff(t[thinned(t)]).min() >= 0.099


def test_the_same_stamps_are_scored_whatever_the_estimate():
    reference = circle(np.arange(0.0, 10.0, 0.013))
    whole, late = pairs(circle(GRID), reference), pairs(circle(GRID[57:]), reference)
    assert late.t[0] == pytest.approx(5.72)
    np.testing.assert_array_equal(whole.t[-len(late.t) :], late.t)
    np.testing.assert_array_equal(whole.poses[-len(late.t) :], late.poses)


def test_a_millisecond_before_the_first_and_after_the_last_estimate_is_no_time():
    reference = Trajectory(np.array([0.9992, 1.5, 2.0008]), np.zeros((3, 3)))
    assert np.isfinite(pairs(circle(np.array([1.0, 1.5, 2.0])), reference).poses).all()
    reference = Trajectory(np.array([0.998, 1.5, 2.002]), np.zeros((3, 3)))
    assert pairs(circle(np.array([1.0, 1.5, 2.0])), reference).t.tolist() == [1.5]


def test_between_estimates_that_lie_too_far_apart_nothing_is_scored():
    estimate = circle(np.array([0.0, 0.3, 1.0, 1.1]))
    reference = circle(np.array([0.0, 0.2, 0.5, 0.9, 1.0, 1.1]))
    for gap, expected in ((0.5, [1, 1, 0, 0, 1, 1]), (0.2, [1, 0, 0, 0, 1, 1]), (0.7, [1] * 6)):
        assert np.isfinite(pairs(estimate, reference, gap).poses[:, 0]).astype(int).tolist() == expected


@pytest.mark.parametrize("correlation", [-0.9, 0.0, 0.7, 1.0])
def test_an_interpolated_covariance_is_never_too_small(correlation):
    """Errors of two neighbours with any correlation: that between them is within what is stated."""
    a, b = np.diag((0.04, 0.01, 0.002)), np.array([(0.09, 0.02, 0.0), (0.02, 0.05, 0.001), (0.0, 0.001, 0.004)])
    cross = correlation * np.linalg.cholesky(a) @ np.linalg.cholesky(b).T
    estimate = Trajectory(np.array([0.0, 0.1]), np.zeros((2, 3)), np.stack((a, b)))
    for f in (0.0, 0.25, 0.5, 1.0):
        stated = estimate.covariances_at(np.array([0.1 * f]))[0]
        true = (1 - f) ** 2 * a + f**2 * b + f * (1 - f) * (cross + cross.T)
        assert np.linalg.eigvalsh(stated - true)[0] > -1e-12
    np.testing.assert_array_equal(estimate.covariances_at(np.array([0.1]))[0], b)


def test_beside_a_covariance_that_is_none_none_is_made_up():
    estimate = Trajectory(GRID[:3], np.zeros((3, 3)), np.stack((np.eye(3), np.zeros((3, 3)), np.eye(3))))
    e = errors(estimate, Trajectory(np.array([0.0, 0.15]), np.zeros((2, 3))))
    assert np.isfinite(e.nees).tolist() == [True, False]
    assert e.invalid.tolist() == [False, True]


def test_a_pause_is_longer_than_what_is_usual():
    assert pauses(np.array([0.0, 0.1, 0.2, 1.1, 2.2, 2.3])).tolist() == [4]
    assert pauses(2.0 * np.arange(9)).tolist() == []
    assert pauses(np.array([0.0, 2.0, 4.0, 11.0, 13.0])).tolist() == [3]
