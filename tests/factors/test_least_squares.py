"""Minima of costs in a few variables, against closed forms."""

import numpy as np

from factors.least_squares import minima, minimum

TRUTH = np.array(((2.0, -1.0), (0.5, 3.0), (-4.0, 0.1)))
SCALES = np.array((1e-3, 1e4))


def valley(truth, states):
    """Half the squares of (x - a) / s and of y - b + (x - a)^2 / s^2, in units of very different size."""
    x, y = ((states - truth) / SCALES).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    residual = np.stack((x, y + x**2), axis=1)
    jacobian = np.stack((np.stack((one, zero), axis=1), np.stack((2.0 * x, one), axis=1)), axis=1) / SCALES
    gradient = np.einsum("nij,ni->nj", jacobian, residual)
    return 0.5 * np.sum(residual**2, axis=1), gradient, np.einsum("nij,nik->njk", jacobian, jacobian)


def test_problems_of_different_scales_are_solved_together():
    calls = []

    def at(states, which):
        calls.append(len(which))
        return valley(TRUTH[which], states)

    start = TRUTH + SCALES * np.array(((3.0, -2.0), (0.0, 0.0), (-30.0, 5.0)))
    found = minima(at, start, 100, 1e-9 * SCALES)
    np.testing.assert_allclose((found.states - TRUTH) / SCALES, 0.0, atol=1e-8)
    np.testing.assert_allclose(found.curvatures[0] * np.outer(SCALES, SCALES), np.eye(2), atol=1e-6)
    assert calls[:2] == [3, 3]
    assert calls[2] == 2  # the second began at its minimum, where the cost is zero
    assert len(calls) < 40


def test_a_step_is_no_longer_than_allowed():
    reached = []

    def at(state):
        reached.append(state[0])
        return float(0.5 * (state[0] - 10.0) ** 2), state - 10.0, np.eye(1)

    state, cost, _ = minimum(at, np.zeros(1), 50, 1e-6, largest=1.0)
    assert np.max(np.diff(reached)) <= 1.0 + 1e-12
    np.testing.assert_allclose((state[0], cost), (10.0, 0.0), atol=1e-5)


def test_a_minimum_beyond_the_bounds_is_at_the_bound():
    def at(state):
        return float(0.5 * np.sum((state - 3.0) ** 2)), state - 3.0, np.eye(2)

    state, cost, _ = minimum(at, np.zeros(2), 50, 1e-9, high=np.array((1.0, 9.0)))
    np.testing.assert_allclose(state, (1.0, 3.0), atol=1e-6)
    np.testing.assert_allclose(cost, 2.0, atol=1e-6)


def test_what_a_problem_does_not_determine_stays():
    def at(state):
        return float(0.5 * state[0] ** 2), np.array((state[0], 0.0)), np.diag((1.0, 0.0))

    state, _, _ = minimum(at, np.array((1.0, 7.0)), 50, 1e-9)
    np.testing.assert_allclose(state, (0.0, 7.0), atol=1e-6)
