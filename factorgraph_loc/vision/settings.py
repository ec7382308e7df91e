"""Settings of the features that are found in images."""

from typing import Annotated

from pydantic import Field

from factorgraph_loc.files.models import FileModel
from factorgraph_loc.maps.points import Feature


class FrontendSettings(FileModel):
    """What is looked for in images: the ``feature`` by its name, and at most how many (``count``) in an image."""

    feature: Feature = "colour"
    count: Annotated[int, Field(ge=10, le=20_000)] = 500
