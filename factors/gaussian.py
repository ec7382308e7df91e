"""Compiled linear algebra for small matrices, and the prediction and smoothing of Gaussians.

The functions are plain loops for two reasons. A call of LAPACK takes longer than the arithmetic of a small matrix. Numba compiles
NumPy's operations on slices and matrices again into each function that uses them, which takes a second or more each.
"""

import math

import numpy as np

from factors.compiled import compiled
from factors.se2 import Array

# A covariance counts as symmetric if mirrored elements differ by less than this, relative to the standard deviations.
SKEW = 1e-7


@compiled(error_model="numpy")
def product(left: Array, right: Array) -> Array:
    """Return the matrix product (M, N) of ``left`` (M, K) and ``right`` (K, N)."""
    out = np.zeros((left.shape[0], right.shape[1]))
    for i in range(left.shape[0]):
        for k in range(left.shape[1]):
            for j in range(right.shape[1]):
                out[i, j] += left[i, k] * right[k, j]
    return out


@compiled(error_model="numpy")
def product_by_transpose(left: Array, right: Array) -> Array:
    """Return the matrix product (M, N) of ``left`` (M, K) and the transpose of ``right`` (N, K)."""
    out = np.zeros((left.shape[0], right.shape[0]))
    for i in range(left.shape[0]):
        for j in range(right.shape[0]):
            for k in range(left.shape[1]):
                out[i, j] += left[i, k] * right[j, k]
    return out


@compiled(error_model="numpy")
def solved(matrix: Array, right: Array) -> tuple[Array, float]:
    """Solve ``matrix @ x = right`` by Gaussian elimination with pivots.

    ``matrix`` (D, D), ``right`` (D, N). Returns the solution x (D, N) and the logarithm of the absolute determinant of
    the matrix. Raises LinAlgError if the matrix is singular or not finite.
    """
    size, width = matrix.shape[0], right.shape[1]
    left, out, log_determinant = matrix.copy(), right.copy(), 0.0
    for k in range(size):
        pivot = k
        for i in range(k + 1, size):
            if abs(left[i, k]) > abs(left[pivot, k]):
                pivot = i
        if not 0.0 < abs(left[pivot, k]) < np.inf:
            raise np.linalg.LinAlgError("a matrix is singular, or not finite")
        log_determinant += math.log(abs(left[pivot, k]))
        for j in range(size):
            left[k, j], left[pivot, j] = left[pivot, j], left[k, j]
        for j in range(width):
            out[k, j], out[pivot, j] = out[pivot, j], out[k, j]
        for i in range(k + 1, size):
            share = left[i, k] / left[k, k]
            for j in range(k, size):
                left[i, j] -= share * left[k, j]
            for j in range(width):
                out[i, j] -= share * out[k, j]
    _substitute(left, out)
    return out, log_determinant


@compiled(error_model="numpy")
def _substitute(upper: Array, out: Array) -> None:
    """Solve ``upper @ x = out`` for an upper triangular matrix (D, D), and write x (D, N) into ``out`` (D, N). The
    elements below the diagonal of ``upper`` are ignored."""
    size, width = out.shape
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            for j in range(width):
                out[i, j] -= upper[i, k] * out[k, j]
        for j in range(width):
            out[i, j] /= upper[i, i]


@compiled
def put(matrix: Array, out: Array) -> None:
    """Copy a matrix (M, N) into the first M rows and N columns of ``out``, in place."""
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            out[i, j] = matrix[i, j]


@compiled
def inverse(matrix: Array) -> Array:
    """Return the inverse of a matrix (D, D). Raises LinAlgError if the matrix is singular."""
    return solved(matrix, np.eye(len(matrix)))[0]


@compiled(error_model="numpy")
def cholesky(covariance: Array) -> tuple[Array, bool]:
    """Return the lower Cholesky factor (D, D) of a covariance (D, D), and True if the covariance is positive definite.
    If False, the factor is undefined. The elements above the diagonal of the covariance are ignored."""
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
def invert_covariance(covariance: Array) -> Array:
    """Return the inverse of a covariance (D, D). The elements above its diagonal are ignored. Raises LinAlgError if the
    covariance is not positive definite."""
    size = len(covariance)
    lower, exists = cholesky(covariance)
    if not exists:
        raise np.linalg.LinAlgError("a covariance is not positive definite")
    out, back = np.empty((size, size)), np.zeros((size, size))  # ``back`` is the inverse of the lower root
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
    return out


@compiled
def predicted(covariance: Array, transition: Array, noise: Array) -> Array:
    """Predict a ``covariance`` (S, S) over one step. Returns ``F covariance F^T + Q`` (S, S).

    ``transition`` (R, S): the first R rows of the transition matrix F. Its other rows are those of an identity.
    ``noise`` (R, R): the covariance Q of the process noise of the first R components. The others have none.
    """
    rows, moved, out = len(transition), product(transition, covariance), covariance.copy()
    own = product_by_transpose(moved, transition)
    for i in range(rows):
        for j in range(rows, len(out)):
            out[i, j] = out[j, i] = moved[i, j]
        for j in range(rows):
            out[i, j] = own[i, j] + noise[i, j]
    return out


@compiled
def smoothed(covariance: Array, transition: Array, noise: Array, change: Array, later: Array) -> tuple[Array, Array]:
    """Return the results of one backward step of the smoother of Rauch, Tung and Striebel (1965).

    ``covariance`` (S, S): covariance of the filtered state.
    ``transition`` (R, S), ``noise`` (R, R): the prediction step that follows the filtered state, as in
    :func:`predicted`. ``change`` (S,): the smoothed minus the predicted state after that step.
    ``later`` (S, S): the smoothed covariance after that step.

    Returns the correction (S,) of the filtered state, and its smoothed covariance (S, S). Raises LinAlgError if the
    predicted covariance is singular, or if the smoothed covariance is not positive definite because of rounding.
    :func:`factors.positive.smoothed` handles these cases.
    """
    size, prediction, moved = len(covariance), predicted(covariance, transition, noise), product(transition, covariance)
    carried = covariance.copy()  # the full transition matrix times the covariance
    put(moved, carried)
    gain, _ = solved(prediction, carried)  # the transpose of the smoother gain
    for i in range(size):
        for j in range(size):
            prediction[i, j] = later[i, j] - prediction[i, j]
    correction, half, out = np.zeros(size), product(prediction, gain), covariance.copy()
    for k in range(size):
        for i in range(size):
            correction[i] += gain[k, i] * change[k]
            for j in range(size):
                out[i, j] += gain[k, i] * half[k, j]
    for i in range(size):
        for j in range(i):
            skew = out[i, j] - out[j, i]
            if skew * skew > SKEW * SKEW * out[i, i] * out[j, j]:
                raise np.linalg.LinAlgError("a smoothed covariance is not symmetric")
    if not cholesky(out)[1]:
        raise np.linalg.LinAlgError("a smoothed covariance is not positive definite")
    return correction, out
