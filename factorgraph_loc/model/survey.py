"""Uncertainty of a surveyed position."""

from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field

from factorgraph_loc.files.models import InUnit
from factors.se2 import Array


def _positive_semidefinite(value: tuple[float, float, float]) -> tuple[float, float, float]:
    xx, xy, yy = value
    # rounding may make the determinant of a singular matrix slightly negative
    if xx < 0.0 or yy < 0.0 or xy * xy > xx * yy * (1.0 + 1e-9):
        raise ValueError("expected (xx, xy, yy) [m^2] of a positive semi-definite matrix")
    return value


Variance = Annotated[float, Field(ge=-1e8, le=1e8), InUnit("m^2")]
Covariance = Annotated[tuple[Variance, Variance, Variance], AfterValidator(_positive_semidefinite)]


def spread_of(sigma: float, covariance: tuple[float, float, float] | None) -> Array:
    """The covariance (2, 2) [m^2] of a position, from (xx, xy, yy) if given, else from the standard deviation ``sigma`` [m]."""
    if covariance is None:
        return sigma**2 * np.eye(2)
    xx, xy, yy = covariance
    return np.array(((xx, xy), (xy, yy)))
