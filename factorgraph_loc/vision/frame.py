"""A camera measurement: the features of one image."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from factors.se2 import Array


@dataclass(frozen=True, slots=True)
class CameraFrame:
    """A camera measurement: the K features of one image. The arrays are empty if the image could not be read.

    ``t`` [s]: the time of the image. ``feature``: the kind of features, such as "sift". ``source``: name of the camera.
    ``pixels`` (K, 2) [px]: x right, y down, (0, 0) at the centre of the upper left pixel. ``descriptors`` (K, D).
    ``tracks`` (K,): a number for each feature. Features of different images with the same number show the same point.
    """

    sensor: ClassVar[str] = "camera"
    modality: ClassVar[str] = "camera"
    is_motion: ClassVar[bool] = False
    names: ClassVar[None] = None
    t: float
    feature: str
    pixels: Array
    descriptors: NDArray[Any]
    tracks: NDArray[np.int64]
    source: str = modality

    @property
    def frame(self) -> "CameraFrame":
        """This object. The property exists because it is None for measurements of a camera without features."""
        return self

    @property
    def count(self) -> int:
        """The number of features."""
        return len(self.pixels)
