"""Matching of an image's features to the points of a map, with or without a predicted camera pose.

With a prediction, a point is searched where it should be visible, if it was observed from a similar viewpoint before, which also
excludes occluded points. The most similar feature in its gate is accepted if it passes the ratio test, and all matches must agree
on one pose (:mod:`~factorgraph_loc.vision.consensus`). Without a prediction, the image is compared with a small map as a whole,
with those keyframes of a large one that look most alike (:mod:`~factorgraph_loc.vision.relocalization`,
:mod:`~factorgraph_loc.vision.places`). Ratio test: Lowe, IJCV 60, 2004, section 7.1, here among different points, as
views of one point are similar.
"""

import math
from dataclasses import dataclass

import numpy as np

from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.vision import association_kernels as kernels
from factorgraph_loc.vision.consensus import CameraPose, agreeing
from factorgraph_loc.vision.frame import CameraFrame
from factorgraph_loc.vision.keypoints import Descriptors, Integers
from factorgraph_loc.vision.matching import distance_matrix
from factorgraph_loc.vision.places import KeyframeLooks
from factorgraph_loc.vision.relocalization import located
from factors import chi_squared
from factors.camera import model as reprojection
from factors.camera.model import CameraModel
from factors.se2 import Array

RATIO, GLOBAL_RATIO = 0.85, 0.8
NEAREST, FARTHEST = 0.2, 50.0  # m, of points that are searched
TURNED, ZOOMED = math.radians(50.0), 2.0  # bounds between views: angle, ratio of distances
GATE = float(chi_squared.quantile(0.99, 2))
CELL = 20.0  # px, cells for sorting features
# px, radius: added for errors of the prediction, and the largest gate
SMALLEST_GATE, LARGEST_GATE = 3.0, 150.0
MARGIN = 20.0  # px around the image in which a predicted point is still searched
SAME = 4.0  # px: closer points and features may be the same
SAME_POINT = 0.15  # m: closer points may be the same
CHANCE = 0.02  # fraction of pairs of different map points that are more similar than a match may be
MANY = 5000  # views of a map, of which only those of the most similar keyframes are compared with an image
# matches, and fraction of the visible points: fewer may be consistent with the prediction by chance. In an office unknown to the
# map up to 2 % of the features are
FEWEST, LEAST_SHARE = 3, 0.05
SAMPLED = 300  # views, to estimate that similarity
FEWEST_FOUND, SHARE_FOUND = 12, 0.2  # matches that must agree in relocalization, and their fraction


@dataclass(frozen=True)
class Associations:
    """Matched ``points`` of the map (M,) and features of an image (M,); ``expected``: number of points searched; ``rejected``:
    number of similar features that were outliers."""

    points: Integers
    features: Integers
    expected: int = 0
    rejected: int = 0

    def __len__(self) -> int:
        return len(self.points)


NONE = Associations(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64))


class Associator:
    """Matches features to a map; see the module."""

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
        self._descriptors: Descriptors = np.ascontiguousarray(points.descriptors[order])
        self._places: KeyframeLooks | None = None
        self._farthest_look = self._look_alike()
        corners = np.array(((-0.5, -0.5), (model.width, -0.5), (-0.5, model.height), (model.width, model.height)))
        # wide enough for an uncertain focal length
        self._slopes = 1.3 * np.abs(reprojection.undistorted(model, corners)).max(axis=0)

    def guided(
        self,
        frame: CameraFrame,
        position: Array,
        rotation: Array,
        covariance: Array,
        model: CameraModel | None = None,
        focal: float = 0.0,
    ) -> Associations:
        """Match with a predicted camera pose ``position`` (3,), ``rotation`` (3, 3) in the world.

        ``covariance`` (6, 6): of a perturbation in the camera's frame, rotation first. ``model``: the current estimate of the
        camera, ``focal``: standard deviation of the logarithm of its focal length."""
        model = self._model if model is None else model
        if len(frame.pixels) == 0 or frame.feature != self.feature:
            return NONE
        x, y, depth = ((self._positions - position) @ rotation).T
        inside = (depth >= NEAREST) & (depth <= FARTHEST) & (np.abs(x) <= self._slopes[0] * depth)
        ahead = np.flatnonzero(inside & (np.abs(y) <= self._slopes[1] * depth))
        views, begins = kernels.agreeing_views(
            ahead, position, self._positions, self._starts, self._seen_from, math.cos(TURNED), ZOOMED
        )
        points = self._positions[ahead]
        predicted, by_camera, by_point = reprojection.linearize_in_space(model, position, rotation, points)
        kept = (np.diff(begins) > 0) & model.contains(predicted, MARGIN)
        if not kept.any():
            return NONE
        spreads = by_point @ self._covariances[ahead] @ by_point.transpose(0, 2, 1)
        spreads += model.sigma**2 * np.eye(2)
        if focal > 0.0:
            away = focal * (predicted - (model.cx, model.cy))
            spreads += away[:, :, None] * away[:, None, :]
        inverses, reaches = _gates(by_camera @ covariance @ by_camera.transpose(0, 2, 1) + spreads)
        features = np.ascontiguousarray(frame.pixels, dtype=float)
        pairs = kernels.gated_pairs(predicted[kept], inverses[kept], reaches[kept], features, CELL)
        pairs[:, 0] = np.flatnonzero(kept)[pairs[:, 0]]
        costs = self._costs(pairs, begins, views, frame.descriptors)
        near = costs <= self._farthest_look
        pairs, costs = pairs[near], costs[near]
        ratio = RATIO if self._binary else RATIO**2
        pairs = pairs[kernels.clear_pairs(pairs, costs, predicted, features, ratio, SAME)]
        rows, seen = pairs[:, 0], pairs[:, 1]
        if len(rows) < FEWEST:
            return Associations(rows[:0], seen[:0], int(kept.sum()))
        camera = CameraPose(position, rotation, covariance)
        right = agreeing(model, camera, points[rows], features[seen], spreads[rows])
        expected, agreed = int(kept.sum()), int(np.count_nonzero(right))
        if agreed < LEAST_SHARE * min(expected, len(features)):
            right[:] = False
        return Associations(ahead[rows[right]], seen[right], expected, int(np.count_nonzero(~right)))

    def relocalized(self, frame: CameraFrame) -> tuple[Array, Array, Array, Associations] | None:
        """Relocalize: camera position (3,), rotation (3, 3), covariance (6, 6) as in :meth:`guided`, and the matches; None if the
        map does not determine the pose."""
        if len(frame.pixels) == 0 or frame.feature != self.feature or len(self._owners) == 0:
            return None
        points, features = self._alike(frame)
        pixels = np.asarray(frame.pixels, dtype=float)[features]
        found = located(self._model, self._positions[points], pixels, self._covariances[points])
        if found is None:
            return None
        count = int(np.count_nonzero(found.inliers))
        if count < max(FEWEST_FOUND, SHARE_FOUND * len(points)):
            return None
        seen = Associations(points[found.inliers], features[found.inliers], len(points), len(points) - count)
        return found.camera.position, found.camera.rotation, found.camera.covariance, seen

    def _alike(self, frame: CameraFrame) -> tuple[Integers, Integers]:
        """Points and features that are similar, and pass the ratio test against all other points."""
        owners, descriptors = self._owners, self._descriptors
        if len(owners) > MANY:
            if self._places is None:
                self._places = KeyframeLooks(self._descriptors, self._seen_from)
            views = self._places.views(frame.descriptors)
            owners, descriptors = owners[views], descriptors[views]
        owners, first = np.unique(owners, return_index=True)
        distances = distance_matrix(frame.descriptors, descriptors, binary=self._binary)
        starts = np.append(first, len(descriptors))
        candidates, nearest, rows = kernels.nearest_owners(distances, starts, min(8, len(owners)))
        best = candidates[:, 0]
        away = np.linalg.norm(self._positions[owners[candidates]] - self._positions[owners[best]][:, None], axis=2)
        others = np.where(away > SAME_POINT, nearest, np.inf).min(axis=1)
        kept = (nearest[:, 0] < GLOBAL_RATIO * others) & (rows[best] == np.arange(len(best)))
        return owners[best[kept]], np.flatnonzero(kept)

    def _costs(self, pairs: Integers, begins: Integers, views: Integers, seen: Descriptors) -> Array:
        if self._binary:
            found = kernels.bit_distances(pairs, begins, views, self._descriptors, seen, kernels.BITS)
        else:
            seen = np.ascontiguousarray(seen, dtype=np.float32)
            found = kernels.distances(pairs, begins, views, self._descriptors, seen)
        return np.asarray(found)

    def _look_alike(self) -> float:
        """Upper limit of the cost of a match: few pairs of views of different points are below it."""
        if len(self._starts) < 3 or len(self._owners) == 0:
            return math.inf
        rows = np.linspace(0, len(self._owners) - 1, min(SAMPLED, len(self._owners))).astype(np.int64)
        costs = distance_matrix(self._descriptors[rows], self._descriptors[rows], binary=self._binary)
        different = costs[self._owners[rows][:, None] != self._owners[rows]]
        if len(different) == 0:
            return math.inf
        limit = float(np.quantile(different, CHANCE))
        return limit if self._binary else limit**2


def _gates(spreads: Array) -> tuple[Array, Array]:
    """Gates of innovations with covariances (C, 2, 2) [px^2]: inverse matrices (C, 2, 2) and largest radii (C,)."""
    gates = GATE * spreads
    mean = 0.5 * (gates[:, 0, 0] + gates[:, 1, 1])
    half = np.hypot(0.5 * (gates[:, 0, 0] - gates[:, 1, 1]), gates[:, 0, 1])
    largest = mean + half
    shrink = np.minimum(1.0, LARGEST_GATE**2 / largest)
    gates = shrink[:, None, None] * gates + SMALLEST_GATE**2 * np.eye(2)
    return np.asarray(np.linalg.inv(gates), dtype=float), np.sqrt(shrink * largest + SMALLEST_GATE**2)
