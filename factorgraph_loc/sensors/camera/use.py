"""Use of a camera in a run: settings that it requires, preparation of its images, warnings, and the frame of its map."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Container, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.maps.common_error import CommonError
from factorgraph_loc.model.belief import Belief, PoseEstimate, PosePrior
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.measurement import TURN
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.setup import MapUse, Setup
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.measurement import FeatureStream, ImageStream
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.interfaces import Ending, Review, Use
from factorgraph_loc.sensors.registry import moving
from factorgraph_loc.vision.frame import CameraFrame
from factorgraph_loc.vision.settings import FrontendSettings
from factors.se2 import Array

NAMES = ("camera", "sightings")


def check(use: Use) -> Use:
    """The run, with points estimated where the map has none and no other sensor needs a map, unless the user's settings say what is
    done."""
    motion = moving(use.sensors, TURN)
    unmapped = use.estimates_points and _looks(use) and not _has_points(use) and not _follows(use)
    if "landmarks" in use.given or not unmapped or any(name not in (*NAMES, *motion) for name in use.sensors):
        return use
    settings = use.settings.model_copy(update={"landmarks": "unknown"})
    told = f"the map has nothing that the camera could find: it is estimated ({use.estimator}.landmarks=unknown)"
    return replace(use, settings=settings, warnings=(*use.warnings, f"{use.log.name}: {told}"))


def review(use: Use, _ending: Ending) -> Review:
    """The warnings of a run."""
    return Review(tuple(_doubts(use)))


def _doubts(use: Use) -> Iterator[str]:
    """A map without points that the camera could find, where the estimator needs them; a known map that was not wanted."""
    landmarks = getattr(use.settings, "landmarks", "known")
    if _has_points(use):
        if landmarks == "unknown" and not use.estimates_points:
            yield f"{use.log.name}: {use.estimator} does not estimate points: those of the map are used as they are"
    elif _looks(use) and not _follows(use) and not (use.estimates_points and landmarks != "known"):
        others = f", or {use.estimator}.landmarks=unknown" if use.estimates_points else ""
        yield f"{use.log.name}: the map has no points that a camera could find: give --world{others}"


def _looks(use: Use) -> bool:
    return "camera" in use.modalities and any(name in use.sensors for name in NAMES)


def _follows(use: Use) -> bool:
    """Whether features that are no points tell the motion."""
    return getattr(use.settings, "visual_odometry", False) is True


def _has_points(use: Use) -> bool:
    """Whether the camera is used, and the map has points that it could find."""
    points = use.log.world.points
    if points is None or not _looks(use):
        return False
    return bool(len(points) if "sightings" in use.sensors else len(points.owners))


@dataclass(frozen=True)
class PreparedLog:
    """A ``log`` that can be run, with images replaced by features. ``images``: number of images whose features were computed or
    loaded from the cache, in ``seconds``."""

    log: Log
    warnings: tuple[str, ...] = ()
    images: int = 0
    seconds: float = 0.0


def uses_images(sensors: Collection[str], modalities: Collection[str]) -> bool:
    """Whether an estimator with these ``modalities`` and ``sensors`` uses images."""
    return "camera" in sensors and "camera" in modalities


def frontend_of(rig: Rig, world: World) -> FrontendSettings:
    """The feature settings: those of the map's points, else those of the rig's camera.

    Without a map features are taken everywhere, since most of the strongest may be those of a thing that moves.
    """
    camera = rig.find(CameraSettings)
    settings = FrontendSettings() if camera is None else camera.frontend
    if world.points is None or not world.points.feature:
        return settings.model_copy(update={"everywhere": True})
    return settings.model_copy(update={"feature": world.points.feature})


def frames_of(log: Log) -> tuple[Array, Sequence[CameraFrame]]:
    """Timestamps (N,) and features of a log's images after feature detection; InputError if it has none."""
    stream = log.streams.get("camera")
    if not isinstance(stream, FeatureStream):
        raise InputError(f"{log.name}: has no images (camera), so there are no points to map")
    return stream.t + log.rig.time_offset("camera"), stream.frame


def prepare(use: Use, progress: Callable[[float], None]) -> PreparedLog:
    """Replace images by features if the run uses them, else by empty frames."""
    log, stream = use.log, use.log.streams.get("camera")
    if "camera" not in use.sensors or not isinstance(stream, ImageStream):
        return PreparedLog(log)
    if "camera" not in use.modalities:
        return _set_aside(log, stream, use.estimator)
    from factorgraph_loc.sensors.camera.frontend import with_features  # noqa: PLC0415 - runs without images need no OpenCV

    started = perf_counter()
    found, warnings = with_features(log, frontend_of(log.rig, log.world), progress)
    return PreparedLog(found, warnings, len(stream.t), perf_counter() - started)


def _set_aside(log: Log, stream: ImageStream, estimator: str) -> PreparedLog:
    """Frames without features; their timestamps still define the start and end of the run."""
    nothing = CameraFrame(
        0.0, "", np.empty((0, 2)), np.empty(0), np.empty((0, 0), dtype=np.uint8), np.empty(0, dtype=np.int64)
    )
    frames = FeatureStream(stream.t, [nothing] * len(stream.t))
    told = (f"{log.name}: {estimator} does not use images: all {len(stream.t)} are ignored",)
    by_name = estimator == "dead_reckoning"  # obvious from its name
    return PreparedLog(replace(log, streams={**log.streams, "camera": frames}), () if by_name else told)


@dataclass(frozen=True)
class MapFrame:
    """``error``: the covariances (N, 3, 3) of (x, y, heading) of the map's frame at poses (N, 3); None where it is exact."""

    error: Callable[[Array], Array] | None = None

    @classmethod
    def of(cls, setup: Setup, modalities: Container[str], landmarks: MapUse) -> MapFrame:
        """That of a run; ``modalities``: of measurements that the estimator takes, ``landmarks``: how it uses the map."""
        points, camera = setup.world.points, setup.rig.find(CameraSettings)
        used = "camera" in setup.sensors and "camera" in modalities and landmarks != "unknown"
        if points is None or camera is None or not used or (common := CommonError.of(points)) is None:
            return cls()
        ahead = camera.model().rotation[:, 2]
        return cls(partial(common.at, looking=math.atan2(ahead[1], ahead[0])))

    def prior(self, prior: PosePrior) -> PosePrior:
        """A start in the world, as one in the map."""
        if self.error is None:
            return prior
        return replace(prior, covariance=prior.covariance + self.error(prior.pose[None])[0])

    def estimate(self, estimate: PoseEstimate) -> PoseEstimate:
        """An estimate in the map, as one in the world."""
        if self.error is None or estimate.status == "unlocalized":
            return estimate
        return replace(estimate, covariance=estimate.covariance + self.error(estimate.pose[None])[0])

    def belief(self, belief: Belief) -> Belief:
        """The same of a belief; particles stay in the map."""
        if self.error is None:
            return belief
        modes = (replace(m, covariance=m.covariance + self.error(m.pose[None])[0]) for m in belief.modes)
        return replace(belief, modes=tuple(modes))

    def trajectory(self, trajectory: Trajectory) -> Trajectory:
        """The same of a trajectory."""
        if self.error is None or trajectory.covariances is None or not len(trajectory):
            return trajectory
        return replace(trajectory, covariances=trajectory.covariances + self.error(trajectory.poses))
