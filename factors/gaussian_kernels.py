"""Gaussians in compiled code: roots and inverses of covariances, prediction, correction by residuals, and smoothing.

Calls of LAPACK take longer than the arithmetic of small matrices.
"""

import math

import numpy as np

from factors.compiled import compiled
from factors.se2 import Array, Integers
from factors.small_kernels import product, product_by_transpose, solved


@compiled(error_model="numpy")
def root(covariance: Array) -> tuple[Array, bool]:
    """The lower Cholesky root of a covariance (D, D), whose lower half is read, and whether it exists."""
    size = len(covariance)
    out = np.zeros((size, size))
    for i in range(size):
        for j in range(i + 1):
            left = covariance[i, j]
            for k in range(j):
                left -= out[i, k] * out[j, k]
            if i > j:
                out[i, j] = left / out[j, j]
            elif 0.0 < left < np.inf:
                out[i, i] = math.sqrt(left)
            else:
                return out, False
    return out, True


@compiled(error_model="numpy")
def inverse(covariance: Array) -> tuple[Array, bool]:
    """The inverse of a covariance (D, D), whose lower half is read, and whether it exists."""
    size = len(covariance)
    lower, exists = root(covariance)
    out = np.empty((size, size))
    if not exists:
        return out, False
    back = np.zeros((size, size))  # the inverse of the root
    for j in range(size):
        back[j, j] = 1.0 / lower[j, j]
        for i in range(j + 1, size):
            left = 0.0
            for k in range(j, i):
                left -= lower[i, k] * back[k, j]
            back[i, j] = left / lower[i, i]
    for i in range(size):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, size):
                total += back[k, i] * back[k, j]
            out[i, j] = out[j, i] = total
    return out, True


@compiled(error_model="numpy")
def inform(residual: Array, jacobian: Array, columns: Integers, weights: Array, at: Array, information: Array) -> Array:
    """Add the information of K residuals to ``information`` (S, S), and return the vector (D,) that the correction solves for.

    ``residual`` (K, g) and ``jacobian`` (K, g, D): linearised at the correction ``at`` (S,); ``columns`` (D,): those of the
    Jacobian in the error state; ``weights`` (K,). The correction is the inverse of the information times this vector.
    """
    wide = len(columns)
    pull = np.zeros(wide)
    for k in range(len(residual)):
        for i in range(residual.shape[1]):
            row = jacobian[k, i]
            wanted = -residual[k, i]
            for a in range(wide):
                wanted += row[a] * at[columns[a]]
            for a in range(wide):
                weighted = weights[k] * row[a]
                if weighted != 0.0:
                    pull[a] += weighted * wanted
                    for b in range(wide):
                        information[columns[a], columns[b]] += weighted * row[b]
    return pull


@compiled(error_model="numpy")
def corrected(
    prior: Array, residual: Array, jacobian: Array, columns: Integers, weights: Array, at: Array
) -> tuple[bool, Array, Array, Array]:
    """Whether there is a solution; the correction (S,), the covariance (S, S) after it, and the vector (D,) of :func:`inform`.

    ``prior`` (S, S): the information of the prediction; the other arguments are those of :func:`inform`.
    """
    information = prior.copy()
    pull = inform(residual, jacobian, columns, weights, at, information)
    after, exists = inverse(information)
    delta = np.zeros(len(prior))
    if exists:
        for i in range(len(prior)):
            for a in range(len(columns)):
                delta[i] += after[i, columns[a]] * pull[a]
    return exists, delta, after, pull


@compiled(error_model="numpy")
def normalised(residual: Array, jacobian: Array, columns: Integers, covariance: Array) -> Array:
    """Normalised innovation squared (K,) of K whitened residuals (K, g), each by itself, with Jacobians (K, g, D) by the
    ``columns`` (D,) of a state with this ``covariance`` (S, S)."""
    size, wide = residual.shape[1], len(columns)
    out, left, whitened = np.zeros(len(residual)), np.empty((size, size)), np.empty(size)
    for k in range(len(residual)):
        for i in range(size):
            whitened[i] = residual[k, i]
            for j in range(i + 1):
                spread = 1.0 if i == j else 0.0
                for a in range(wide):
                    if jacobian[k, i, a] != 0.0:
                        carried = 0.0
                        for b in range(wide):
                            carried += covariance[columns[a], columns[b]] * jacobian[k, j, b]
                        spread += jacobian[k, i, a] * carried
                for m in range(j):
                    spread -= left[i, m] * left[j, m]
                # with unit noise a pivot is at least 1, whatever rounding leaves of it
                left[i, j] = math.sqrt(max(spread, 0.5)) if i == j else spread / left[j, j]
            for m in range(i):
                whitened[i] -= left[i, m] * whitened[m]
            whitened[i] /= left[i, i]
            out[k] += whitened[i] * whitened[i]
    return out


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
    """One backward step of the smoother of Rauch, Tung and Striebel (1965): the correction (S,) of a state, and its smoothed
    covariance (S, S).

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
