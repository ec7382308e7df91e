"""What is simulated of identified points in images."""

from typing import Annotated

from pydantic import Field

from factorgraph_loc.files.models import FileModel
from factorgraph_loc.model.simulation_units import Hertz, Metres, Share


class PixelSettings(FileModel):
    """Which named points the camera identifies: at ``rate`` looks per second at most ``max_points`` of those in sight, chosen at
    random, that are at most ``max_depth`` ahead. A share ``wrong`` of them is reported anywhere in the image."""

    rate: Hertz = 5.0
    max_points: Annotated[int, Field(ge=1, le=10_000)] = 20
    max_depth: Metres = 10.0
    wrong: Share = 0.0
