"""A negative log-likelihood as a least-squares residual, with one row more than it has variables.

A cost nll >= 0 with gradient g and positive semi-definite curvature H = L L^T (Fisher information or Gauss-Newton) becomes the
residual ``[L^-1 g; sqrt(2 nll - g^T H^-1 g)]`` with the Jacobian ``[L^T; 0]``. Half its square is nll exactly, its gradient is g
and its curvature H, so a least-squares solver takes the scoring step and evaluates the exact likelihood.

The last row requires ``g^T H^-1 g <= 2 nll``: the minimum of the parabola must not be negative. Otherwise the curvature is too
small for the gradient, and it is raised along g to ``H + t g g^T`` with ``t = 1 / (2 nll) - 1 / (g^T H^-1 g)``. Without curvature
this is Gauss-Newton on the residual sqrt(2 nll).
"""

import math

import numpy as np

from factors.compiled import compiled
from factors.gaussian import cholesky
from factors.se2 import Array

RELATIVE_RIDGE = 1e-9  # of the mean curvature, against division by zero
RIDGE = 1e-10
LEAST = 1e-12  # a cost of zero has no gradient


@compiled(error_model="numpy")
def _whitened(lower: Array, vector: Array, out: Array) -> float:
    """Compute L^-1 v into ``out`` and return its squared norm."""
    squared = 0.0
    for i in range(len(vector)):
        total = vector[i]
        for k in range(i):
            total -= lower[i, k] * out[k]
        out[i] = total / lower[i, i]
        squared += out[i] * out[i]
    return squared


@compiled(error_model="numpy")
def _compressed(nll: float, gradient: Array, information: Array) -> tuple[Array, Array]:
    size, curvature, trace = len(gradient), information.copy(), 0.0
    residual, jacobian = np.empty(size + 1), np.zeros((size + 1, size))
    for i in range(size):
        trace += curvature[i, i]
    for i in range(size):
        curvature[i, i] += RELATIVE_RIDGE * trace / size + RIDGE
    lower, _ = cholesky(curvature)
    squared, floor = _whitened(lower, gradient, residual), max(2.0 * nll, LEAST)
    if squared > floor:
        raised = 1.0 / floor - 1.0 / squared
        for i in range(size):
            for j in range(size):
                curvature[i, j] += raised * gradient[i] * gradient[j]
        lower, _ = cholesky(curvature)
        squared = _whitened(lower, gradient, residual)
    residual[size] = math.sqrt(max(2.0 * nll - squared, 0.0))
    for i in range(size):
        for j in range(i + 1):
            jacobian[j, i] = lower[i, j]
    return residual, jacobian


def compressed(nll: float, gradient: Array, information: Array) -> tuple[Array, Array]:
    """Residual (d + 1,) and Jacobian (d + 1, d) of a cost ``nll`` >= 0 with ``gradient`` (d,) and symmetric positive semi-definite
    ``information`` (d, d); see the module. All are finite for any rank of the information."""
    arrays = np.ascontiguousarray(gradient, dtype=float), np.ascontiguousarray(information, dtype=float)
    residual, jacobian = _compressed(float(nll), *arrays)
    return residual, jacobian
