"""The last view of each point of a graph."""

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
    """The feature's ``descriptor`` (D,) and ``size`` [px], the camera position ``seen_from`` (3,), and the distance travelled by
    the robot until then, ``way`` [m].
    """

    descriptor: NDArray[Any]
    size: float
    seen_from: Array
    way: float


class PointLooks:
    """The last view of each point, by key."""

    def __init__(self) -> None:
        self._looks: dict[int, Look] = {}
        self._feature = ""

    def __contains__(self, key: int) -> bool:
        return key in self._looks

    def __getitem__(self, key: int) -> Look:
        return self._looks[key]

    def keep(self, key: int, frame: CameraFrame, row: int, seen_from: Array, way: float) -> None:
        """Store the view of a point from the feature ``row`` of a frame."""
        self._feature = frame.feature
        self._looks[key] = Look(frame.descriptors[row], float(frame.sizes[row]), seen_from, way)

    def map_of(self, names: Sequence[str], keys: Sequence[int], positions: Array, covariances: Array) -> PointMap:
        """A map of the points, with their last views, in the given order."""
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
