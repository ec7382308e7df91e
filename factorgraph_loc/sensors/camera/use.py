"""A camera in a run: checks of the settings, preparation of images, and detection of a wrong time offset or focal length.

Features followed from one image to the next measure how much the camera turned between them. The odometry's rotation depends on
the time of the images: of a grid of time offsets one fits best (compare Kelly, Sukhatme, International Journal of Robotics
Research 33(12), 2014). Noise and slip of the wheels are the same at each offset. The ratio of both rotations is unknown, so it
does not determine the focal length. But when a camera turns, features at the edges of the image move faster than in its middle,
the more so the shorter the focal length is.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.measurement import TURN, Measurement
from factorgraph_loc.model.measurement import named as name_of
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.settings import Estimated
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.measurement import CameraImage, FeatureStream, ImageStream, Pixels
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.interfaces import Ending, Review, Use
from factorgraph_loc.sensors.motion import Motion
from factorgraph_loc.sensors.registry import moving
from factorgraph_loc.sensors.tables import Intake
from factorgraph_loc.text import plain
from factorgraph_loc.vision.frame import CameraFrame
from factorgraph_loc.vision.image_turn import measure_turn
from factorgraph_loc.vision.settings import FrontendSettings
from factors import se2
from factors.camera.model import FOCAL, TIME_OFFSET, CameraModel
from factors.se2 import Array

if TYPE_CHECKING:
    from factorgraph_loc.sensors.camera.frontend import LiveFrontend


NAMES = ("camera", "sightings")


def check(use: Use) -> Use:
    """The run, with points estimated where the map has none and no other sensor needs a map, unless the user's settings say what is
    done."""
    motion = moving(use.sensors, TURN)
    unmapped = use.estimates_points and _uses_camera(use) and not _has_points(use)
    if "landmarks" in use.given or not unmapped or any(name not in (*NAMES, *motion) for name in use.sensors):
        return use
    settings = use.settings.model_copy(update={"landmarks": "unknown"})
    warning = f"the map has nothing that the camera could find: it is estimated ({use.estimator}.landmarks=unknown)"
    return replace(use, settings=settings, warnings=(*use.warnings, f"{use.log.name}: {warning}"))


def review(use: Use, _ending: Ending) -> Review:
    """The warnings of a run."""
    return Review(tuple(_doubts(use)))


def _doubts(use: Use) -> Iterator[str]:
    """A map without points that the camera could find, where the estimator needs them; a known map that was not wanted."""
    landmarks = getattr(use.settings, "landmarks", "known")
    if _has_points(use):
        if landmarks == "unknown" and not use.estimates_points:
            yield f"{use.log.name}: {use.estimator} does not estimate points: those of the map are used unchanged"
    elif _uses_camera(use) and not (use.estimates_points and landmarks != "known"):
        alternative = f", or {use.estimator}.landmarks=unknown" if use.estimates_points else ""
        yield f"{use.log.name}: the map has no points that a camera could find: give --world{alternative}"


def _uses_camera(use: Use) -> bool:
    return "camera" in use.modalities and any(name in use.sensors for name in NAMES)


def _has_points(use: Use) -> bool:
    """Whether the camera is used, and the map has points that it could find."""
    points = use.log.world.points
    if points is None or not _uses_camera(use):
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
    replaced, warnings = with_features(log, frontend_of(log.rig, log.world), progress)
    return PreparedLog(replaced, warnings, len(stream.t), perf_counter() - started)


def _set_aside(log: Log, stream: ImageStream, estimator: str) -> PreparedLog:
    """Frames without features; their timestamps still define the start and end of the run."""
    nothing = CameraFrame(0.0, "", np.empty((0, 2)), np.empty((0, 0), dtype=np.uint8), np.empty(0, dtype=np.int64))
    frames = FeatureStream(stream.t, [nothing] * len(stream.t))
    warning = (f"{log.name}: {estimator} does not use images: all {len(stream.t)} are ignored",)
    by_name = estimator == "dead_reckoning"  # obvious from its name
    return PreparedLog(replace(log, streams={**log.streams, "camera": frames}), () if by_name else warning)


class CameraIntake(Intake):
    """Detects and tracks features in pushed images. Descriptors of a feature have the length of the map's, or of the first
    frame's."""

    def __init__(self, rig: Rig, world: World) -> None:
        points = world.points
        self._rig, self._world = rig, world
        self._frontend: LiveFrontend | None = None
        self._lock = threading.Lock()
        self._known = {} if points is None or not points.feature else {points.feature: points.descriptors.shape[1]}

    def measured(self, m: Measurement) -> Measurement:
        if not isinstance(m, CameraImage):
            return m
        from factorgraph_loc.sensors.camera.frontend import LiveFrontend  # noqa: PLC0415 - OpenCV, for images only

        with self._lock:
            if self._frontend is None:
                settings = frontend_of(self._rig, self._world)
                self._frontend = LiveFrontend(settings, self._rig.of(CameraSettings).model())
            return self._frontend.frame(m.t, m.pixels)

    def require(self, m: Measurement) -> None:
        if not isinstance(m, CameraFrame) or not len(m.pixels):
            return
        width = m.descriptors.shape[1]
        if width != self._known.setdefault(m.feature, width) or not width:
            expected = f"{self._known[m.feature]} numbers each, as in earlier {plain(m.feature)}"
            raise bad_field(name_of(m), "length of descriptors", width, expected)


OFFSETS = np.linspace(-0.3, 0.3, 31)  # s that are tried
SHORTEST, LONGEST = 0.15, 1.0  # s between images that are compared
TURNED, CHANGED = 0.05, 0.02  # rad: least turn between them, or least change of it by a fifth of a second
# rad, and relative: largest standard deviations of turn and focal length from two images
SHARP, CLEAR = 0.003, 0.1
SLIPPED = 5.0  # standard deviations from what the wheels say at any offset
FEWEST, MOST = 40, 200  # pairs of images: what is right until then stays so
LATE, WRONG = 0.03, 0.01  # s, and relative: smaller errors are not reported
SIGNIFICANT = 5.0  # standard deviations beyond that


class _Image(NamedTuple):
    t: float
    names: NDArray[Any]
    pixels: Array


class TurnCheck:
    """Reports each wrong constant once, as an event; see the module. ``estimated``: constants that are not checked. Without a
    ``model`` nothing is."""

    def __init__(
        self, model: CameraModel | None, motion: Motion, diagnostics: Diagnostics, estimated: Estimated
    ) -> None:
        self._model, self._motion, self._diagnostics = model, motion, diagnostics
        self._open = {FOCAL, TIME_OFFSET} - set(estimated.indices)
        self.told = False  # whether a constant is wrong
        self._left = MOST
        self._last: _Image | None = None
        self._waiting: deque[tuple[_Image, _Image]] = deque()  # for the odometry of after them
        # number of turns, their squares, products with those of the wheels, and the squares of these, by offset
        self._turns = np.zeros((4, len(OFFSETS)))
        self._focal = np.zeros(4)  # number, and moments of the error of the focal length with their weight

    def add(self, m: Pixels) -> None:
        """Add an image; a late one is left out."""
        model, last, t = self._model, self._last, m.t
        if model is None or not self._open or not self._left:
            return
        if last is not None and t < last.t + SHORTEST:
            return
        while self._waiting and self._waiting[0][1].t + OFFSETS[-1] < t:
            first, second = self._waiting.popleft()
            if t - first.t < self._motion.horizon - LONGEST:  # the odometry of then is still kept
                self._compare(model, first, second)
        names = m.names if m.frame is None else m.frame.tracks
        self._last = _Image(t, np.asarray(names), np.asarray(m.pixels, dtype=float))
        if last is not None and t < last.t + LONGEST:
            self._waiting.append((last, self._last))

    def _compare(self, model: CameraModel, first: _Image, second: _Image) -> None:
        """Compare the turn between two images with those of the wheels at all offsets."""
        motion, middle = self._motion, len(OFFSETS) // 2
        begin, constants = motion.state(first.t), np.zeros(len(motion.constants.names))
        start, end = (motion.poses_at(begin, image.t + OFFSETS, constants)[:, 2] for image in (first, second))
        turns = se2.wrap(end - start)
        if abs(turns[middle]) < TURNED and abs(turns[middle + 5] - turns[middle - 5]) < CHANGED:
            return
        self._left -= 1
        _, rows, columns = np.intersect1d(first.names, second.names, return_indices=True)
        step = motion.relative(begin, motion.state(second.t))
        starts = [np.append(step.delta[:2], turn) for turn in turns[::5].tolist()]
        turn_focal = measure_turn(model, first.pixels[rows], second.pixels[columns], starts)
        if turn_focal is None:
            return
        (turn, sigma), (focal, focal_sigma) = turn_focal
        if focal_sigma < CLEAR:
            self._focal += np.array((focal_sigma**2, 1.0, focal, focal**2)) / focal_sigma**2
            self._tell_focal(second.t)
        variance = float(step.covariance[2, 2]) + SHARP**2
        if sigma < SHARP and np.min(np.abs(turn - turns)) < SLIPPED * math.sqrt(variance):
            same = np.ones_like(turns)
            self._turns += np.array((same * variance, same * turn**2, turn * turns, turns**2)) / variance
            self._tell_offset(second.t)

    def _tell_offset(self, t: float) -> None:
        count, own, both, squares = self._turns
        if TIME_OFFSET not in self._open or count[0] < FEWEST:
            return
        left = own - both**2 / squares  # with the share that fits best of what the wheels turned
        best = int(np.argmin(left))
        evidence = (left[np.abs(OFFSETS) < LATE].min() / left[best] - 1.0) * count[0]
        if evidence > SIGNIFICANT**2:
            late = "later" if OFFSETS[best] > 0.0 else "earlier"
            what = f"images seem to be taken {abs(OFFSETS[best]):.2f} s {late} than they are stamped (time_offset)"
            self._tell(TIME_OFFSET, t, what)

    def _tell_focal(self, t: float) -> None:
        count, weight, first, second = self._focal.tolist()
        error = first / weight
        sigma = math.sqrt(max(1.0, (second - first * error) / count) / weight)
        if FOCAL in self._open and count >= FEWEST and abs(error) > WRONG + SIGNIFICANT * sigma:
            comparison = "longer" if error > 0.0 else "shorter"
            what = f"the focal length seems to be {100.0 * abs(error):.0f} % {comparison} than the rig says (fx, fy)"
            self._tell(FOCAL, t, what)

    def _tell(self, constant: int, t: float, what: str) -> None:
        self.told = True
        self._open.remove(constant)
        self._diagnostics.event(t, f"camera: {what}")
