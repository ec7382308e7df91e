"""Simulation settings of named points in images."""

from typing import Annotated

from pydantic import Field

from factorgraph_loc.files.models import FileModel
from factorgraph_loc.model.settings import Hertz, Metres, Share


class PixelSettings(FileModel):
    """Detection of named points."""

    rate: Hertz = 5.0
    """observations per second"""
    max_points: Annotated[int, Field(ge=1, le=10_000)] = 20
    """most points at once, chosen at random among the visible ones"""
    max_depth: Metres = 10.0
    """distance ahead to which points are seen"""
    wrong: Share = 0.0
    """share of points that are reported at a random pixel"""
