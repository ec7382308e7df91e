"""Places that a robot comes back to, without a map: points of the graph that were last seen long ago are found again.

About once a second an image is compared with those of them that may be in view, without a prediction (Associator.relocalized of
:mod:`factorgraph_loc.vision.association`); the pose that comes out must be one on the floor. From there they are looked for once
more, and enough of those that should be seen must be, all over the image. As things look alike in a building, none of that is
believed at once: successive images must find the robot where it was found before and the odometry says it went, and not farther
from the track than that may have drifted. (Geometric verification and consistency over successive images: Cadena, Galvez-Lopez,
Tardos, Neira, IEEE Transactions on Robotics 28(4), 2012.)
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_loc.fusion.graph_parts import Guess, Keyframe
from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.sensors.camera.sensor import lifted
from factorgraph_loc.vision.association import TURNED as VIEWED
from factorgraph_loc.vision.association import ZOOMED, Associations, Associator
from factorgraph_loc.vision.consensus import CameraPose, Truths
from factorgraph_loc.vision.frame import CameraFrame
from factorgraph_loc.vision.keypoints import Integers
from factorgraph_loc.vision.relocalization import FoundOnFloor, on_floor
from factors import positive, se2
from factors.camera.model import CameraModel
from factors.se2 import Array

INTERVAL = 0.9  # s between images that are compared
SUCCESSIVE, BREAK = 3, 3.0  # images that must agree, and s within which the next one must come
APART = np.array((0.1, 0.1, 0.03))  # m, m, rad: standard deviations of what two of them say of the motion between them
FEWEST = 15  # points that must be seen
LEAST_SHARE = 0.1  # of those that should be
GRID, CELLS = (6, 4), 7  # cells of the image, and in how many of them there must be one
# m, rad; and shares of the way since: standard deviations of a track's drift beside those that it tells itself
DRIFT, DRIFT_OF_WAY = np.array((0.05, 0.05, 0.02)), np.array((0.003, 0.003, 0.0005))
GATE = 16.3  # squared, of three degrees of freedom: 99.9 %
SHIFTED, TURNED = 1.0, 0.3  # m, rad: by how much a track may be off for its points to be found
FARTHEST = 15.0  # m


@dataclass(frozen=True)
class OldPoints:
    """``points`` (N) of the graph with a view each, and their ``keys``: where they are, and were seen from, need not be the newest;
    ``ways`` (N,): how far the robot had gone by then [m]."""

    points: PointMap
    keys: Sequence[int]
    ways: Array


@dataclass(frozen=True)
class Image:
    """What was seen from a new ``keyframe`` at about ``guess``; ``way``: how far the robot has gone [m]."""

    frame: CameraFrame
    keyframe: Keyframe
    guess: Guess
    way: float


@dataclass(frozen=True)
class Revisit:
    """Where a keyframe was found, the ``pose`` (3,), by which of the old points (M,), and which features (M,) show them."""

    keyframe: Keyframe
    pose: Array
    points: Integers
    features: Integers


class LoopClosure:
    """What the last images said; see the module."""

    def __init__(self) -> None:
        self._found: list[Revisit] = []  # successive ones that agree
        self._looked = -math.inf

    def due(self, t: float) -> bool:
        """Whether the image of that time is to be compared."""
        return t >= self._looked + INTERVAL

    def look(self, model: CameraModel, image: Image, old: OldPoints, current: Callable[[int], Array]) -> Revisit | None:
        """Which points that were last seen long ago an image shows; None where that is not certain. ``current``: the newest
        estimate of a variable by key."""
        self._looked = image.keyframe.t
        found = _found(model, image, old, current)
        if found is None:
            return None
        agrees = False
        if self._found and image.keyframe.t <= self._found[-1].keyframe.t + BREAK:
            last = self._found[-1]
            went = se2.between(current(last.keyframe.key), image.guess[0])
            off = se2.log(se2.between(went, se2.between(last.pose, found.pose)))
            agrees = bool(np.sum((off / APART) ** 2) < GATE)
        self._found = [*self._found[1 - SUCCESSIVE :], found] if agrees else [found]
        return found if len(self._found) == SUCCESSIVE else None


def _found(model: CameraModel, image: Image, old: OldPoints, current: Callable[[int], Array]) -> Revisit | None:
    """What one image tells by itself."""
    near = np.flatnonzero(_in_reach(model, lifted(model, *image.guess), old.points))
    recognised = None if len(near) < FEWEST else _recognised(model, image.frame, _newest(old, near, current))
    if recognised is None:
        return None
    pose, points, features = recognised
    rows = near[points]
    way = image.way - float(np.median(old.ways[rows]))
    if not _spread(model, image.frame.pixels[features]) or not _believed(image.guess, pose, way):
        return None
    return Revisit(image.keyframe, pose, rows, features)


def _recognised(model: CameraModel, frame: CameraFrame, points: PointMap) -> tuple[Array, Integers, Integers] | None:
    """The pose (3,) of the robot that enough of what should be seen from there agrees with, and which of ``points`` (M,) are shown
    by which features (M,)."""
    associator = Associator(points, model)
    somewhere = associator.relocalized(frame)
    if somewhere is None:
        return None
    *camera, seen = somewhere
    floor = _on_floor(model, CameraPose(*camera), points, frame, seen)
    if floor is None:
        return None
    there = lifted(model, floor.pose, floor.covariance)
    seen = associator.guided(frame, there.position, there.rotation, there.covariance, model)
    enough = max(FEWEST, LEAST_SHARE * seen.expected)
    floor = _on_floor(model, there, points, frame, seen) if len(seen) >= enough else None
    if floor is None or np.count_nonzero(floor.inliers) < enough:
        return None
    return floor.pose, seen.points[floor.inliers], seen.features[floor.inliers]


def _on_floor(
    model: CameraModel, camera: CameraPose, points: PointMap, frame: CameraFrame, seen: Associations
) -> FoundOnFloor | None:
    pixels = np.asarray(frame.pixels[seen.features], dtype=float)
    return on_floor(model, camera, points.positions[seen.points], pixels, points.covariances[seen.points])


def _believed(guess: Guess, pose: Array, way: float) -> bool:
    """Whether the track may have drifted to ``guess`` from a ``pose`` in a ``way`` [m]."""
    off = se2.log(se2.between(guess[0], pose))
    drift = DRIFT + DRIFT_OF_WAY * way
    return bool(positive.squared(off, guess[1] + np.diag(drift**2)) < GATE)


def _in_reach(model: CameraModel, camera: CameraPose, points: PointMap) -> Truths:
    """Which points (N,) the camera may see, if it is where it is believed to be within :data:`SHIFTED` and :data:`TURNED`, and see
    as they were seen before."""
    here, there = points.positions - camera.position, points.positions - points.seen_from
    away, before = np.linalg.norm(here, axis=1), np.linalg.norm(there, axis=1)
    turn = np.arcsin(np.minimum(1.0, SHIFTED / away))
    right, _, ahead = (here @ camera.rotation).T
    half = math.atan(max(model.cx, model.width - model.cx) / model.fx)
    between = np.arccos(np.clip(np.einsum("ni,ni->n", here, there) / (away * before), -1.0, 1.0))
    return np.asarray(
        (np.abs(np.arctan2(right, ahead)) < half + TURNED + turn)
        & (away < FARTHEST + SHIFTED)
        & (between < VIEWED + turn)
        & (away < ZOOMED * before + SHIFTED)
        & (before < ZOOMED * away + SHIFTED)
    )


def _newest(old: OldPoints, rows: Integers, current: Callable[[int], Array]) -> PointMap:
    """Some of the points where they are believed to be by now; where they were seen from goes with them."""
    points = old.points
    positions = np.array([current(old.keys[i]) for i in rows.tolist()])
    return PointMap(
        tuple(points.names[i] for i in rows.tolist()),
        positions,
        points.covariances[rows],
        points.feature,
        np.arange(len(rows)),
        points.descriptors[rows],
        points.seen_from[rows] + positions - points.positions[rows],
        points.sizes[rows],
    )


def _spread(model: CameraModel, pixels: Array) -> bool:
    """Whether ``pixels`` (K, 2) are all over the image."""
    cells = np.floor(pixels / (model.width, model.height) * GRID)
    return len(np.unique(cells, axis=0)) >= CELLS
