"""Views of the points of a graph. A view is the descriptor of a point in one image, with the position of the camera.

The last view of a point is needed to find the point again after its track was lost. Earlier views are stored for the
map. A lost point is searched in the ellipse predicted from pose and point. The feature with the nearest descriptor is
accepted if it is clearly nearer than the second (:func:`factorgraph_loc.vision.matching.match`). Wrong matches are
rejected later, by consensus with other points.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.fusion.graph.graph import Guess
from factorgraph_loc.maps.points import PointMap, carried
from factorgraph_loc.vision.consensus import CameraPose
from factorgraph_loc.vision.frame import CameraFrame
from factorgraph_loc.vision.matching import gates, match
from factors import se2
from factors.camera.kernels import NEAREST
from factors.camera.model import CameraModel, camera_pose, linearize_in_space
from factors.se2 import Array

VIEW_DISTANCE, VIEWS = 0.5, 4  # m: distance travelled between two stored views of a point; most views of a point
NOISE = 3.0  # px: standard deviation of the predicted pixel of a lost point, in addition to the error of the pose
FARTHEST = 15.0  # m: largest depth of a lost point that is searched


@dataclass(frozen=True, slots=True)
class PointView:
    """A view of a point in the image of a keyframe.

    ``descriptor`` (D,): the descriptor of the feature. ``seen_from`` (3,): the camera position in the world frame.
    ``travelled`` [m]: the path length of the robot from the start to this view. ``keyframe``: the key of the keyframe's
    pose. ``guess``: this pose with covariance, as estimated at the time of the view.
    """

    descriptor: NDArray[Any]
    seen_from: Array
    travelled: float
    keyframe: int
    guess: Guess


class PointViews:
    """The last view of each point, by the point's key. Earlier views are stored for the map at the end of a run."""

    def __init__(self, model: CameraModel) -> None:
        self._model = model
        self._views: dict[int, PointView] = {}
        self._earlier: dict[int, list[PointView]] = {}
        self._feature = ""

    def __contains__(self, key: int) -> bool:
        return key in self._views

    def __getitem__(self, key: int) -> PointView:
        return self._views[key]

    def keep(self, point: int, frame: CameraFrame, row: int, travelled: float, keyframe: int, guess: Guess) -> None:
        """Store a view of the point with the key ``point``. ``row``: the row of the point's feature in ``frame``.
        ``travelled`` [m]: the path length of the robot since the start. ``keyframe``, ``guess``: the key and the
        estimate of the pose of the image's keyframe."""
        self._feature = frame.feature
        seen_from = camera_pose(self._model, guess[0])[0]
        view = PointView(frame.descriptors[row], seen_from, travelled, keyframe, guess)
        last_view, earlier = self._views.get(point), self._earlier.setdefault(point, [])
        if (
            last_view is not None
            and len(earlier) < VIEWS - 1
            and (not earlier or last_view.travelled >= earlier[-1].travelled + VIEW_DISTANCE)
        ):
            earlier.append(last_view)
        self._views[point] = view

    def refound(
        self, camera: CameraPose, points: Sequence[int], positions: Array, frame: CameraFrame, rows: Sequence[int]
    ) -> list[tuple[int, int]]:
        """Return pairs (index in ``points``, row of ``frame``) of points that the image shows, although their feature
        tracks were lost.

        ``camera``: the predicted camera pose. ``points``: keys of N points. ``positions`` (N, 3): their estimates.
        ``rows``: the rows of the features in ``frame`` that may be matched.
        """
        if not len(points) or not rows:
            return []
        model = self._model
        projected, by_camera, _ = linearize_in_space(model, camera.position, camera.rotation, positions)
        depth = ((positions - camera.position) @ camera.rotation)[:, 2]
        near = np.flatnonzero(model.contains(projected) & (depth > NEAREST) & (depth < FARTHEST))
        if not len(near):
            return []
        jacobian = by_camera[near]
        covariances = jacobian @ camera.covariance @ jacobian.transpose(0, 2, 1) + NOISE**2 * np.eye(2)
        descriptors, chosen = np.array([self._views[points[i]].descriptor for i in near.tolist()]), list(rows)
        allowed = gates(projected[near], covariances, frame.pixels[chosen])
        matches = match(descriptors, frame.descriptors[chosen], allowed=allowed)
        return [(int(near[a]), rows[b]) for a, b in matches.indices.tolist()]

    def forget(self, points: Iterable[int]) -> None:
        """Delete the views of the points with the keys ``points``."""
        for point in points:
            self._views.pop(point, None)
            self._earlier.pop(point, None)

    def map_of(self, names: Sequence[str], keys: Sequence[int], positions: Array, covariances: Array) -> PointMap:
        """Return a map of N points, each with its last view. ``names``, ``positions`` (N, 3), ``covariances``
        (N, 3, 3): of the points. ``keys``: their keys in the graph."""
        views = [(i, self._views[key]) for i, key in enumerate(keys) if key in self._views]
        return self._with_views(PointMap.of(tuple(names), positions, covariances), views)

    def settled(
        self, points: PointMap, keys: Sequence[int], values: Mapping[int, Array], pose_covariances: Mapping[int, Array]
    ) -> PointMap:
        """Return the map ``points`` with all stored views, computed from the final poses of their keyframes.

        ``keys``: the keys of the points. ``values``: final estimates of keyframe poses and other variables, by key.
        ``pose_covariances``: body-frame covariances of these poses by key. The error of a pose is common to all points
        that were observed from it.
        """
        rows = [
            (i, view)
            for i, key in enumerate(keys)
            if key in self._views
            for view in (
                *(
                    earlier_view
                    for earlier_view in self._earlier[key]
                    if self._views[key].travelled >= earlier_view.travelled + VIEW_DISTANCE
                ),
                self._views[key],
            )
        ]
        if not rows:
            return points
        views = [view for _, view in rows]
        poses = np.array([values.get(view.keyframe, view.guess[0]) for view in views])
        body = np.array([pose_covariances.get(view.keyframe, view.guess[1]) for view in views])
        seen_from = np.array([camera_pose(self._model, pose)[0] for pose in poses])
        common = carried(se2.body_to_world(poses, body), seen_from[:, :2] - poses[:, :2])
        return replace(self._with_views(points, rows), seen_from=seen_from, common=common)

    def _with_views(self, points: PointMap, rows: Sequence[tuple[int, PointView]]) -> PointMap:
        """Return the map ``points`` with views. ``rows``: pairs of the index of a point and one of its views."""
        if not rows:
            return points
        return replace(
            points,
            feature=self._feature,
            owners=np.array([i for i, _ in rows]),
            descriptors=np.array([view.descriptor for _, view in rows]),
            seen_from=np.array([view.seen_from for _, view in rows]),
        )
