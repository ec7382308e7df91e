"""The last view of each point of a graph."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.fusion.graph_parts import Guess
from factorgraph_loc.maps.common_error import carried
from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.vision.frame import CameraFrame
from factors import se2
from factors.camera.model import CameraModel, camera_pose
from factors.se2 import Array


@dataclass(frozen=True, slots=True)
class Look:
    """The feature's ``descriptor`` (D,) and ``size`` [px], the camera position ``seen_from`` (3,), and the distance travelled by
    the robot until then, ``way`` [m]; the key of the ``keyframe``, and the ``guess`` of its pose.
    """

    descriptor: NDArray[Any]
    size: float
    seen_from: Array
    way: float
    keyframe: int
    guess: Guess


class PointLooks:
    """The last view of each point, by key, by a camera ``model``."""

    def __init__(self, model: CameraModel) -> None:
        self._model = model
        self._looks: dict[int, Look] = {}
        self._feature = ""

    def __contains__(self, key: int) -> bool:
        return key in self._looks

    def __getitem__(self, key: int) -> Look:
        return self._looks[key]

    def keep(self, point: int, frame: CameraFrame, row: int, way: float, keyframe: int, guess: Guess) -> None:
        """Store the view of a ``point`` from the feature ``row`` of a frame, taken at a ``keyframe``."""
        self._feature = frame.feature
        seen_from = camera_pose(self._model, guess[0])[0]
        self._looks[point] = Look(frame.descriptors[row], float(frame.sizes[row]), seen_from, way, keyframe, guess)

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

    def settled(
        self, points: PointMap, keys: Sequence[int], values: Mapping[int, Array], spreads: Mapping[int, Array]
    ) -> PointMap:
        """A map of the points ``keys`` with its views at the poses of their keyframes, which are among ``values``: their body-frame
        covariances among ``spreads`` are those of the error that all points seen from there have in common."""
        if not len(points.owners):
            return points
        looks = [self._looks[keys[i]] for i in points.owners.tolist()]
        poses = np.array([values.get(look.keyframe, look.guess[0]) for look in looks])
        body = np.array([spreads.get(look.keyframe, look.guess[1]) for look in looks])
        seen_from = np.array([camera_pose(self._model, pose)[0] for pose in poses])
        common = carried(se2.body_to_world(poses, body), seen_from[:, :2] - poses[:, :2])
        return replace(points, seen_from=seen_from, common=common)
