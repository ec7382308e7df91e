"""The chi-square distribution, of squared whitened errors. As ``scipy.stats.chi2``, which takes half a second to import."""

import numpy as np
import scipy
from numpy.typing import ArrayLike

from factors.se2 import Array


def quantile(probability: ArrayLike, dof: ArrayLike) -> Array:
    """The value that is exceeded with one minus ``probability``, for ``dof`` degrees of freedom."""
    return np.asarray(scipy.special.chdtri(dof, 1.0 - np.asarray(probability)))


def survival(value: ArrayLike, dof: ArrayLike) -> Array:
    """The probability that ``value`` is exceeded."""
    return np.asarray(scipy.special.chdtrc(dof, value))
