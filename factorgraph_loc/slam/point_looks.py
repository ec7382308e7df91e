"""The views of each point of a graph: the last one, and some before it for a map.

A point whose track was lost is matched by the descriptor of its last view: within the ellipse predicted from pose and point, the
nearest descriptor is accepted if it is clearly nearer than the second
(:func:`factorgraph_loc.vision.matching.match_guided`). Wrong matches are rejected later, by consensus with other points.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.fusion.graph.graph import Guess
from factorgraph_loc.maps.common_error import carried
from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.vision.consensus import CameraPose
from factorgraph_loc.vision.frame import CameraFrame
from factorgraph_loc.vision.matching import match_guided
from factors import se2
from factors.camera.kernels import NEAREST
from factors.camera.model import CameraModel, camera_pose, linearize_in_space
from factors.se2 import Array

APART, VIEWS = 0.5, 4  # m travelled between views that a map keeps, and their number for each point
NOISE = 3.0  # px: of the predicted pixel of a lost point, in addition to the error of the pose
FARTHEST = 15.0  # m of its depth


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
    """The last view of each point, by key, by a camera ``model``; others are there for the map at the end."""

    def __init__(self, model: CameraModel) -> None:
        self._model = model
        self._looks: dict[int, Look] = {}
        self._earlier: dict[int, list[Look]] = {}
        self._feature = ""

    def __contains__(self, key: int) -> bool:
        return key in self._looks

    def __getitem__(self, key: int) -> Look:
        return self._looks[key]

    def keep(self, point: int, frame: CameraFrame, row: int, way: float, keyframe: int, guess: Guess) -> None:
        """Store the view of a ``point`` from the feature ``row`` of a frame, taken at a ``keyframe``."""
        self._feature = frame.feature
        seen_from = camera_pose(self._model, guess[0])[0]
        look = Look(frame.descriptors[row], float(frame.sizes[row]), seen_from, way, keyframe, guess)
        before, earlier = self._looks.get(point), self._earlier.setdefault(point, [])
        if before is not None and len(earlier) < VIEWS - 1 and (not earlier or before.way >= earlier[-1].way + APART):
            earlier.append(before)
        self._looks[point] = look

    def refound(
        self, camera: CameraPose, points: Sequence[int], positions: Array, frame: CameraFrame, rows: Sequence[int]
    ) -> list[tuple[int, int]]:
        """Pairs of a point, by its place in ``points`` (N,) with ``positions`` (N, 3), and of its match among the features ``rows``
        of a frame taken from about ``camera``."""
        if not len(points) or not rows:
            return []
        model = self._model
        seen, by_camera, _ = linearize_in_space(model, camera.position, camera.rotation, positions)
        depth = ((positions - camera.position) @ camera.rotation)[:, 2]
        near = np.flatnonzero(model.contains(seen) & (depth > NEAREST) & (depth < FARTHEST))
        if not len(near):
            return []
        jacobian = by_camera[near]
        spreads = jacobian @ camera.covariance @ jacobian.transpose(0, 2, 1) + NOISE**2 * np.eye(2)
        descriptors, chosen = np.array([self._looks[points[i]].descriptor for i in near.tolist()]), list(rows)
        offered, pixels = frame.descriptors[chosen], frame.pixels[chosen]
        found = match_guided(descriptors, offered, seen[near], spreads, pixels, binary=offered.dtype == np.uint8)
        return [(int(near[a]), rows[b]) for a, b in found.indices.tolist()]

    def forget(self, points: Iterable[int]) -> None:
        """Forget the views of these points, by key."""
        for point in points:
            self._looks.pop(point, None)
            self._earlier.pop(point, None)

    def map_of(self, names: Sequence[str], keys: Sequence[int], positions: Array, covariances: Array) -> PointMap:
        """A map of the points, with their last views, in the given order."""
        looks = [(i, self._looks[key]) for i, key in enumerate(keys) if key in self._looks]
        return self._seen(PointMap.of(tuple(names), positions, covariances), looks)

    def settled(
        self, points: PointMap, keys: Sequence[int], values: Mapping[int, Array], spreads: Mapping[int, Array]
    ) -> PointMap:
        """The map of the points ``keys`` with all their views at the poses of their keyframes, which are among ``values``: their
        body-frame covariances among ``spreads`` are those of the error that all points seen from there have in common."""
        rows = [
            (i, look)
            for i, key in enumerate(keys)
            if key in self._looks
            for look in (
                *(one for one in self._earlier[key] if self._looks[key].way >= one.way + APART),
                self._looks[key],
            )
        ]
        if not rows:
            return points
        looks = [look for _, look in rows]
        poses = np.array([values.get(look.keyframe, look.guess[0]) for look in looks])
        body = np.array([spreads.get(look.keyframe, look.guess[1]) for look in looks])
        seen_from = np.array([camera_pose(self._model, pose)[0] for pose in poses])
        common = carried(se2.body_to_world(poses, body), seen_from[:, :2] - poses[:, :2])
        return replace(self._seen(points, rows), seen_from=seen_from, common=common)

    def _seen(self, points: PointMap, rows: Sequence[tuple[int, Look]]) -> PointMap:
        """The map with these views, each with the number of its point."""
        if not rows:
            return points
        return replace(
            points,
            feature=self._feature,
            owners=np.array([i for i, _ in rows]),
            descriptors=np.array([look.descriptor for _, look in rows]),
            seen_from=np.array([look.seen_from for _, look in rows]),
            sizes=np.array([look.size for _, look in rows]),
        )
