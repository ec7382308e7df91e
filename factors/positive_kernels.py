"""Small covariances in compiled code: their roots and inverses by Cholesky's method, as calls of LAPACK take longer."""

import math

import numpy as np

from factors.compiled import compiled
from factors.se2 import Array


@compiled(error_model="numpy")
def root(covariance: Array) -> tuple[Array, bool]:
    """The lower root of a covariance (D, D), of which the lower half is read, and whether there is one."""
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
    """The inverse of a covariance (D, D), of which the lower half is read, and whether there is one."""
    size = len(covariance)
    lower, found = root(covariance)
    out = np.empty((size, size))
    if not found:
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
