"""Delayed initialization of points that the map lacks: sightings are collected until they determine the position of the point.

A sighting is one observation of a point from a keyframe. At least :data:`FEWEST` sightings are needed. Their parallax
must be large compared with the errors of pixels and poses. Their rays must intersect in front of the camera, with small
residuals. A sighting that contradicts the other sightings is dropped.
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

FEWEST, MAX_WAITING = 3, 10  # least number of sightings to triangulate a point; most sightings stored of a point
MAX_SPREAD = 0.15  # largest standard deviation of a new point, relative to its least depth in the images
GATE = 0.999  # probability that correct residuals pass the chi-square test
PATIENCE = 20  # number of keyframes without a sighting after which a point is dropped
UPRIGHT = np.zeros(2)


@dataclass(frozen=True, slots=True)
class PointSighting:
    """An observation of a point from a keyframe. ``keyframe``: the index of the keyframe. ``pixel`` (2,): the observed
    pixel. ``ray`` (3,): the unit vector from the camera to the point, in the camera frame."""

    keyframe: int
    pixel: Array
    ray: Array


def sightings_of(model: CameraModel, keyframe: int, pixels: Array) -> list[PointSighting]:
    """Return one observation per row of ``pixels`` (K, 2), from the keyframe with the index ``keyframe``."""
    rays = reprojection.rays(model, pixels)
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    return list(map(PointSighting, repeat(keyframe), pixels, rays))


@dataclass(frozen=True)
class ChosenSightings:
    """N observations of points (``sightings``) from a keyframe. ``rows``: the index of each in the image's measurement.
    ``names``: the name of each point, or the identifier of its feature track. ``pixels`` (N, 2): the observed
    pixels."""

    rows: list[int]
    names: list[Hashable]
    pixels: Array
    sightings: list[PointSighting]


@dataclass(frozen=True, slots=True)
class KeyframeCamera:
    """The camera pose of a keyframe.

    ``centre`` (3,), ``rotation`` (3, 3): position and orientation of the camera in the world frame. ``slack`` [px]: the
    pixel error that the uncertainty of the pose causes.
    """

    centre: Array
    rotation: Array
    slack: float

    @classmethod
    def of(cls, model: CameraModel, pose: Array, slack: float, tilt: Array = UPRIGHT) -> KeyframeCamera:
        """Return the camera pose of a robot at the planar ``pose`` (3,) with ``tilt`` (2,), its roll and pitch [rad].
        ``slack`` [px]: the pixel error that the uncertainty of the pose causes."""
        return cls(*reprojection.camera_pose(model, pose, tilt), slack)


@dataclass(frozen=True, slots=True)
class TriangulatedPoint:
    """A triangulated point. ``position`` (3,): in the world frame. ``covariance`` (3, 3): of the position, if the
    camera poses are exact. ``squared`` (M,): squared whitened residuals of its M observations."""

    position: Array
    covariance: Array
    squared: Array


class NewPoints:
    """Collects observations of points until the points can be triangulated. ``waiting``: {point: observations} of the
    points that are not triangulated yet. The key is the name of a point, or the identifier of its feature track."""

    def __init__(self, model: CameraModel) -> None:
        self._model = model
        self.waiting: dict[Hashable, list[PointSighting]] = {}

    def count(self, name: Hashable) -> int:
        """Return the number of collected observations of the point ``name``."""
        return len(self.waiting.get(name, ()))

    def add(self, name: Hashable, sighting: PointSighting) -> None:
        """Add an observation of the point ``name``. Only the newest :data:`MAX_WAITING` of a point are stored."""
        waiting = self.waiting.setdefault(name, [])
        waiting.append(sighting)
        del waiting[:-MAX_WAITING]

    def select(self, is_wanted: Callable[[Hashable], bool]) -> Mapping[Hashable, Sequence[PointSighting]]:
        """Return the collected observations, by name, of the points for which ``is_wanted(name)`` is True."""
        return {name: sightings for name, sightings in self.waiting.items() if is_wanted(name)}

    def forget(self, keyframe: int, wrong: Container[Hashable] = ()) -> None:
        """Delete the points ``wrong``. Also delete all points that were not observed in the last :data:`PATIENCE`
        keyframes before the one with the index ``keyframe``."""
        since = keyframe - PATIENCE
        self.waiting = {k: v for k, v in self.waiting.items() if v[-1].keyframe >= since and k not in wrong}

    def ready(
        self, names: Iterable[Hashable], places: Callable[[int], KeyframeCamera | None], most: int = 1000
    ) -> list[tuple[Hashable, TriangulatedPoint, list[PointSighting]]]:
        """Return (name, point, consistent observations) for the points among ``names`` that can be triangulated.

        The observations of a returned point are deleted. ``places(index)``: returns the camera pose of a keyframe, or
        None if observations from this keyframe must not be used. ``most``: the largest number of results.
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
    """Return True if the angle between the rays of two observations of a point is large enough to triangulate it."""
    sigma = math.hypot(model.sigma, max(first_camera.slack, last_camera.slack)) / model.fx
    angle = max(MIN_PARALLAX, min(sigma / MAX_SPREAD, 0.5))
    return float((first_camera.rotation @ first.ray) @ (last_camera.rotation @ last.ray)) < math.cos(angle)


def agreed(
    model: CameraModel, sightings: Sequence[PointSighting], places: Sequence[KeyframeCamera]
) -> tuple[TriangulatedPoint, list[PointSighting]] | None:
    """Return a triangulated point and its consistent observations, without outliers.

    ``sightings``: the observations. ``places``: the camera pose of each. While the residuals are too large, the worst
    observation is removed. Returns None if the remaining observations do not determine the point.
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
    """Return True if the residuals of a point and its observations pass a chi-square test."""
    return bool(point.squared.sum() < chi_squared.quantile(GATE, 2 * len(sightings) - 3))


def triangulate(
    model: CameraModel, sightings: Sequence[PointSighting], places: Sequence[KeyframeCamera]
) -> TriangulatedPoint | None:
    """Return a point triangulated from M observations, with minimal squared residuals in the images.

    ``places``: the camera pose of each observation. The residual is infinite for a camera that has the point behind it.
    Returns None if the rays are nearly parallel, or if the standard deviation of the position exceeds
    :data:`MAX_SPREAD` times the least depth.
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
