"""How well a surveyed position is known."""

from typing import Annotated

from pydantic import AfterValidator, Field


def _positive_semidefinite(value: tuple[float, float, float]) -> tuple[float, float, float]:
    xx, xy, yy = value
    # of a singular matrix the determinant may round to a little below zero
    if xx < 0.0 or yy < 0.0 or xy * xy > xx * yy * (1.0 + 1e-9):
        raise ValueError("expected (xx, xy, yy) [m^2] of a positive semi-definite matrix")
    return value


Variance = Annotated[float, Field(ge=-1e8, le=1e8, description="m^2")]
Covariance = Annotated[tuple[Variance, Variance, Variance], AfterValidator(_positive_semidefinite)]
