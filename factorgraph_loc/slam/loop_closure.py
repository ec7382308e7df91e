"""Loop closure without a map: recognition of points of the graph that were last seen long ago.

About once a second an image is compared with the possibly visible ones of these points, without a predicted pose
(Associator.relocalized of :mod:`factorgraph_loc.vision.association`). The resulting pose must be on the floor. The points are
matched again from that pose, and enough of the visible ones must match, in all parts of the image. Places in a building
resemble each other. Therefore the poses of consecutive images must agree by odometry, within the possible drift of the track.
Geometric verification and consistency over consecutive images: Cadena, Galvez-Lopez, Tardos, Neira, IEEE Transactions on Robotics
28(4), 2012.
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
SUCCESSIVE, BREAK = 3, 3.0  # images that must agree, and the maximum time [s] between them
MOTION_SIGMAS = np.array((0.1, 0.1, 0.03))  # m, m, rad: standard deviations of the motion between two of their poses
FEWEST = 15  # points that must be found
LEAST_SHARE = 0.1  # of the visible ones
GRID, CELLS = (6, 4), 7  # cells of the image, and how many of them must contain a point
# m, rad; and relative to the distance travelled: standard deviations of a track's drift in addition to its covariance
DRIFT, DRIFT_PER_METRE = np.array((0.05, 0.05, 0.02)), np.array((0.003, 0.003, 0.0005))
GATE = 16.3  # 99.9 % of chi-square with three degrees of freedom
LARGEST_SHIFT, LARGEST_TURN = 1.0, 0.3  # m, rad: errors of a track for which its points are found
FARTHEST = 15.0  # m


@dataclass(frozen=True)
class OldPoints:
    """``points`` (N) of the graph with a view each, and their ``keys``; positions may be outdated. ``travelled`` (N,): distance
    travelled by the robot [m] when they were last seen.
    """

    points: PointMap
    keys: Sequence[int]
    travelled: Array


@dataclass(frozen=True)
class Image:
    """The image of a new ``keyframe`` at about ``guess``; ``travelled``: distance travelled [m]."""

    frame: CameraFrame
    keyframe: Keyframe
    guess: Guess
    travelled: float


@dataclass(frozen=True)
class Revisit:
    """The ``pose`` (3,) where a keyframe was recognized, and the indices of the old points (M,) and of their features (M,)."""

    keyframe: Keyframe
    pose: Array
    points: Integers
    features: Integers


class LoopClosure:
    """Recognizes revisited places from consecutive images; see the module."""

    def __init__(self) -> None:
        self._found: list[Revisit] = []  # consecutive ones that agree
        self._looked = -math.inf

    def is_due(self, t: float) -> bool:
        """Whether the image at time ``t`` is to be compared."""
        return t >= self._looked + INTERVAL

    def compare(
        self, model: CameraModel, image: Image, old: OldPoints, current: Callable[[int], Array]
    ) -> Revisit | None:
        """The old points that an image shows, None if not certain. ``current``: the newest estimate of a variable by key."""
        self._looked = image.keyframe.t
        revisit = _revisit(model, image, old, current)
        if revisit is None:
            return None
        agrees = False
        if self._found and image.keyframe.t <= self._found[-1].keyframe.t + BREAK:
            last = self._found[-1]
            went = se2.between(current(last.keyframe.key), image.guess[0])
            off = se2.log(se2.between(went, se2.between(last.pose, revisit.pose)))
            agrees = bool(np.sum((off / MOTION_SIGMAS) ** 2) < GATE)
        self._found = [*self._found[1 - SUCCESSIVE :], revisit] if agrees else [revisit]
        return revisit if len(self._found) == SUCCESSIVE else None


def _revisit(model: CameraModel, image: Image, old: OldPoints, current: Callable[[int], Array]) -> Revisit | None:
    """The result of one image, without the previous ones."""
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
    """A pose (3,) of the robot that is consistent with enough of the visible points, and matching ``points`` (M,) and features
    (M,).
    """
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
    """Whether the track may have drifted from ``pose`` to ``guess`` over a distance ``travelled`` [m]."""
    off = se2.log(se2.between(guess[0], pose))
    drift = DRIFT + DRIFT_PER_METRE * travelled
    return bool(positive.squared(off, guess[1] + np.diag(drift**2)) < GATE)


def _in_reach(model: CameraModel, camera: CameraPose, points: PointMap) -> Truths:
    """Which points (N,) the camera may see from the same side as before, if its pose is correct within :data:`LARGEST_SHIFT` and
    :data:`LARGEST_TURN`.
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
    """Some of the points at their newest estimates, with the viewpoints moved along."""
    points = old.points.chosen(rows)
    positions = np.array([current(old.keys[i]) for i in rows.tolist()])
    return replace(points, positions=positions, seen_from=points.seen_from + positions - points.positions)


def _is_spread_out(model: CameraModel, pixels: Array) -> bool:
    """Whether ``pixels`` (K, 2) are spread over the image."""
    cells = np.floor(pixels / (model.width, model.height) * GRID)
    return len(np.unique(cells, axis=0)) >= CELLS
