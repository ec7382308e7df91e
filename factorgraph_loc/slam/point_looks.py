"""What the points of a graph looked like when they were seen last."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.vision.frame import CameraFrame
from factors.se2 import Array


@dataclass(frozen=True, slots=True)
class Look:
    """The feature's ``descriptor`` (D,) and ``size`` [px], where the camera was, ``seen_from`` (3,), and how far the robot had gone
    by then, ``way`` [m]."""

    descriptor: NDArray[Any]
    size: float
    seen_from: Array
    way: float


class PointLooks:
    """The last look of each point, by its key."""

    def __init__(self) -> None:
        self._looks: dict[int, Look] = {}
        self._feature = ""

    def __contains__(self, key: int) -> bool:
        return key in self._looks

    def __getitem__(self, key: int) -> Look:
        return self._looks[key]

    def keep(self, key: int, frame: CameraFrame, row: int, seen_from: Array, way: float) -> None:
        """A point was seen as one of the features of a frame."""
        self._feature = frame.feature
        self._looks[key] = Look(frame.descriptors[row], float(frame.sizes[row]), seen_from, way)

    def map_of(self, names: Sequence[str], keys: Sequence[int], positions: Array, covariances: Array) -> PointMap:
        """Points with a view each where there is one, in their order."""
        shown = [i for i, key in enumerate(keys) if key in self._looks]
        if not shown:
            return PointMap.of(tuple(names), positions, covariances)
        looks = [self._looks[keys[i]] for i in shown]
        return PointMap(
            tuple(names),
            positions,
            covariances,
            self._feature,
            np.array(shown),
            np.array([look.descriptor for look in looks]),
            np.array([look.seen_from for look in looks]),
            np.array([look.size for look in looks]),
        )
