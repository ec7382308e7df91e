"""Simulation settings of named points in images."""

from typing import Annotated

from pydantic import Field

from factorgraph_loc.files.models import FileModel
from factorgraph_loc.model.settings import Hertz, Metres, Share


class PixelSettings(FileModel):
    """Detection of named points: ``rate`` images per second, each with at most ``max_points`` random visible points of at most
    ``max_depth``. A share ``wrong`` of them is reported at a random pixel."""

    rate: Hertz = 5.0
    max_points: Annotated[int, Field(ge=1, le=10_000)] = 20
    max_depth: Metres = 10.0
    wrong: Share = 0.0
