"""Losses of the whitened residuals of landmarks, and their weights: robust ones, and mixtures for ranges that may be late."""

import math

import numpy as np

from factors.compiled import compiled
from factors.landmarks.late import EXACT, mixture, moments
from factors.landmarks.model import CONSTANTS, LATE, ROBUST
from factors.robust import geman_mcclure_loss, geman_mcclure_weight
from factors.se2 import Array, Integers


@compiled
def slopes(error: Array, jacobian: Array, ranges: Array, bearings: Array, out: Array) -> None:
    """Write the derivatives of K whitened range residuals by the predicted ranges into ``out`` (K,) [1/m]. Only a
    landmark with a range and no bearing can be late. For others, 0 is written. ``error`` (K, 2), ``jacobian`` (K, 2, WIDTH): the
    outputs of :func:`factors.landmarks.kernels.linearize`. ``ranges``, ``bearings`` (K,): measured, NaN if missing."""
    for k in range(len(ranges)):
        alone = math.isnan(bearings[k]) and not math.isnan(ranges[k])
        # the residual is (predicted - measured) * slope, and its derivative by the relative range scale is predicted * slope
        out[k] = (jacobian[k, 0, CONSTANTS + 3] - error[k, 0]) / ranges[k] if alone else 0.0


@compiled
def loss(model: Array, error: Array, slopes: Array) -> float:
    """Return the sum of the robust losses of K landmarks. ``model`` (14,): the array ``packed`` of a
    :class:`~factors.landmarks.model.BearingRangeModel`. ``error`` (K, 2): the whitened residuals. ``slopes`` (K,):
    their derivatives by the predicted ranges [1/m], from :func:`slopes`."""
    total = 0.0
    for k in range(len(error)):
        if slopes[k] > 0.0 and model[LATE] > 0.0:
            total += mixture(error[k, 0], slopes[k], model[ROBUST], model[LATE], model[LATE + 1], model[LATE + 2])[0]
        else:
            total += geman_mcclure_loss(error[k, 0] ** 2 + error[k, 1] ** 2, model[ROBUST])
    return total


@compiled
def reweigh(model: Array, error: Array, slopes: Array, weights: Array) -> None:
    """Write the weights of K squared residuals for iteratively reweighted least squares into ``weights`` (K,).
    ``error`` (K, 2): the whitened residuals. A range residual changes in place if the range may be late (too long).
    Weight times error is then the derivative of the loss. ``model``, ``slopes`` (K,): as in :func:`loss`."""
    for k in range(len(error)):
        if slopes[k] > 0.0 and model[LATE] > 0.0:
            late = model[ROBUST], model[LATE], model[LATE + 1], model[LATE + 2]
            _, derivative, weights[k] = mixture(error[k, 0], slopes[k], *late)
            error[k, 0] = derivative / weights[k]
        else:
            weights[k] = geman_mcclure_weight(error[k, 0] ** 2 + error[k, 1] ** 2, model[ROBUST])


@compiled
def weigh(model: Array, error: Array, jacobian: Array, slopes: Array) -> None:
    """Multiply the whitened residuals ``error`` (K, 2) and their ``jacobian`` (K, 2, D) in place by square roots of
    weights. The weights are those of :func:`reweigh`, which is called first with ``model`` and ``slopes``."""
    weights = np.empty(len(error))
    reweigh(model, error, slopes, weights)
    for k in range(len(error)):
        root = math.sqrt(weights[k])
        for i in range(2):
            error[k, i] *= root
            for j in range(jacobian.shape[2]):
                jacobian[k, i, j] *= root


@compiled(error_model="numpy")
def resolve(
    model: Array,
    error: Array,
    jacobian: Array,
    columns: Integers,
    covariance: Array,
    slopes: Array,
    gate: float,
    weights: Array,
    squared: Array,
) -> bool:
    """Replace ranges that may be late (too long) by Gaussian measurements, see :func:`factors.landmarks.late.moments`.
    Changes their elements of ``error``, ``weights`` and ``squared`` in place. Returns True if there are such ranges.

    ``error`` (K, 2), ``jacobian`` (K, 2, D): whitened residuals at the prediction, and their Jacobian. ``columns``
    (D,): the components of the state that the residuals depend on. ``covariance`` (S, S): covariance of the state.
    ``weights`` (K,): the weights of the squared residuals. ``squared`` (K,): the normalised innovations squared.
    ``gate``: the limit of the latter, above which the noise is increased. ``model``, ``slopes``: as in :func:`loss`.
    """
    some = False
    for k in range(len(error)):
        if slopes[k] > 0.0 and model[LATE] > 0.0:
            some, row, variance = True, jacobian[k, 0], 0.0
            for a in range(len(columns)):
                for b in range(len(columns)):
                    variance += row[a] * covariance[columns[a], columns[b]] * row[b]
            prediction, late = (error[k, 0], slopes[k]), (model[LATE], model[LATE + 1], model[LATE + 2])
            if variance > EXACT:
                corrected = moments(*prediction, variance, model[ROBUST], gate, *late)
                error[k, 0], weights[k], squared[k] = corrected
            else:
                _, derivative, weights[k] = mixture(*prediction, model[ROBUST], *late)
                error[k, 0] = derivative / weights[k]
    return some
