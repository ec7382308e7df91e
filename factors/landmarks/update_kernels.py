"""The Kalman update by landmarks, compiled: that of :func:`factors.update.update_state`, by information.

A filter makes a dozen small matrices of each look, and NumPy takes longer for each than its arithmetic does.
"""

import math

import numpy as np

from factors.compiled import compiled
from factors.gaussian_kernels import corrected, inverse, normalised
from factors.gaussian_kernels import root as lower_root
from factors.landmarks.kernels import Look, linearize
from factors.landmarks.model import BEARING_SIGMA, PARAMETERS, RANGE_SIGMA, RELATIVE, ROBUST
from factors.robust import geman_mcclure_weight
from factors.se2 import Array, Integers
from factors.se2_kernels import exp

_CONSTANTS = len(PARAMETERS)


@compiled(error_model="numpy")
def updated(
    model: Array,
    look: Look,
    pose: Array,
    covariance: Array,
    values: Array,
    indices: Integers,
    first: int,
    iterations: int,
    converged: float,
    gate: float,
) -> tuple[bool, Array, Array, Array, float, int]:
    """Whether there is an update; the correction (S,) and covariance (S, S) after it; the whitened residuals (K, 2) before it,
    their normalised square, and how many numbers were measured.

    ``model``: of :func:`~factors.landmarks.model.packed`. ``values`` (P,): of the sensor's constants that are estimated;
    ``indices`` (P,): their places in :data:`~factors.landmarks.model.PARAMETERS`; ``first``: of their columns in the error state.
    ``gate``: beyond which a landmark's noise is widened.
    """
    count, size = len(look[0]), len(covariance)
    columns = np.empty(3 + len(values), np.int64)
    for j in range(len(columns)):
        columns[j] = j if j < 3 else first + j - 3
    residual, jacobian = np.empty((count, 2)), np.empty((count, 2, len(columns)))
    _linearized(model, look, pose, values, indices, residual, jacobian)
    measured = 0
    for k in range(count):
        measured += (not math.isnan(look[1][k])) + (not math.isnan(look[2][k]))
    before, weights = np.zeros(size), np.ones(count)
    prior, there = inverse(covariance)
    if not there:
        return False, before, covariance, residual, 0.0, measured
    there, delta, after, pull = corrected(prior, residual, jacobian, columns, weights, before)
    if not there:
        return False, before, covariance, residual, 0.0, measured
    nis, widest, squared = 0.0, 1.0, normalised(residual, jacobian, columns, covariance)
    for k in range(count):
        nis += residual[k, 0] ** 2 + residual[k, 1] ** 2
        widening = max(1.0, squared[k] / gate)
        widest = max(widest, widening)
        weights[k] = 1.0 / (widening * widening)
    for i in range(len(columns)):
        for j in range(len(columns)):
            nis -= pull[i] * after[columns[i], columns[j]] * pull[j]
    if widest > 1.0:
        there, delta, after, _ = corrected(prior, residual, jacobian, columns, weights, before)
    now, moved = residual.copy(), pose.copy()
    for _ in range(iterations - 1):
        if not there or np.abs(delta - before).max() < converged:
            break
        before = delta
        dx, dy, turned = exp(delta[0], delta[1], delta[2])
        c, s = math.cos(pose[2]), math.sin(pose[2])
        moved[0], moved[1], moved[2] = pose[0] + c * dx - s * dy, pose[1] + s * dx + c * dy, pose[2] + turned
        _linearized(model, look, moved, values + delta[columns[3:]], indices, now, jacobian)
        for k in range(count):
            weights[k] = geman_mcclure_weight(now[k, 0] ** 2 + now[k, 1] ** 2, model[ROBUST])
        there, delta, after, _ = corrected(prior, now, jacobian, columns, weights, before)
    there = there and bool(np.all(np.isfinite(delta))) and lower_root(after)[1]
    return there, delta, after, residual, max(0.0, nis), measured


@compiled(error_model="numpy")
def weighted(model: Array, look: Look, pose: Array, values: Array, indices: Integers) -> tuple[Array, Array, Array]:
    """Whitened, robustly weighted residual (2K,) and its Jacobians by the pose (2K, 3) and by the constants (2K, P); arguments as
    of :func:`updated`."""
    count, wide = len(look[0]), len(indices)
    residual, jacobian = np.empty((count, 2)), np.empty((count, 2, 3 + wide))
    _linearized(model, look, pose, values, indices, residual, jacobian)
    out, by_pose, by_values = np.empty(2 * count), np.empty((2 * count, 3)), np.empty((2 * count, wide))
    for k in range(count):
        root = math.sqrt(geman_mcclure_weight(residual[k, 0] ** 2 + residual[k, 1] ** 2, model[ROBUST]))
        for i in range(2):
            row = 2 * k + i
            out[row] = root * residual[k, i]
            for j in range(3):
                by_pose[row, j] = root * jacobian[k, i, j]
            for j in range(wide):
                by_values[row, j] = root * jacobian[k, i, 3 + j]
    return out, by_pose, by_values


@compiled(error_model="numpy")
def innovations(model: Array, residual: Array, ranges: Array, bearings: Array) -> tuple[Array, Array]:
    """Measured less predicted ranges [m] and bearings [rad], of those that were measured, from whitened ``residual`` (K, 2)."""
    by_range, by_bearing = np.empty(len(ranges)), np.empty(len(ranges))
    r = b = 0
    for k in range(len(ranges)):
        if not math.isnan(ranges[k]):
            by_range[r] = -residual[k, 0] * math.hypot(model[RANGE_SIGMA], model[RELATIVE] * ranges[k])
            r += 1
        if not math.isnan(bearings[k]):
            by_bearing[b] = -residual[k, 1] * model[BEARING_SIGMA]
            b += 1
    return by_range[:r], by_bearing[:b]


@compiled(error_model="numpy")
def _linearized(
    model: Array, look: Look, pose: Array, values: Array, indices: Integers, residual: Array, jacobian: Array
) -> None:
    """Whitened residuals (K, 2) at constants that differ by ``values``, and their Jacobian (K, 2, 3+P)."""
    count = len(residual)
    changes = np.zeros(_CONSTANTS)
    for j in range(len(values)):
        changes[indices[j]] = values[j]
    by_pose, by_sensor = np.zeros((count, 2, 3)), np.zeros((count, 2, _CONSTANTS))
    linearize(model, pose, changes, look, residual, by_pose, by_sensor)
    for k in range(count):
        for i in range(2):
            for j in range(3):
                jacobian[k, i, j] = by_pose[k, i, j]
            for j in range(len(values)):
                jacobian[k, i, 3 + j] = by_sensor[k, i, indices[j]]
