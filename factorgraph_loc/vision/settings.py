"""Settings of feature detection in images."""

from typing import Annotated

from pydantic import Field

from factorgraph_loc.files.models import FileModel
from factorgraph_loc.maps.points import Feature


class FrontendSettings(FileModel):
    """Settings of the detection of features and markers."""

    feature: Feature = "colour"
    """kind of feature to detect, if the map's points have no descriptors"""
    count: Annotated[int, Field(ge=10, le=20_000)] = 500
    """largest number of features per image"""
    everywhere: bool = False
    """whether all parts of an image have equally many features, if possible, not the strongest ones; always so without a map of
    points
    """
