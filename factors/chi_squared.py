"""The chi-square distribution. Equal to ``scipy.stats.chi2``, which is not used because its import takes half a second."""

import numpy as np
import scipy
from numpy.typing import ArrayLike

from factors.se2 import Array


def quantile(probability: ArrayLike, dof: ArrayLike) -> Array:
    """Return the value that a chi-square variable with ``dof`` degrees of freedom is below with this
    ``probability``."""
    return np.asarray(scipy.special.chdtri(dof, 1.0 - np.asarray(probability)))


def survival(value: ArrayLike, dof: ArrayLike) -> Array:
    """Return the probability that a chi-square variable with ``dof`` degrees of freedom exceeds ``value``."""
    return np.asarray(scipy.special.chdtrc(dof, value))
