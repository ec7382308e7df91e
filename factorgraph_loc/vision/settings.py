"""Settings of feature detection in images."""

from typing import Annotated

from pydantic import Field

from factorgraph_loc.files.models import FileModel
from factorgraph_loc.maps.points import Feature


class FrontendSettings(FileModel):
    """The ``feature`` to detect, by name, and the maximum number (``count``) per image."""

    feature: Feature = "colour"
    count: Annotated[int, Field(ge=10, le=20_000)] = 500
