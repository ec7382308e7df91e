"""Landmarks of the map."""

from typing import Annotated

from pydantic import Field

from factorgraph_loc.files.models import Coordinate, FileModel
from factorgraph_loc.model.settings import Covariance, spread_of
from factors.se2 import Array


class Landmark(FileModel):
    """A point landmark: position [m] in the world frame and its uncertainty.

    ``sigma``: standard deviation of the survey in x and y [m]. ``covariance``: (xx, xy, yy) [m^2], instead of ``sigma``.
    """

    x: Coordinate
    y: Coordinate
    sigma: Annotated[float, Field(ge=0.0, le=100.0)] = 0.0
    covariance: Covariance | None = None

    def spread(self) -> Array:
        """The covariance (2, 2) of the position [m^2]."""
        return spread_of(self.sigma, self.covariance)
