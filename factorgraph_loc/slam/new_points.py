"""Delayed initialization of points that the map lacks: sightings are collected until they determine the point.

The sightings must come from :data:`FEWEST` keyframes with enough parallax for the errors of pixels and poses. Their rays must
intersect in front of the camera, with small residuals. A sighting that contradicts the others is dropped.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import repeat

import numpy as np

from factors import chi_squared
from factors.camera import model as reprojection
from factors.camera import triangulation_kernels as kernels
from factors.camera.model import CameraModel
from factors.camera.triangulation_kernels import MIN_PARALLAX
from factors.se2 import Array

FEWEST, MAX_WAITING = 3, 10  # sightings of one point
MAX_SPREAD = 0.15  # standard deviation of an initial point, relative to its least depth
GATE = 0.999  # probability of the chi-square test of the residuals
PATIENCE = 20  # keyframes after which a point not seen again is dropped
UPRIGHT = np.zeros(2)


@dataclass(frozen=True, slots=True)
class PointSighting:
    """A point seen from keyframe ``keyframe`` at ``pixel`` (2,), in the direction ``ray`` (3,) of the camera frame."""

    keyframe: int
    pixel: Array
    ray: Array


def sightings_of(model: CameraModel, keyframe: int, pixels: Array) -> list[PointSighting]:
    """The sightings at ``pixels`` (K, 2) from a keyframe."""
    rays = reprojection.rays(model, pixels)
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    return list(map(PointSighting, repeat(keyframe), pixels, rays))


@dataclass(frozen=True, slots=True)
class KeyframeCamera:
    """Camera pose of a keyframe: ``centre`` (3,) and ``rotation`` (3, 3) in the world, and the pixel error ``slack`` [px] that
    its uncertainty causes.
    """

    centre: Array
    rotation: Array
    slack: float

    @classmethod
    def of(cls, model: CameraModel, pose: Array, slack: float, tilt: Array = UPRIGHT) -> KeyframeCamera:
        """The camera of a robot at ``pose`` (3,) with this ``tilt`` (2,) [rad]."""
        return cls(*reprojection.camera_pose(model, pose, tilt), slack)


@dataclass(frozen=True, slots=True)
class TriangulatedPoint:
    """A point's ``position`` (3,), ``covariance`` (3, 3) for exact poses, and squared whitened residuals (M,) of its sightings."""

    position: Array
    covariance: Array
    squared: Array


class NewPoints:
    """The collected sightings of points that are not initialized yet, ``waiting`` by name or number of the point."""

    def __init__(self, model: CameraModel) -> None:
        self._model = model
        self.waiting: dict[Hashable, list[PointSighting]] = {}

    def count(self, name: Hashable) -> int:
        """The number of collected sightings of a point."""
        return len(self.waiting.get(name, ()))

    def add(self, name: Hashable, sighting: PointSighting) -> None:
        """Add a sighting; the oldest ones are dropped."""
        waiting = self.waiting.setdefault(name, [])
        waiting.append(sighting)
        del waiting[:-MAX_WAITING]

    def those(self, trusted: Callable[[Hashable], bool]) -> Mapping[Hashable, Sequence[PointSighting]]:
        """The collected sightings of ``trusted`` points."""
        return {name: sightings for name, sightings in self.waiting.items() if trusted(name)}

    def forget(self, keyframe: int, wrong: Container[Hashable] = ()) -> None:
        """Drop the points that were last seen long before a keyframe, and the ``wrong`` ones."""
        since = keyframe - PATIENCE
        self.waiting = {k: v for k, v in self.waiting.items() if v[-1].keyframe >= since and k not in wrong}

    def ready(
        self, names: Iterable[Hashable], places: Callable[[int], KeyframeCamera | None], most: int = 1000
    ) -> list[tuple[Hashable, TriangulatedPoint, list[PointSighting]]]:
        """Remove and return at most ``most`` determined points of ``names``, with the used sightings.

        ``places``: camera poses of keyframes, None for a keyframe that nothing can be added to.
        """
        determined: list[tuple[Hashable, TriangulatedPoint, list[PointSighting]]] = []
        known: dict[int, KeyframeCamera | None] = {}
        for name in names:
            waiting = self.waiting.get(name, [])
            if len(waiting) < FEWEST or len(determined) >= most:
                continue
            for sighting in waiting:
                if sighting.keyframe not in known:
                    known[sighting.keyframe] = places(sighting.keyframe)
            placed = [(s, place) for s in waiting if (place := known[s.keyframe]) is not None]
            if len(placed) < FEWEST or not has_parallax(self._model, *placed[0], *placed[-1]):
                continue
            result = agreed(self._model, [s for s, _ in placed], [p for _, p in placed])
            if result is not None:
                del self.waiting[name]
                determined.append((name, *result))
        return determined


def has_parallax(
    model: CameraModel,
    first: PointSighting,
    first_camera: KeyframeCamera,
    last: PointSighting,
    last_camera: KeyframeCamera,
) -> bool:
    """Cheap test whether two rays alone nearly determine the point."""
    sigma = math.hypot(model.sigma, max(first_camera.slack, last_camera.slack)) / model.fx
    angle = max(MIN_PARALLAX, min(sigma / MAX_SPREAD, 0.5))
    return float((first_camera.rotation @ first.ray) @ (last_camera.rotation @ last.ray)) < math.cos(angle)


def agreed(
    model: CameraModel, sightings: Sequence[PointSighting], places: Sequence[KeyframeCamera]
) -> tuple[TriangulatedPoint, list[PointSighting]] | None:
    """The point of ``sightings`` from ``places``, and its consistent sightings; None if they do not determine it.

    Sightings that contradict the point are removed one by one, such that the remaining ones agree best.
    """
    sightings, places = list(sightings), list(places)
    point = triangulate(model, sightings, places)
    while point is not None and not _fits(point, sightings):
        if len(sightings) <= FEWEST:
            return None
        best: tuple[float, int, TriangulatedPoint] | None = None
        for i in range(len(sightings)):
            without_one = triangulate(model, sightings[:i] + sightings[i + 1 :], places[:i] + places[i + 1 :])
            if without_one is not None and (best is None or without_one.squared.sum() < best[0]):
                best = float(without_one.squared.sum()), i, without_one
        if best is None:
            return None
        _, out, point = best
        del sightings[out], places[out]
    return None if point is None else (point, sightings)


def _fits(point: TriangulatedPoint, sightings: Sequence[PointSighting]) -> bool:
    """Whether the errors of the ``sightings`` of a point may be noise."""
    return bool(point.squared.sum() < chi_squared.quantile(GATE, 2 * len(sightings) - 3))


def triangulate(
    model: CameraModel, sightings: Sequence[PointSighting], places: Sequence[KeyframeCamera]
) -> TriangulatedPoint | None:
    """Triangulate the point of M ``sightings`` from ``places``: minimise the squared residuals in the images.

    The residuals are infinite where the rays do not intersect in front of the camera. None if the rays are nearly parallel, or do
    not determine the point to :data:`MAX_SPREAD` times its least depth.
    """
    is_determined, *result = kernels.triangulated(
        reprojection.lens_of(model),
        np.array([p.centre for p in places]),
        np.array([p.rotation for p in places]),
        np.array([s.ray for s in sightings]),
        np.array([s.pixel for s in sightings], dtype=float),
        np.array([math.hypot(model.sigma, p.slack) for p in places]),
        MAX_SPREAD,
        MIN_PARALLAX,
        kernels.NEAREST,
        math.inf,
    )
    return TriangulatedPoint(*result) if is_determined else None
