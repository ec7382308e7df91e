"""Robust losses of squared whitened residuals, and their weights in iteratively reweighted least squares.

For small residuals, each loss equals half of the squared residual. The weight is twice the derivative of the loss by the squared
residual. ``scale``: the scale of the loss in standard deviations. The functions accept numbers and arrays, also in compiled code.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numba.extending import register_jitable

from factors.se2 import Array

Squared = TypeVar("Squared", float, Array)


@register_jitable(inline="always")
def geman_mcclure_loss(squared: Squared, scale: float) -> Squared:
    """Return the loss of Geman and McClure (1985) for ``squared``, the squared norms of whitened residuals. Beyond
    ``scale`` standard deviations it converges to ``scale^2 / 2``. Gross outliers therefore have no influence."""
    return 0.5 * squared / (1.0 + squared / scale**2)


@register_jitable(inline="always")
def geman_mcclure_weight(squared: Squared, scale: float) -> Squared:
    """Return the weights for ``squared``, the squared norms of whitened residuals, in iteratively reweighted least
    squares with :func:`geman_mcclure_loss`. ``scale``: a number of standard deviations."""
    return (1.0 + squared / scale**2) ** -2


@register_jitable(inline="always")
def huber_loss(squared: Squared, scale: float) -> Squared:
    """Return the loss of Huber (1964) for ``squared``, the squared norms of whitened residuals. It is linear in the
    residual beyond ``scale`` standard deviations."""
    size = np.sqrt(squared)
    inner = np.minimum(size, scale)
    loss: Squared = inner * (size - 0.5 * inner)
    return loss


@register_jitable(inline="always")
def huber_weight(squared: Squared, scale: float) -> Squared:
    """Return the weights for ``squared``, the squared norms of whitened residuals, in iteratively reweighted least
    squares with :func:`huber_loss`. ``scale``: a number of standard deviations."""
    weight: Squared = scale / np.maximum(np.sqrt(squared), scale)
    return weight
