"""Turns camera measurements into factors of points of the map. Points are identified by name or by matching features."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from factorgraph_loc.maps.markers import marker_of
from factorgraph_loc.maps.points import PointMap, without_common
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.settings import Estimated
from factorgraph_loc.model.setup import MapUse, Setup
from factorgraph_loc.sensors.camera.measurement import Pixels, PixelSightings
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.vision.association import Associator
from factorgraph_loc.vision.consensus import FEWEST, CameraPose, Truths, agreeing
from factorgraph_loc.vision.frame import CameraFrame
from factorgraph_loc.vision.keypoints import spread_out
from factorgraph_loc.vision.relocalization import FoundOnFloor, found_on_floor, on_floor
from factors import se2
from factors.camera import model as reprojection
from factors.camera import update_kernels as pixel_kernels
from factors.camera.factor import ReprojectionFactor
from factors.camera.model import FOCAL, TIME_OFFSET, CameraModel, TiltScale
from factors.motion import Increment, propagate
from factors.se2 import Array

# reason for the rejection of a point, as written to the diagnostics
DISAGREES = "camera: point disagrees with the other points of the image"
FEW_SHARE = 0.3  # an image misses named points if a smaller fraction of them are inliers
FEW, MANY = 6, 20  # an image misses matched points if fewer than FEW are inliers, although MANY or more are expected
UNSURE = 1.0  # m; with a larger standard deviation of the prediction, FEW alone decides if points are missing
MOST = 100  # points used per image; more points add little, because errors of neighbouring points are correlated
STEEPEST = 0.06  # rad; an image that requires a larger tilt of the robot is rejected
# a named point is exact if its survey sigma is below the fraction EXACT_SURVEY of a pixel error at the distance NEAR [m]
EXACT_SURVEY, NEAR = 0.2, 3.0
EXACT = 0.1  # a map is exact if its errors are below this fraction of a pixel error at a distance of 1 m
# pixels are so precise that one linearisation at a poor prediction does not reach the optimum
ITERATIONS, SETTLED = 8, 1e-3  # number of iterations; m, rad: iterations end if the step is smaller

NOT_DISPLACED: Mapping[str, tuple[Array, Array]] = MappingProxyType({})


@dataclass(frozen=True)
class Predicted:
    """The current estimate, with which the points of an image are predicted.

    ``pose`` (3,) with body-frame ``covariance`` (3, 3): the pose of the robot that the image's factor depends on.
    ``constants`` (P,) with covariance ``spread`` (P, P): the estimates of the P camera constants that are estimated,
    relative to the rig. None if P is 0.
    """

    pose: Array
    covariance: Array
    constants: Array | None = None
    spread: Array | None = None


class KnownPoints:
    """Turns camera measurements into factors of known points. Points that the map lacks are counted as ignored,
    outliers as rejected.

    ``estimated``: the camera's constants that are estimated. ``use``: how the map is used, see
    :class:`~factorgraph_loc.sensors.landmarks.sensor.KnownLandmarks`. ``name``: the name of the sensor in the diagnostics.
    """

    def __init__(
        self,
        setup: Setup,
        diagnostics: Diagnostics,
        estimated: Estimated,
        use: MapUse = "known",
        name: str = PixelSightings.modality,
    ) -> None:
        settings = setup.rig.of(CameraSettings)
        self.name = name
        self.model: CameraModel = replace(settings.model(), tempering=1.0)
        self.floor = TiltScale.guessed(self.model.tilt)
        self._tempering = settings.tempering  # exponent of the likelihood of matched points; named points have none
        self.map = PointMap.of((), np.empty((0, 3)))
        if setup.world.points is not None and use != "unknown":
            self.map = without_common(setup.world.points)
        self._others_matter = use != "known"
        self.used = np.empty(
            0, dtype=np.int64
        )  # indices of the features of the last image that match points of the map
        self.names: tuple[str, ...] = ()  # names of the points of the last factor; () for matched features
        self._estimated = estimated
        self._diagnostics = diagnostics
        self.associator: Associator | None = None
        if "camera" in setup.sensors and len(self.map.owners):
            self.associator = Associator(self.map, self.model)
        self.missed = False  # True if points of the map were missing in the last image
        self._map_matters = False
        self._inexact = np.zeros(len(self.map), dtype=bool)
        if len(self.map):
            variances = np.trace(self.map.covariances, axis1=1, axis2=2)
            worst = float(variances.max())
            pixel = settings.pixel_sigma / settings.fx
            self._map_matters = worst > (EXACT * pixel) ** 2
            self._inexact = variances > 3.0 * (EXACT_SURVEY * NEAR * pixel) ** 2

    @property
    def needs_twist(self) -> bool:
        """True if the camera's time offset is estimated, so that factors depend on the robot's velocity."""
        return TIME_OFFSET in self._estimated.indices

    def inexact(self, m: Pixels) -> dict[str, tuple[list[str], Array]]:
        """Return the detected points whose survey is inexact, grouped by point or marker. Each value has the names of
        the detected points of the group, and the covariance (3, 3) of their common displacement."""
        inexact: dict[str, tuple[list[str], Array]] = {}
        if not isinstance(m, PixelSightings) or not self._inexact.any():
            return inexact
        for name in dict.fromkeys(m.points):
            place = self.map.index.get(name, -1)
            if place >= 0 and self._inexact[place]:
                names, _ = inexact.setdefault(marker_of(name) or name, ([], self.map.covariances[place]))
                names.append(name)
        return inexact

    def named(self, m: PixelSightings) -> ReprojectionFactor | None:
        """Return a factor of all named points that are in the map, without outlier rejection, on the pose at the time
        of the image. Returns None without such points."""
        places = [self.map.index.get(name, -1) for name in m.points]
        pixels = m.pixels
        if -1 in places:
            rows = [i for i, place in enumerate(places) if place >= 0]
            if not self._others_matter:
                self._diagnostics.ignore("point not in the map", len(places) - len(rows))
            places, pixels = [places[i] for i in rows], pixels[rows]
        self.names = tuple(self.map.names[place] for place in places)
        return self._factor(self.model, places, pixels) if places else None

    def factor(
        self,
        m: Pixels,
        predicted: Predicted,
        offset: Increment | None = None,
        twist: Array | None = None,
        displaced: Mapping[str, tuple[Array, Array]] = NOT_DISPLACED,
    ) -> ReprojectionFactor | None:
        """Return the factor of the known points in an image after outliers are removed, or None if no points remain.

        ``predicted``: the predicted pose and constants of the camera, at which outliers are detected. ``offset``: the
        motion from the pose that the factor depends on to the image, None if the times are equal. ``twist`` (3,): the
        robot's velocity at the image. It is required if the camera's time offset is estimated. ``displaced``: by point
        name, the displacement (3,) of a point from the map, and the covariance (3, 3) of its position.
        """
        self.used = np.empty(0, dtype=np.int64)
        factor = self.named(m) if isinstance(m, PixelSightings) else self._nothing(m)
        if factor is None:
            return None
        moved = np.zeros_like(factor.points)
        if displaced:
            assert factor.point_covariances is not None
            covariances = factor.point_covariances.copy()
            for row, name in enumerate(self.names):
                moved[row], covariances[row] = displaced.get(name, (moved[row], covariances[row]))
            factor = replace(factor, point_covariances=covariances)
        if offset is not None:
            factor = replace(factor, offset=offset.delta, offset_covariance=offset.covariance)
        if self._estimated.indices:
            factor = replace(factor, estimated=self._estimated.indices, twist=twist)
        expected = factor.fixed([] if predicted.constants is None else [predicted.constants], moved)
        camera = self._camera(expected, predicted)
        focal = 0.0
        if predicted.spread is not None and FOCAL in self._estimated.indices:
            place = self._estimated.indices.index(FOCAL)
            focal = math.sqrt(predicted.spread[place, place])
        if isinstance(m, CameraFrame):
            found = self._matched(m, factor, expected.model, camera, focal)
            return None if found is None else self._levelled(found, found, predicted)
        right = _agreeing(expected, camera, focal)
        agreed = int(np.count_nonzero(right))
        levelled = self._levelled(rows_of(factor, right), rows_of(expected, right), predicted) if agreed else None
        if levelled is None:
            right, agreed = np.zeros_like(right), 0
        self.missed = agreed < FEW_SHARE * len(right)
        if agreed < len(right):
            self._diagnostics.reject(DISAGREES, len(right) - agreed)
            self.names = tuple(self.names[row] for row in np.flatnonzero(right).tolist())
        return levelled

    def find(self, m: Pixels) -> tuple[FoundOnFloor | None, int]:
        """Return the robot's pose at an image, found without a prediction, and the number of points that the image
        should show. The pose is None if it is not found."""
        model = self.model
        if not len(self.map):
            return None, 0
        if isinstance(m, PixelSightings):
            rows = [i for i, name in enumerate(m.points) if name in self.map.index]
            points = np.array([self.map.index[m.points[i]] for i in rows], dtype=np.int64)
            covariances = self.map.covariances[points] if self._map_matters else None
            return found_on_floor(model, self.map.positions[points], m.pixels[rows], covariances), len(rows)
        relocated = None if self.associator is None else self.associator.relocalized(m)
        if relocated is None:
            return None, 0
        camera, matches = relocated
        covariances = self.map.covariances[matches.points] if self._map_matters else None
        pixels = np.asarray(m.pixels[matches.features], dtype=float)
        return on_floor(model, camera, self.map.positions[matches.points], pixels, covariances), matches.expected

    def _factor(self, model: CameraModel, points: list[int], pixels: Array) -> ReprojectionFactor:
        covariances = self.map.covariances[points] if self._map_matters else None
        return ReprojectionFactor(model, self.map.positions[points], pixels, point_covariances=covariances)

    def _nothing(self, m: CameraFrame) -> ReprojectionFactor | None:
        """Return a factor without points. The caller adds matches. Returns None if the features cannot be matched
        with the map."""
        self.names = ()
        if self.associator is None:
            if not self._others_matter:
                self._diagnostics.ignore(self.name, len(m.pixels))
            return None
        if m.feature != self.map.feature:
            self._diagnostics.ignore(f"{self.name}: features of another kind than the map's", len(m.pixels))
            return None
        return self._factor(replace(self.model, tempering=self._tempering), [], np.empty((0, 2)))

    def _matched(
        self, m: CameraFrame, factor: ReprojectionFactor, model: CameraModel, camera: CameraPose, focal: float
    ) -> ReprojectionFactor | None:
        """Match the features of a frame with the map near the predicted ``camera`` pose. Returns ``factor`` with the
        matched points, or None without matches. ``focal``: standard deviation of the logarithm of the focal length."""
        assert self.associator is not None
        matches = self.associator.guided(m, camera, model, focal)
        self.used = matches.features
        unsure = float(np.trace(camera.covariance[3:, 3:])) > UNSURE**2
        self.missed = len(matches) < FEW and (unsure or min(matches.expected, len(m.pixels)) >= MANY)
        if matches.rejected:
            self._diagnostics.reject(DISAGREES, matches.rejected)
        if len(matches) == 0:
            return None
        pixels = np.asarray(m.pixels[matches.features], dtype=float)
        chosen = spread_out(pixels, MOST) if len(pixels) > MOST else np.arange(len(pixels))
        points = matches.points[chosen]
        covariances = self.map.covariances[points] if self._map_matters else None
        return replace(factor, points=self.map.positions[points], pixels=pixels[chosen], point_covariances=covariances)

    def _levelled(
        self, factor: ReprojectionFactor, expected: ReprojectionFactor, predicted: Predicted
    ) -> ReprojectionFactor | None:
        """Update the learnt standard deviation of the robot's tilt by an image, and return ``factor`` with this value.

        ``expected``: the same factor with fixed constants. Returns None if the image requires a tilt above
        :data:`STEEPEST`, because it is probably wrong.
        """
        if expected.estimated:  # errors of the constants would be mistaken for a tilt
            return factor
        pose, covariance = (np.ascontiguousarray(part, dtype=float) for part in (predicted.pose, predicted.covariance))
        tilt, noise = pixel_kernels.leaning(expected.packed(), pose, covariance)
        if math.hypot(*tilt) > STEEPEST:
            return None
        self.floor, sigma = self.floor.learnt(tilt, noise, float(expected.model.tilt))
        return replace(factor, model=replace(factor.model, tilt=sigma))

    def _camera(self, expected: ReprojectionFactor, predicted: Predicted) -> CameraPose:
        """Return the pose of the camera at the image of the factor ``expected``, predicted from the robot's pose in
        ``predicted``. Its covariance includes the uncertainty of the mounting and of the time offset."""
        pose, covariance = predicted.pose, predicted.covariance
        if expected.offset is not None:
            noise = np.zeros((3, 3)) if expected.offset_covariance is None else expected.offset_covariance
            since = Increment(expected.offset, noise, 0.0)
            pose, covariance = se2.compose(pose, expected.offset), propagate(covariance, since)
        camera = lifted(expected.model, pose, covariance)
        if predicted.spread is None:
            return camera
        model = expected.model
        full = np.zeros((6, len(predicted.spread)))
        for column, place in enumerate(self._estimated.indices):
            if place < 3:
                full[3:, column] = model.rotation[place]
            elif place < FOCAL:
                full[:3, column] = model.rotation[place - 3]
            elif place == TIME_OFFSET and expected.twist is not None:
                full[:, column] = reprojection.lift(model)[:, reprojection.PLANAR] @ expected.twist
        return replace(camera, covariance=camera.covariance + full @ predicted.spread @ full.T)


def lifted(model: CameraModel, pose: Array, covariance: Array) -> CameraPose:
    """Return the pose in space of a robot's camera. ``pose`` (3,) with body-frame ``covariance`` (3, 3): the robot's pose.
    ``model``: the mounting, and the standard deviation of the robot's tilt, which the covariance of the result includes."""
    arrays = (np.ascontiguousarray(part, dtype=float) for part in (pose, covariance))
    return CameraPose(*pixel_kernels.placed(model.position, model.rotation, float(model.tilt), *arrays))


def _agreeing(expected: ReprojectionFactor, camera: CameraPose, focal: float) -> Truths:
    """Return a mask (K,) of the points of ``expected`` that are inliers for a camera near the predicted pose ``camera``. All K
    points are inliers if there are too few to decide. ``focal``: standard deviation of the logarithm of the focal length."""
    model, count = expected.model, len(expected.pixels)
    if count < FEWEST:
        return np.ones(count, dtype=bool)
    if expected.point_covariances is None:
        covariances = np.zeros((count, 2, 2))
        covariances[:, (0, 1), (0, 1)] = model.sigma**2
    else:
        _, _, by_point = reprojection.linearize_in_space(model, camera.position, camera.rotation, expected.points)
        covariances = pixel_kernels.pixel_noise(by_point, expected.point_covariances, float(model.sigma))
    if focal > 0.0:
        away = focal * (expected.pixels - (model.cx, model.cy))
        covariances = covariances + away[:, :, None] * away[:, None, :]
    return agreeing(model, camera, expected.points, expected.pixels, covariances)


def rows_of(factor: ReprojectionFactor, rows: Truths) -> ReprojectionFactor:
    """Return the factor with only the selected ``rows`` of its points."""
    covariances = None if factor.point_covariances is None else factor.point_covariances[rows]
    return replace(factor, points=factor.points[rows], pixels=factor.pixels[rows], point_covariances=covariances)
