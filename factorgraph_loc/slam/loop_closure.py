"""Loop closure without a map: recognition of points of the graph that were last observed long ago.

About once a second, an image is compared with the old points that may be visible in it. Features are matched without
a predicted pose (Associator.relocalized of :mod:`factorgraph_loc.vision.association`). The resulting pose must be on
the floor. The points are matched again with this pose as the prediction. Enough of the visible points must match, in
all parts of the image. Places in a building resemble each other. Therefore the poses of consecutive images must agree
with the odometry between them. Their distance from the estimated track must be a possible drift. Geometric verification
and consistency over consecutive images: Cadena, Galvez-Lopez, Tardos, Neira, IEEE Transactions on Robotics 28(4), 2012.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from factorgraph_loc.fusion.graph.graph import Guess, Keyframe
from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.sensors.camera.known_points import lifted
from factorgraph_loc.vision.association import LARGEST_ANGLE, LARGEST_RATIO, Associations, Associator
from factorgraph_loc.vision.consensus import CameraPose, Truths
from factorgraph_loc.vision.frame import CameraFrame
from factorgraph_loc.vision.keypoints import Integers
from factorgraph_loc.vision.relocalization import FoundOnFloor, on_floor
from factors import positive, se2
from factors.camera.model import CameraModel
from factors.se2 import Array

INTERVAL = 0.9  # s between images that are compared
SUCCESSIVE, BREAK = 3, 3.0  # number of consecutive images that must agree, and the maximum time [s] between two of them
MOTION_SIGMAS = np.array((0.1, 0.1, 0.03))  # m, m, rad: standard deviations of the motion between two such images
FEWEST = 15  # least number of old points that must match
LEAST_SHARE = 0.1  # least fraction of the visible old points that must match
GRID, CELLS = (6, 4), 7  # cells of the image, and how many of them must contain a matched point
# standard deviations (m, m, rad) that are added to the covariance of the estimated pose: a constant, and per metre travelled
DRIFT, DRIFT_PER_METRE = np.array((0.05, 0.05, 0.02)), np.array((0.003, 0.003, 0.0005))
GATE = 16.3  # 99.9 % of chi-square with three degrees of freedom
LARGEST_SHIFT, LARGEST_TURN = 1.0, 0.3  # m, rad: largest error of the estimated pose for which old points are searched
FARTHEST = 15.0  # m: largest distance of a point that is searched


@dataclass(frozen=True)
class OldPoints:
    """N points of the graph that were last observed long ago. ``points``: the positions, which may be outdated, with
    the descriptor of one view of each point. ``keys``: the points' keys in the graph. ``travelled`` (N,): the path
    length of the robot [m] at the last observation of each point."""

    points: PointMap
    keys: Sequence[int]
    travelled: Array


@dataclass(frozen=True)
class Image:
    """The image of a new keyframe. ``frame``: its features. ``keyframe``: the keyframe. ``guess``: the predicted pose
    of the keyframe with covariance. ``travelled``: the path length of the robot since the start [m]."""

    frame: CameraFrame
    keyframe: Keyframe
    guess: Guess
    travelled: float


@dataclass(frozen=True)
class Revisit:
    """A keyframe whose image shows points that were last observed long ago ("old" points).

    ``pose`` (3,): the keyframe's pose, computed from these points. ``points`` (M,): indices of the recognized old
    points. ``features`` (M,): indices of the matching features of the image.
    """

    keyframe: Keyframe
    pose: Array
    points: Integers
    features: Integers


class LoopClosure:
    """A detector of loop closures. A loop is closed if several consecutive images show points that were last observed
    long ago, from consistent poses."""

    def __init__(self) -> None:
        self._agreeing: list[Revisit] = []  # revisits of the last consecutive images, which agree with each other
        self._last_time = -math.inf  # s; the time of the last image that was compared

    def is_due(self, t: float) -> bool:
        """Return True if the time ``t`` [s] is at least :data:`INTERVAL` after the last image that was compared with
        old points."""
        return t >= self._last_time + INTERVAL

    def compare(
        self, model: CameraModel, image: Image, old: OldPoints, current: Callable[[int], Array]
    ) -> Revisit | None:
        """Return the recognized ``old`` points and the pose if ``image`` closes a loop, otherwise None.

        A loop is closed if the last :data:`SUCCESSIVE` images show old points from consistent poses. ``current``: a
        function that returns the newest estimate of a variable of the graph, by key.
        """
        self._last_time = image.keyframe.t
        revisit = _revisit(model, image, old, current)
        if revisit is None:
            return None
        agrees = False
        if self._agreeing and image.keyframe.t <= self._agreeing[-1].keyframe.t + BREAK:
            last = self._agreeing[-1]
            went = se2.between(current(last.keyframe.key), image.guess[0])
            off = se2.log(se2.between(went, se2.between(last.pose, revisit.pose)))
            agrees = bool(np.sum((off / MOTION_SIGMAS) ** 2) < GATE)
        self._agreeing = [*self._agreeing[1 - SUCCESSIVE :], revisit] if agrees else [revisit]
        return revisit if len(self._agreeing) == SUCCESSIVE else None


def _revisit(model: CameraModel, image: Image, old: OldPoints, current: Callable[[int], Array]) -> Revisit | None:
    """Return the old points that one image shows, and the pose that they determine. Returns None if they are too few,
    or the pose is implausible. ``old``: the points to search. ``current``: a function that returns the newest estimate
    of a variable of the graph, by key."""
    near = np.flatnonzero(_in_reach(model, lifted(model, *image.guess), old.points))
    recognised = None if len(near) < FEWEST else _recognised(model, image.frame, _newest(old, near, current))
    if recognised is None:
        return None
    pose, points, features = recognised
    rows = near[points]
    travelled = image.travelled - float(np.median(old.travelled[rows]))
    if not _is_spread_out(model, image.frame.pixels[features]) or not _is_plausible(image.guess, pose, travelled):
        return None
    return Revisit(image.keyframe, pose, rows, features)


def _recognised(model: CameraModel, frame: CameraFrame, points: PointMap) -> tuple[Array, Integers, Integers] | None:
    """Return the pose (3,) of the robot, and the indices (M,) of matched ``points`` and of their features in ``frame``.
    Returns None if the robot would not be on the floor, or if too few visible points match."""
    associator = Associator(points, model)
    somewhere = associator.relocalized(frame)
    if somewhere is None:
        return None
    camera, associations = somewhere
    floor = _on_floor(model, camera, points, frame, associations)
    if floor is None:
        return None
    placed = lifted(model, floor.pose, floor.covariance)
    associations = associator.guided(frame, placed, model)
    enough = max(FEWEST, LEAST_SHARE * associations.expected)
    floor = _on_floor(model, placed, points, frame, associations) if len(associations) >= enough else None
    if floor is None or np.count_nonzero(floor.inliers) < enough:
        return None
    return floor.pose, associations.points[floor.inliers], associations.features[floor.inliers]


def _on_floor(
    model: CameraModel, camera: CameraPose, points: PointMap, frame: CameraFrame, associations: Associations
) -> FoundOnFloor | None:
    pixels = np.asarray(frame.pixels[associations.features], dtype=float)
    return on_floor(
        model, camera, points.positions[associations.points], pixels, points.covariances[associations.points]
    )


def _is_plausible(guess: Guess, pose: Array, travelled: float) -> bool:
    """Return True if drift of the odometry over ``travelled`` [m] explains the difference between ``pose`` (3,) and the
    estimate ``guess``."""
    off = se2.log(se2.between(guess[0], pose))
    drift = DRIFT + DRIFT_PER_METRE * travelled
    return bool(positive.squared(off, guess[1] + np.diag(drift**2)) < GATE)


def _in_reach(model: CameraModel, camera: CameraPose, points: PointMap) -> Truths:
    """Return a mask (N,) of the points that may be visible to ``camera``, and may be similar to their stored view.

    The pose of ``camera`` may be wrong by :data:`LARGEST_SHIFT` and :data:`LARGEST_TURN`. A point is similar if it is
    observed from about the same direction and distance as in its stored view.
    """
    rays, old_rays = points.positions - camera.position, points.positions - points.seen_from
    away, old_distance = np.linalg.norm(rays, axis=1), np.linalg.norm(old_rays, axis=1)
    turn = np.arcsin(np.minimum(1.0, LARGEST_SHIFT / away))
    right, _, ahead = (rays @ camera.rotation).T
    half = math.atan(max(model.cx, model.width - model.cx) / model.fx)
    between = np.arccos(np.clip(np.einsum("ni,ni->n", rays, old_rays) / (away * old_distance), -1.0, 1.0))
    return np.asarray(
        (np.abs(np.arctan2(right, ahead)) < half + LARGEST_TURN + turn)
        & (away < FARTHEST + LARGEST_SHIFT)
        & (between < LARGEST_ANGLE + turn)
        & (away < LARGEST_RATIO * old_distance + LARGEST_SHIFT)
        & (old_distance < LARGEST_RATIO * away + LARGEST_SHIFT)
    )


def _newest(old: OldPoints, rows: Integers, current: Callable[[int], Array]) -> PointMap:
    """Return the ``old`` points with the indices ``rows``, at their newest estimates. ``current``: a function that
    returns the newest estimate of a point by key. The camera positions of the views are shifted like the points."""
    points = old.points.chosen(rows)
    positions = np.array([current(old.keys[i]) for i in rows.tolist()])
    return replace(points, positions=positions, seen_from=points.seen_from + positions - points.positions)


def _is_spread_out(model: CameraModel, pixels: Array) -> bool:
    """Return True if ``pixels`` (K, 2) are in at least :data:`CELLS` different cells of a grid over the image."""
    cells = np.floor(pixels / (model.width, model.height) * GRID)
    return len(np.unique(cells, axis=0)) >= CELLS
