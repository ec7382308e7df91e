"""One step back of the Rauch-Tung-Striebel smoother (1965), compiled: a filter's final trajectory asks it at each record."""

import numba
import numpy as np

from factors.se2 import Array


@numba.njit(cache=True)
def predicted(covariance: Array, transition: Array, noise: Array) -> Array:
    """The covariance (S, S) after a prediction, from that before.

    ``transition`` (3, S): its first rows, the others are those of the identity; ``noise`` (3, 3): what it adds.
    """
    moved = transition @ covariance
    after = covariance.copy()
    after[:3] = moved
    after[:, :3] = moved.T
    after[:3, :3] = moved @ transition.T + noise
    return after


@numba.njit(cache=True)
def smoothed(covariance: Array, transition: Array, noise: Array, change: Array, later: Array) -> tuple[Array, Array]:
    """The correction (S,) of a state, and its covariance (S, S), from what came later.

    ``covariance`` (S, S): of the filtered state; ``transition`` and ``noise``: of the step that follows, as in :func:`predicted`.
    The smoothed state after that step differs by ``change`` (S,) from the predicted one, and has the covariance ``later`` (S, S).
    LinAlgError where the predicted covariance is singular.
    """
    after = predicted(covariance, transition, noise)
    carried = covariance.copy()  # transition times covariance
    carried[:3] = transition @ covariance
    gain = np.ascontiguousarray(np.linalg.solve(after, carried).T)
    return gain @ change, covariance + gain @ (later - after) @ gain.T


@numba.njit(cache=True)
def is_skew(covariance: Array, share: float) -> bool:
    """Whether a covariance (S, S) is farther from symmetry than this share of two standard deviations."""
    for i in range(len(covariance)):
        for j in range(i):
            skew = covariance[i, j] - covariance[j, i]
            if skew * skew > share * share * covariance[i, i] * covariance[j, j]:
                return True
    return False
