"""Converts camera measurements to factors of points of the map, identified by name or by matching features."""

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
from factors.se2 import Array, Integers

DISAGREES = "camera: point disagrees with the other points of the image"
FEW_SHARE = 0.3  # points are missing in an image if the inliers are a smaller fraction of its named points
FEW, MANY = 6, 20  # points are missing in an image if fewer than FEW features match, although MANY are expected
UNSURE = 1.0  # m; MANY is not required if the standard deviation of the predicted position is larger
MOST = 100  # maximum number of points used per image; errors of more points would be correlated
STEEPEST = 0.06  # rad; an image that requires a larger tilt of the robot is rejected
# the survey of a named point is exact if its error is below the fraction EXACT_SURVEY of a pixel at the distance NEAR [m]
EXACT_SURVEY, NEAR = 0.2, 3.0
EXACT = 0.1  # a map is exact if all its errors are below this fraction of a pixel at a distance of 1 m
ITERATIONS, SETTLED = 8, 1e-3  # number of iterations of a correction; it ends if a step [m, rad] is smaller

NOT_DISPLACED: Mapping[str, tuple[Array, Array]] = MappingProxyType({})


@dataclass(frozen=True)
class Predicted:
    """The current estimate of the state. It predicts the positions of points in an image.

    ``pose`` (3,) with body-frame ``covariance`` (3, 3): the pose of the robot. ``constants`` (P,) with covariance
    ``spread`` (P, P): estimated corrections of P camera constants in the rig, None if no constants are estimated.
    """

    pose: Array
    covariance: Array
    constants: Array | None = None
    spread: Array | None = None


class KnownPoints:
    """Converts camera measurements to factors of points in the map. The diagnostics count points that are not in the
    map as ignored, and outliers as rejected.

    ``estimated``: the camera's constants that are estimated. ``use``: "known" to use the points of the map, "extended"
    if the estimator also estimates other points, "unknown" to ignore the map. ``name``: the name of the sensor.
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
        self._tempering = settings.tempering  # exponent of the likelihood of matched points; it is 1 for named points
        self.map = PointMap.of((), np.empty((0, 3)))
        if setup.world.points is not None and use != "unknown":
            self.map = without_common(setup.world.points)
        self._others_matter = use != "known"
        self.used: Integers = np.empty(0, dtype=np.int64)  # features of the last image that match points of the map
        self.names: tuple[str, ...] = ()  # names of the points in the last factor; () for matched features
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
        """Return the points in ``m`` with an inexact survey. Keys are names of markers, or of points without a marker.
        Values are the names of the points, and the covariance (3, 3) [m^2] of the survey error that they share."""
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
        """Return the factor of all points in ``m`` that are in the map, or None if no point is. The factor depends on
        the pose at the time of ``m``. Outliers are not removed."""
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
        """Return the factor of the points in ``m`` that are in the map, without outliers, or None if no points remain.

        ``predicted``: the estimate at which outliers are detected. ``offset``: the motion from the pose that the factor
        depends on to the image, None if the times are equal. ``twist`` (3,): the robot's velocity at the image,
        required if the camera's time offset is estimated. ``displaced``: by the name of a point, its estimated
        displacement (3,) [m] from the map, and the covariance (3, 3) of its position.
        """
        self.used = np.empty(0, dtype=np.int64)
        factor = self.named(m) if isinstance(m, PixelSightings) else self._empty_factor(m)
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
            return None if found is None else self._with_tilt(found, found, predicted)
        right = _inliers(expected, camera, focal)
        agreed = int(np.count_nonzero(right))
        levelled = self._with_tilt(rows_of(factor, right), rows_of(expected, right), predicted) if agreed else None
        if levelled is None:
            right, agreed = np.zeros_like(right), 0
        self.missed = agreed < FEW_SHARE * len(right)
        if agreed < len(right):
            self._diagnostics.reject(DISAGREES, len(right) - agreed)
            self.names = tuple(self.names[row] for row in np.flatnonzero(right).tolist())
        return levelled

    def find(self, m: Pixels) -> tuple[FoundOnFloor | None, int]:
        """Return the robot's pose at the image ``m``, computed without a prediction, or None if no pose fits. Also
        return the number of points of the map that are expected in the image."""
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

    def _empty_factor(self, m: CameraFrame) -> ReprojectionFactor | None:
        """Return a factor without points. The caller then adds matched points. Returns None if the features in ``m``
        cannot be matched, for example because the map has features of another kind."""
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
        """Return ``factor`` with the points of the map that match features of the image ``m``, or None without matches.
        ``model``: the camera model with estimated constants. ``camera``: the predicted pose. ``focal``: relative
        standard deviation of the focal length."""
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

    def _with_tilt(
        self, factor: ReprojectionFactor, expected: ReprojectionFactor, predicted: Predicted
    ) -> ReprojectionFactor | None:
        """Return ``factor`` with a new standard deviation of the robot's tilt, which is estimated from the image.

        ``expected``: the same factor with fixed constants. ``predicted``: the estimate of the robot's pose. Returns
        None if the tilt exceeds :data:`STEEPEST`, because the matches are then probably wrong.
        """
        if expected.estimated:  # errors of the constants have the same effect as a tilt
            return factor
        pose, covariance = (np.ascontiguousarray(part, dtype=float) for part in (predicted.pose, predicted.covariance))
        tilt, noise = pixel_kernels.leaning(expected.packed(), pose, covariance)
        if math.hypot(*tilt) > STEEPEST:
            return None
        self.floor, sigma = self.floor.learnt(tilt, noise, float(expected.model.tilt))
        return replace(factor, model=replace(factor.model, tilt=sigma))

    def _camera(self, expected: ReprojectionFactor, predicted: Predicted) -> CameraPose:
        """Return the pose of the camera at the image of the factor ``expected``, from the estimate ``predicted`` of the
        robot's pose. Its covariance includes the uncertainty of the mounting and of the time offset."""
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
    """Return the 3-D pose of the camera of a robot, with covariance. ``pose`` (3,) with body-frame ``covariance`` (3,
    3): the robot's pose. The tilt of the robot is added to the covariance."""
    arrays = (np.ascontiguousarray(part, dtype=float) for part in (pose, covariance))
    return CameraPose(*pixel_kernels.placed(model.position, model.rotation, float(model.tilt), *arrays))


def _inliers(expected: ReprojectionFactor, camera: CameraPose, focal: float) -> Truths:
    """Return a mask (K,) that is True for the points of ``expected`` that are inliers. It is True for all if there are
    too few points. ``camera``: the predicted pose. ``focal``: relative standard deviation of the focal length."""
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
    """Return a copy of ``factor`` with only those of its K points that the mask ``rows`` (K,) selects."""
    covariances = None if factor.point_covariances is None else factor.point_covariances[rows]
    return replace(factor, points=factor.points[rows], pixels=factor.pixels[rows], point_covariances=covariances)
