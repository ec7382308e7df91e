"""One backward step of the Rauch-Tung-Striebel smoother (1965), compiled."""

import numba
import numpy as np

from factors.se2 import Array


@numba.njit(cache=True)
def predicted(covariance: Array, transition: Array, noise: Array) -> Array:
    """The predicted covariance (S, S). ``transition`` (3, S): its first rows, the others are those of the identity; ``noise`` (3,
    3): added to the first three components."""
    moved = transition @ covariance
    after = covariance.copy()
    after[:3] = moved
    after[:, :3] = moved.T
    after[:3, :3] = moved @ transition.T + noise
    return after


@numba.njit(cache=True)
def smoothed(covariance: Array, transition: Array, noise: Array, change: Array, later: Array) -> tuple[Array, Array]:
    """The correction (S,) of a state, and its smoothed covariance (S, S).

    ``covariance`` (S, S): of the filtered state; ``transition`` and ``noise``: of the following step, as in :func:`predicted`. The
    smoothed state after that step differs by ``change`` (S,) from the predicted one, and has the covariance ``later`` (S, S).
    LinAlgError if the predicted covariance is singular.
    """
    after = predicted(covariance, transition, noise)
    carried = covariance.copy()  # transition times covariance
    carried[:3] = transition @ covariance
    gain = np.ascontiguousarray(np.linalg.solve(after, carried).T)
    return gain @ change, covariance + gain @ (later - after) @ gain.T


@numba.njit(cache=True)
def is_skew(covariance: Array, share: float) -> bool:
    """Whether a covariance (S, S) is asymmetric by more than this share of two standard deviations."""
    for i in range(len(covariance)):
        for j in range(i):
            skew = covariance[i, j] - covariance[j, i]
            if skew * skew > share * share * covariance[i, i] * covariance[j, j]:
                return True
    return False
