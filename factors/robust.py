"""Robust losses of squared whitened residuals, and their weights in iteratively reweighted least squares.

Each is half of the squared residual where that is small; the weight is twice the derivative. ``scale``: in standard deviations.
They take numbers and arrays, and may be called in compiled code.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numba.extending import register_jitable

from factors.se2 import Array

Squared = TypeVar("Squared", float, Array)


@register_jitable(inline="always")
def geman_mcclure_loss(squared: Squared, scale: float) -> Squared:
    """At most ``scale^2 / 2``, so that gross outliers have no influence (Geman, McClure, 1985)."""
    return 0.5 * squared / (1.0 + squared / scale**2)


@register_jitable(inline="always")
def geman_mcclure_weight(squared: Squared, scale: float) -> Squared:
    """The weight of :func:`geman_mcclure_loss`."""
    return (1.0 + squared / scale**2) ** -2


@register_jitable(inline="always")
def huber_loss(squared: Squared, scale: float) -> Squared:
    """Linear in the residual beyond ``scale`` (Huber, 1964)."""
    size = np.sqrt(squared)
    inner = np.minimum(size, scale)
    loss: Squared = inner * (size - 0.5 * inner)
    return loss


@register_jitable(inline="always")
def huber_weight(squared: Squared, scale: float) -> Squared:
    """The weight of :func:`huber_loss`."""
    weight: Squared = scale / np.maximum(np.sqrt(squared), scale)
    return weight
