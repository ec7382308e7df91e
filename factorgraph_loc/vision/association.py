"""Which features of an image show which points of a map: with a prediction of the camera's pose, or without any.

With one, a point is looked for where it should be seen, if it has been seen from about there before, which also leaves out what a
wall hides; of what looks alike in its gate the clearly nearest is taken, and all that are taken must agree on one pose
(:mod:`~factorgraph_loc.vision.consensus`). Without one, the whole map is compared with the image
(:mod:`~factorgraph_loc.vision.relocalization`). Ratio test: Lowe, IJCV 60, 2004, section 7.1, here among different points, as views
of one look alike.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.vision import association_kernels as kernels
from factorgraph_loc.vision.consensus import CameraPose, agreeing
from factorgraph_loc.vision.frame import CameraFrame
from factorgraph_loc.vision.keypoints import Descriptors, Integers
from factorgraph_loc.vision.matching import distance_matrix
from factorgraph_loc.vision.relocalization import located
from factors.camera import model as reprojection
from factors.camera.model import CameraModel
from factors.se2 import Array

RATIO, GLOBAL_RATIO = 0.85, 0.8
NEAREST, FARTHEST = 0.2, 50.0  # m, of points that are looked for
TURNED, ZOOMED = math.radians(50.0), 2.0  # between the views of a point: of their directions, and of their distances
GATE = float(chi2.ppf(0.99, 2))
CELL = 20.0  # px, of the cells that features are sorted into
# px, half the diameter: for what the prediction lacks, and for what may be searched
SMALLEST_GATE, LARGEST_GATE = 3.0, 150.0
MARGIN = 20.0  # px around the image in which a point may be predicted
SAME = 4.0  # px: points and features that are nearer may be one
SAME_POINT = 0.15  # m: points that are nearer may be one
CHANCE = 0.02  # share of the map's different points that look more alike than a match may
# matches, and their share of what could be seen: fewer may agree with the prediction by chance. Of an office that the map does not
# know up to 2 % of the features agree
FEWEST, LEAST_SHARE = 3, 0.05
SAMPLED = 300  # views, to tell that
FEWEST_FOUND, SHARE_FOUND = 12, 0.2  # matches that must agree on a place without a prediction, and their share


@dataclass(frozen=True)
class Associations:
    """Which points of the map (M,) are shown by which features of an image (M,); ``expected``: how many points were looked for;
    ``rejected``: how many that looked right did not agree with the others."""

    points: Integers
    features: Integers
    expected: int = 0
    rejected: int = 0

    def __len__(self) -> int:
        return len(self.points)


NONE = Associations(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64))


class Associator:
    """Features against a map; see the module."""

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
        self._farthest_look = self._look_alike()
        corners = np.array(((-0.5, -0.5), (model.width, -0.5), (-0.5, model.height), (model.width, model.height)))
        # wide enough for a focal length that is not known well
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
        """What is seen from about ``position`` (3,), with ``rotation`` (3, 3) of the camera in the world; ``covariance`` (6, 6): of
        the camera's perturbation in its own frame, turn first, then shift. ``model``: of the camera as it is believed by now,
        ``focal``: standard deviation of the logarithm of its focal length."""
        model = self._model if model is None else model
        if len(frame.pixels) == 0 or frame.feature != self.feature:
            return NONE
        ahead = kernels.in_view(self._positions, position, rotation, NEAREST, FARTHEST, self._slopes)
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
        """Position (3,), rotation (3, 3) and covariance (6, 6), as in :meth:`guided`, of the camera, with what it sees; None where
        the map does not tell."""
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
        """Points and features that look alike, and clearly more than any other point does."""
        owners, first = np.unique(self._owners, return_index=True)
        distances = distance_matrix(frame.descriptors, self._descriptors, binary=self._binary)
        nearest = np.minimum.reduceat(distances, first, axis=1)
        rows = np.arange(len(nearest))
        few = min(8, nearest.shape[1])
        candidates = np.argpartition(nearest, few - 1, axis=1)[:, :few]
        candidates = np.take_along_axis(candidates, np.argsort(nearest[rows[:, None], candidates], axis=1), axis=1)
        best = candidates[:, 0]
        away = np.linalg.norm(self._positions[owners[candidates]] - self._positions[owners[best]][:, None], axis=2)
        others = np.where(away > SAME_POINT, nearest[rows[:, None], candidates], np.inf).min(axis=1)
        kept = (nearest[rows, best] < GLOBAL_RATIO * others) & (nearest[:, best].argmin(axis=0) == rows)
        return owners[best[kept]], np.flatnonzero(kept)

    def _costs(self, pairs: Integers, begins: Integers, views: Integers, seen: Descriptors) -> Array:
        if self._binary:
            found = kernels.bit_distances(pairs, begins, views, self._descriptors, seen, kernels.BITS)
        else:
            seen = np.ascontiguousarray(seen, dtype=np.float32)
            found = kernels.distances(pairs, begins, views, self._descriptors, seen)
        return np.asarray(found)

    def _look_alike(self) -> float:
        """The cost that few pairs of views of different points stay below: a match must."""
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
    """Of innovations with covariances (C, 2, 2) [px^2] the gates' matrices, inverted (C, 2, 2), and half their largest diameters
    (C,): none is smaller or larger than is sensible."""
    gates = GATE * spreads
    mean = 0.5 * (gates[:, 0, 0] + gates[:, 1, 1])
    half = np.hypot(0.5 * (gates[:, 0, 0] - gates[:, 1, 1]), gates[:, 0, 1])
    largest = mean + half
    shrink = np.minimum(1.0, LARGEST_GATE**2 / largest)
    gates = shrink[:, None, None] * gates + SMALLEST_GATE**2 * np.eye(2)
    return np.asarray(np.linalg.inv(gates), dtype=float), np.sqrt(shrink * largest + SMALLEST_GATE**2)
