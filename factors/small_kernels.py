"""Products and solutions of small matrices in compiled code, by plain loops.

What numpy does with matrices and slices is compiled anew into each function that uses it, and takes a second or more of each
process that compiles.
"""

import math

import numpy as np

from factors.compiled import compiled
from factors.se2 import Array


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
    """Solve ``upper`` (D, D), of which the upper half is read, times x = ``out`` (D, N), in place."""
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
