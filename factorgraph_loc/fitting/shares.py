"""Confidence intervals of proportions."""

import numpy as np
from numpy.typing import ArrayLike

from factors.se2 import Array

_Z = 1.959963984540054  # a standard normal variable is between -_Z and _Z with a probability of 95 %


def wilson(successes: ArrayLike, count: ArrayLike) -> tuple[Array, Array]:
    """Return the lower and upper bounds, two arrays (N,), of the 95 % confidence interval of a proportion, given
    ``successes`` (N,) in ``count`` (N,) trials.

    Wilson, "Probable inference, the law of succession, and statistical inference", Journal of the American Statistical
    Association 22(158), 1927.
    """
    n = np.asarray(count, dtype=float)
    share = np.asarray(successes, dtype=float) / n
    middle = share + _Z**2 / (2.0 * n)
    half = _Z * np.sqrt(share * (1.0 - share) / n + _Z**2 / (4.0 * n**2))
    low, high = ((middle + sign * half) / (1.0 + _Z**2 / n) for sign in (-1.0, 1.0))
    return np.maximum(low, 0.0), np.minimum(high, 1.0)
