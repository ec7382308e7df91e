"""Matching of an image's features to the points of a map, with or without a predicted camera pose.

With a prediction, a point is searched at its predicted pixel. Points that were never observed from a similar viewpoint
are left out, because they may be occluded. The most similar feature in the gate of a point is accepted if it passes the
ratio test (Lowe, IJCV 60, 2004, section 7.1). The ratio test compares different points only, because all views of one
point are similar. All matches must agree on one pose (:mod:`~factorgraph_loc.vision.consensus`).

Without a prediction, the image is compared with a whole small map, or with the most similar keyframes of a large one
(:mod:`~factorgraph_loc.vision.relocalization`).
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.distance import cdist

from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.vision.consensus import CameraPose, agreeing
from factorgraph_loc.vision.frame import CameraFrame
from factorgraph_loc.vision.keypoints import Descriptors, Float, Integers
from factorgraph_loc.vision.matching import distance_matrix
from factorgraph_loc.vision.relocalization import KeyframeIndex, as_numbers, located
from factors import chi_squared
from factors.camera import model as reprojection
from factors.camera.model import CameraModel
from factors.compiled import compiled
from factors.se2 import Array

RATIO, GLOBAL_RATIO = 0.85, 0.8  # ratio tests with and without a prediction
NEAREST, FARTHEST = 0.2, 50.0  # m: depths of points that are searched
# limits of the angle between two viewpoints of a point, and of the ratio of their distances to the point, if they are similar
LARGEST_ANGLE, LARGEST_RATIO = math.radians(50.0), 2.0
GATE = float(chi_squared.quantile(0.99, 2))
CELL = 20.0  # px, cells for sorting features
# px: value that is added to the radius of each gate, because the prediction is not exact, and largest radius
SMALLEST_GATE, LARGEST_GATE = 3.0, 150.0
MARGIN = 20.0  # px: points that are predicted this far outside the image are still searched
SAME_PIXEL = 4.0  # px: points or features with closer pixels may show the same point
SAME_POINT = 0.15  # m: closer points of the map may be the same point
CHANCE = 0.02  # a match must be more similar than all but this fraction of the pairs of different map points
MANY = 5000  # if a map has more views, only its most similar keyframes are compared with an image
# least number of matches, and least fraction of the visible points that must match. In an office that the map does not contain,
# up to 2 % of the features match by chance
FEWEST, LEAST_SHARE = 3, 0.05
SAMPLED = 300  # number of views in the estimate of the similarity of different points
FEWEST_FOUND, SHARE_FOUND = 12, 0.2  # relocalization: least number and least fraction of inliers among the matches


@dataclass(frozen=True)
class Associations:
    """M matches between points of a map and features of an image.

    ``points`` (M,): the index of the map point of each match. ``features`` (M,): the index of its feature in the image.
    ``rejected``: the number of further matches that were rejected as outliers. ``expected``: the number of map points
    that should be visible in the image. If the pose was not predicted, this is the number of matches before rejection.
    """

    points: Integers
    features: Integers
    expected: int = 0
    rejected: int = 0

    def __len__(self) -> int:
        return len(self.points)


NONE = Associations(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64))


class Associator:
    """Matches features of images to the points of a map. ``points``: the map of points. ``model``: the calibration of
    the camera in the rig. ``feature``: kind of the map's features, such as "sift"."""

    def __init__(self, points: PointMap, model: CameraModel) -> None:
        self.feature = points.feature
        self._model = model
        self._positions = np.ascontiguousarray(points.positions, dtype=float)
        self._covariances = points.covariances
        self._binary = points.descriptors.dtype == np.uint8
        order = np.argsort(points.owners, kind="stable")
        self._owners = points.owners[order]
        self._starts = np.searchsorted(self._owners, np.arange(len(points) + 1)).astype(np.int64)
        self._seen_from = np.ascontiguousarray(points.seen_from[order], dtype=float)
        self._descriptors: Descriptors = points.descriptors[order]
        self._numbers = _numbers(self._descriptors)
        self._keyframes: KeyframeIndex | None = None
        self._largest_cost = self._cost_limit()
        corners = np.array(((-0.5, -0.5), (model.width, -0.5), (-0.5, model.height), (model.width, model.height)))
        # wide enough for an uncertain focal length
        self._slopes = 1.3 * np.abs(reprojection.undistorted(model, corners)).max(axis=0)

    def guided(
        self, frame: CameraFrame, camera: CameraPose, model: CameraModel | None = None, focal: float = 0.0
    ) -> Associations:
        """Return the matches between features of an image and the map points that a camera at a predicted pose sees.

        ``frame``: the features. ``camera``: the predicted pose, with its covariance. ``model``: the current estimate of
        the camera's calibration; None means the calibration of the rig. ``focal``: the standard deviation of the
        logarithm of the focal length. The result is empty if the image has another kind of features than the map.
        """
        model = self._model if model is None else model
        position, rotation = camera.position, camera.rotation
        if len(frame.pixels) == 0 or frame.feature != self.feature:
            return NONE
        x, y, depth = ((self._positions - position) @ rotation).T
        inside = (depth >= NEAREST) & (depth <= FARTHEST) & (np.abs(x) <= self._slopes[0] * depth)
        ahead = np.flatnonzero(inside & (np.abs(y) <= self._slopes[1] * depth))
        views, begins = self._similar_views(ahead, position)
        points = self._positions[ahead]
        predicted, by_camera, by_point = reprojection.linearize_in_space(model, position, rotation, points)
        kept = (np.diff(begins) > 0) & model.contains(predicted, MARGIN)
        if not kept.any():
            return NONE
        covariances = by_point @ self._covariances[ahead] @ by_point.transpose(0, 2, 1)
        covariances += model.sigma**2 * np.eye(2)
        if focal > 0.0:
            away = focal * (predicted - (model.cx, model.cy))
            covariances += away[:, :, None] * away[:, None, :]
        inverses, reaches = _gates(by_camera @ camera.covariance @ by_camera.transpose(0, 2, 1) + covariances)
        features = np.ascontiguousarray(frame.pixels, dtype=float)
        pairs = gated_pairs(predicted[kept], inverses[kept], reaches[kept], features, CELL)
        pairs[:, 0] = np.flatnonzero(kept)[pairs[:, 0]]
        costs = self._costs(pairs, begins, views, frame.descriptors)
        near = costs <= self._largest_cost
        pairs, costs = pairs[near], costs[near]
        ratio = RATIO if self._binary else RATIO**2
        pairs = pairs[clear_pairs(pairs, costs, predicted, features, ratio, SAME_PIXEL)]
        rows, matched_features = pairs[:, 0], pairs[:, 1]
        if len(rows) < FEWEST:
            return Associations(rows[:0], matched_features[:0], int(kept.sum()))
        right = agreeing(model, camera, points[rows], features[matched_features], covariances[rows])
        expected, agreed = int(kept.sum()), int(np.count_nonzero(right))
        if agreed < LEAST_SHARE * min(expected, len(features)):
            right[:] = False
        return Associations(ahead[rows[right]], matched_features[right], expected, int(np.count_nonzero(~right)))

    def _similar_views(self, points: Integers, place: Array) -> tuple[Integers, Integers]:
        """Return the views of ``points`` (C,) from viewpoints similar to the camera position ``place`` (3,).

        A view is an observation of a map point in an image that was used to make the map. The first array (V,) has the
        indices of the selected views, sorted by point. The second array (C + 1,) has the index in the first array where
        the views of each point begin; its last value is V.
        """
        is_wanted = np.zeros(len(self._positions), dtype=bool)
        is_wanted[points] = True
        views = np.flatnonzero(is_wanted[self._owners])
        of_points = self._positions[self._owners[views]]
        rays, old_rays = place - of_points, self._seen_from[views] - of_points
        distances, old_distances = np.linalg.norm(rays, axis=1), np.linalg.norm(old_rays, axis=1)
        views = views[
            (distances <= LARGEST_RATIO * old_distances)
            & (old_distances <= LARGEST_RATIO * distances)
            & (np.einsum("vi,vi->v", rays, old_rays) >= math.cos(LARGEST_ANGLE) * distances * old_distances)
        ]
        return views, np.append(np.searchsorted(self._owners[views], points), len(views))

    def relocalized(self, frame: CameraFrame) -> tuple[CameraPose, Associations] | None:
        """Return the pose of the camera in the map, estimated from one image without a prediction, and the matches.
        Returns None if too few features match for a reliable pose."""
        if len(frame.pixels) == 0 or frame.feature != self.feature or len(self._owners) == 0:
            return None
        points, features = self._match_descriptors(frame)
        pixels = np.asarray(frame.pixels, dtype=float)[features]
        resection = located(self._model, self._positions[points], pixels, self._covariances[points])
        if resection is None:
            return None
        count = int(np.count_nonzero(resection.inliers))
        if count < max(FEWEST_FOUND, SHARE_FOUND * len(points)):
            return None
        associations = Associations(
            points[resection.inliers], features[resection.inliers], len(points), len(points) - count
        )
        return resection.camera, associations

    def _match_descriptors(self, frame: CameraFrame) -> tuple[Integers, Integers]:
        """Return M matches by descriptors alone, as indices of map points (M,) and of features (M,). The point and the
        feature of a match have mutually the most similar descriptors. They also pass the ratio test against all other
        points."""
        owners, descriptors = self._owners, self._descriptors
        if len(owners) > MANY:
            if self._keyframes is None:
                self._keyframes = KeyframeIndex(self._descriptors, self._seen_from)
            views = self._keyframes.views(frame.descriptors)
            owners, descriptors = owners[views], descriptors[views]
        owners, first = np.unique(owners, return_index=True)
        distances = distance_matrix(frame.descriptors, descriptors)
        by_owner = np.minimum.reduceat(distances, first, axis=1)
        best, of_feature = by_owner.argmin(axis=1), np.arange(len(distances))
        positions = self._positions[owners]
        rivals = np.where(cdist(positions[best], positions) > SAME_POINT, by_owner, np.inf)
        kept = by_owner[of_feature, best] < GLOBAL_RATIO * rivals.min(axis=1)
        kept &= by_owner.argmin(axis=0)[best] == of_feature
        return owners[best[kept]], np.flatnonzero(kept)

    def _costs(self, pairs: Integers, begins: Integers, views: Integers, frame_descriptors: Descriptors) -> Array:
        return np.asarray(distances(pairs, begins, views, self._numbers, _numbers(frame_descriptors)))

    def _cost_limit(self) -> float:
        """Return the largest distance between descriptors that a match may have, squared unless descriptors are binary.
        Only the fraction :data:`CHANCE` of the pairs of different map points has a smaller distance. The result is
        infinite if the map has too few points to estimate this."""
        if len(self._starts) < 3 or len(self._owners) == 0:
            return math.inf
        rows = np.linspace(0, len(self._owners) - 1, min(SAMPLED, len(self._owners))).astype(np.int64)
        costs = distance_matrix(self._descriptors[rows], self._descriptors[rows])
        different = costs[self._owners[rows][:, None] != self._owners[rows]]
        if len(different) == 0:
            return math.inf
        limit = float(np.quantile(different, CHANCE))
        return limit if self._binary else limit**2


def _numbers(descriptors: Descriptors) -> Float:
    return np.ascontiguousarray(as_numbers(descriptors), dtype=np.float32)


def _gates(covariances: Array) -> tuple[Array, Array]:
    """Return elliptic gates around C predicted pixels. A measured pixel is accepted if it lies in the gate. Returns the
    matrices A (C, 2, 2) of the ellipses x'Ax = 1, and their largest radii (C,) [px]. ``covariances`` (C, 2, 2) [px^2]:
    of the innovations, measured minus predicted pixel."""
    gates = GATE * covariances
    mean = 0.5 * (gates[:, 0, 0] + gates[:, 1, 1])
    half = np.hypot(0.5 * (gates[:, 0, 0] - gates[:, 1, 1]), gates[:, 0, 1])
    largest = mean + half
    shrink = np.minimum(1.0, LARGEST_GATE**2 / largest)
    gates = shrink[:, None, None] * gates + SMALLEST_GATE**2 * np.eye(2)
    return np.asarray(np.linalg.inv(gates), dtype=float), np.sqrt(shrink * largest + SMALLEST_GATE**2)


@compiled
def gated_pairs(predicted: Array, inverses: Array, reaches: Array, features: Array, cell: float) -> Integers:
    """Return all pairs (N, 2) of a point and a feature in the gate of this point, as indices.

    ``predicted`` (C, 2) [px]: the predicted pixels of the points. ``inverses`` (C, 2, 2): the matrices A of the
    elliptic gates x'Ax = 1. ``reaches`` (C,) [px]: the largest radii of the gates. ``features`` (K, 2) [px]: the pixels
    of the features. ``cell`` [px]: the size of the cells of a grid that speeds up the search.
    """
    low_x, low_y = high_x, high_y = features[0, 0], features[0, 1]
    for i in range(1, len(features)):
        low_x, low_y = min(low_x, features[i, 0]), min(low_y, features[i, 1])
        high_x, high_y = max(high_x, features[i, 0]), max(high_y, features[i, 1])
    columns, lines = int((high_x - low_x) / cell) + 1, int((high_y - low_y) / cell) + 1
    where = np.empty(len(features), np.int64)
    begins, used = np.zeros(columns * lines + 1, np.int64), np.zeros(columns * lines, np.int64)
    for i in range(len(features)):
        where[i] = int((features[i, 1] - low_y) / cell) * columns + int((features[i, 0] - low_x) / cell)
        begins[where[i] + 1] += 1
    for i in range(columns * lines):
        begins[i + 1] += begins[i]
    sorted_features = np.empty(len(features), np.int64)
    for i in range(len(features)):
        sorted_features[begins[where[i]] + used[where[i]]] = i
        used[where[i]] += 1
    pairs = np.empty((1024, 2), np.int64)
    n = 0
    for c in range(len(predicted)):
        u, v, reach = predicted[c, 0], predicted[c, 1], reaches[c]
        x0 = max(0, int(np.floor((u - reach - low_x) / cell)))
        x1 = min(columns - 1, int(np.floor((u + reach - low_x) / cell)))
        y0 = max(0, int(np.floor((v - reach - low_y) / cell)))
        y1 = min(lines - 1, int(np.floor((v + reach - low_y) / cell)))
        if x1 < x0:
            continue
        m = inverses[c]
        for y in range(y0, y1 + 1):
            for j in range(begins[y * columns + x0], begins[y * columns + x1 + 1]):
                f = sorted_features[j]
                du, dv = features[f, 0] - u, features[f, 1] - v
                if m[0, 0] * du * du + 2.0 * m[0, 1] * du * dv + m[1, 1] * dv * dv > 1.0:
                    continue
                if n == len(pairs):
                    longer = np.empty((2 * n, 2), np.int64)
                    for k in range(n):
                        longer[k, 0], longer[k, 1] = pairs[k, 0], pairs[k, 1]
                    pairs = longer
                pairs[n, 0], pairs[n, 1] = c, f
                n += 1
    return pairs[:n]


@compiled(fastmath=True)
def distances(pairs: Integers, begins: Integers, views: Integers, known: Any, frame_descriptors: Any) -> Array:
    """Return the squared distance (N,) between descriptors for N pairs of a map point and a feature.

    A point has a descriptor from each image that shows it (a view). The distance to the most similar view counts.
    ``pairs`` (N, 2): indices of point and feature. ``views[begins[i]:begins[i + 1]]``: indices of the views of point i.
    ``known`` (V, D): the descriptors of the map's views. ``frame_descriptors`` (K, D): the descriptors of the features.
    Binary descriptors have one number per bit, so that the result is the Hamming distance.
    """
    out = np.empty(len(pairs))
    size = known.shape[1]
    for i in range(len(pairs)):
        best = np.float32(np.inf)
        f = frame_descriptors[pairs[i, 1]]
        for j in range(begins[pairs[i, 0]], begins[pairs[i, 0] + 1]):
            k = known[views[j]]
            total = np.float32(0.0)
            for d in range(size):
                total += (f[d] - k[d]) * (f[d] - k[d])
            best = min(best, total)
        out[i] = best
    return out


def clear_pairs(
    pairs: Integers, costs: Array, predicted: Array, features: Array, ratio: float, apart: float
) -> Integers:
    """Return the indices of the pairs that are mutually best and pass the ratio test.

    ``pairs`` (N, 2): indices of point and feature. ``costs`` (N,): distances of their descriptors. ``predicted``
    (C, 2), ``features`` (K, 2) [px]: the pixels of points and features. The cost of a pair must be below ``ratio``
    times the cost of every other pair with the same point or feature. Other pairs with a pixel less than ``apart`` [px]
    away are exempt from the ratio test, because they may show the same point.
    """
    every = np.arange(len(pairs))
    kept = np.ones(len(pairs), dtype=bool)
    for side, places in ((0, features), (1, predicted)):
        owners, partners = pairs[:, side], pairs[:, 1 - side]
        order = np.lexsort((costs, owners))
        _, first, group_of = np.unique(owners[order], return_index=True, return_inverse=True)
        best = np.empty(len(pairs), dtype=np.int64)
        best[order] = order[first][group_of]
        away = np.sum((places[partners[best]] - places[partners]) ** 2, axis=1) > apart**2
        kept &= best == every
        kept[best[(best != every) & (costs[best] >= ratio * costs) & away]] = False
    return np.flatnonzero(kept)
