"""One backward step of the Rauch-Tung-Striebel smoother (1965), compiled."""

import numpy as np

from factors.compiled import compiled
from factors.se2 import Array
from factors.small_kernels import product, product_by_transpose, solved


@compiled
def predicted(covariance: Array, transition: Array, noise: Array) -> Array:
    """The predicted covariance (S, S). ``transition`` (3, S): its first rows, the others are those of the identity; ``noise`` (3,
    3): added to the first three components."""
    moved, after = product(transition, covariance), covariance.copy()
    own = product_by_transpose(moved, transition)
    for i in range(3):
        for j in range(3, len(after)):
            after[i, j] = after[j, i] = moved[i, j]
        for j in range(3):
            after[i, j] = own[i, j] + noise[i, j]
    return after


@compiled
def smoothed(covariance: Array, transition: Array, noise: Array, change: Array, later: Array) -> tuple[Array, Array]:
    """The correction (S,) of a state, and its smoothed covariance (S, S).

    ``covariance`` (S, S): of the filtered state; ``transition`` and ``noise``: of the following step, as in :func:`predicted`. The
    smoothed state after that step differs by ``change`` (S,) from the predicted one, and has the covariance ``later`` (S, S).
    LinAlgError if the predicted covariance is singular.
    """
    size, after, moved = len(covariance), predicted(covariance, transition, noise), product(transition, covariance)
    carried = covariance.copy()  # transition times covariance
    for i in range(3):
        for j in range(size):
            carried[i, j] = moved[i, j]
    gain, _ = solved(after, carried)  # its transpose
    for i in range(size):
        for j in range(size):
            after[i, j] = later[i, j] - after[i, j]
    correction, half, out = np.zeros(size), product(after, gain), covariance.copy()
    for k in range(size):
        for i in range(size):
            correction[i] += gain[k, i] * change[k]
            for j in range(size):
                out[i, j] += gain[k, i] * half[k, j]
    return correction, out


@compiled
def is_skew(covariance: Array, share: float) -> bool:
    """Whether a covariance (S, S) is asymmetric by more than this share of two standard deviations."""
    for i in range(len(covariance)):
        for j in range(i):
            skew = covariance[i, j] - covariance[j, i]
            if skew * skew > share * share * covariance[i, i] * covariance[j, j]:
                return True
    return False
