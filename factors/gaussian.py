"""Small matrices and Gaussians in compiled code: products, solutions, roots and inverses; prediction and smoothing.

Plain loops: calls of LAPACK take longer than the arithmetic of small matrices, and numba compiles NumPy's
operations on slices and matrices again into each function that uses them, in a second or more each.
"""

import math

import numpy as np

from factors.compiled import compiled
from factors.se2 import Array

SKEW = 1e-7  # of two standard deviations: more asymmetry is not one of a few roundings


@compiled(error_model="numpy")
def product(left: Array, right: Array) -> Array:
    """The matrix product (M, N) of ``left`` (M, K) and ``right`` (K, N)."""
    out = np.zeros((left.shape[0], right.shape[1]))
    for i in range(left.shape[0]):
        for k in range(left.shape[1]):
            for j in range(right.shape[1]):
                out[i, j] += left[i, k] * right[k, j]
    return out


@compiled(error_model="numpy")
def product_by_transpose(left: Array, right: Array) -> Array:
    """The matrix product (M, N) of ``left`` (M, K) and the transpose of ``right`` (N, K)."""
    out = np.zeros((left.shape[0], right.shape[0]))
    for i in range(left.shape[0]):
        for j in range(right.shape[0]):
            for k in range(left.shape[1]):
                out[i, j] += left[i, k] * right[j, k]
    return out


@compiled(error_model="numpy")
def solved(matrix: Array, right: Array) -> tuple[Array, float]:
    """The solution (D, N) of ``matrix`` (D, D) times x = ``right`` (D, N), by elimination with pivots, and the logarithm of the
    absolute determinant. LinAlgError if the matrix is singular or not finite."""
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
    """Solve ``upper`` (D, D) x = ``out`` (D, N) in place; only the upper half of ``upper`` is read."""
    size, width = out.shape
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            for j in range(width):
                out[i, j] -= upper[i, k] * out[k, j]
        for j in range(width):
            out[i, j] /= upper[i, i]


@compiled
def put(matrix: Array, out: Array) -> None:
    """Copy a matrix (M, N) into the first rows and columns of ``out``."""
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            out[i, j] = matrix[i, j]


@compiled
def inverse(matrix: Array) -> Array:
    """The inverse of a matrix (D, D). LinAlgError if it is singular."""
    return solved(matrix, np.eye(len(matrix)))[0]


@compiled(error_model="numpy")
def cholesky(covariance: Array) -> tuple[Array, bool]:
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
def invert_covariance(covariance: Array) -> Array:
    """The inverse of a covariance (D, D), whose lower half is read. LinAlgError if it is not positive definite."""
    size = len(covariance)
    lower, exists = cholesky(covariance)
    if not exists:
        raise np.linalg.LinAlgError("a covariance is not positive definite")
    out, back = np.empty((size, size)), np.zeros((size, size))  # ``back``: the inverse of the root
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
    """The predicted covariance (S, S). ``transition`` (R, S): its first rows, the others are those of the identity; ``noise`` (R,
    R): added to the first components."""
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
    """One backward step of the smoother of Rauch, Tung and Striebel (1965): the correction (S,) of a state, and its smoothed
    covariance (S, S). :func:`factors.positive.smoothed` also serves where rounding makes this fail.

    ``covariance`` (S, S): of the filtered state; ``transition`` and ``noise``: of the following step, as in :func:`predicted`. The
    smoothed state after that step differs by ``change`` (S,) from the predicted one, and has the covariance ``later`` (S, S).
    LinAlgError if the predicted covariance is singular, or if rounding leaves no positive definite one.
    """
    size, prediction, moved = len(covariance), predicted(covariance, transition, noise), product(transition, covariance)
    carried = covariance.copy()  # transition times covariance
    put(moved, carried)
    gain, _ = solved(prediction, carried)  # its transpose
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
