"""The features of one image."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from factors.se2 import Array


@dataclass(frozen=True, slots=True)
class CameraFrame:
    """The features of one image, empty if it could not be read.

    ``pixels`` (K, 2) [px], x right, y down, (0, 0) at the centre of the upper left pixel; ``descriptors`` (K, D) of the kind
    ``feature``. ``tracks`` (K,): numbers of the tracks that features belong to.
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
        """The features; empty arrays without features."""
        return self

    @property
    def count(self) -> int:
        """Number of features."""
        return len(self.pixels)
