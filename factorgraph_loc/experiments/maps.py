"""Maps from a log: of its landmarks, of the RFID tags that it read, or of the points in its images."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from factorgraph_loc.drawing.figures import png_bytes
from factorgraph_loc.errors import InputError
from factorgraph_loc.experiments.output import with_ending
from factorgraph_loc.experiments.preparation import first_odometry, resolve_prior
from factorgraph_loc.experiments.run import run
from factorgraph_loc.files.models import parse_model, replacing
from factorgraph_loc.files.temporary import writing
from factorgraph_loc.io.native.world_file import write_world
from factorgraph_loc.mapping import map_figure, mapping, tag_mapping
from factorgraph_loc.mapping.mapping import LandmarkMap
from factorgraph_loc.mapping.point_mapping import PointReport, PointSettings, map_points, posed_frames
from factorgraph_loc.mapping.point_maps import merged, thinned
from factorgraph_loc.mapping.tag_mapping import MadeTags
from factorgraph_loc.model.belief import EXACT_SIGMA, PosePrior
from factorgraph_loc.model.log import Log, StartPose
from factorgraph_loc.model.scoring import RunConfig
from factorgraph_loc.model.sections import kind_of
from factorgraph_loc.model.world import World
from factorgraph_loc.plugins import MAP_ESTIMATORS
from factorgraph_loc.sensors.camera.frontend import with_features
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.interfaces import lacking_section
from factorgraph_loc.sensors.landmarks.summary import require_mappable
from factorgraph_loc.sensors.registry import sensors
from factorgraph_loc.sensors.rfid.known_tags import tag_map
from factorgraph_loc.sensors.rfid.settings import SurveySettings
from factorgraph_loc.text import Notice, quoted
from factors import se2

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SUFFIX = ".world.toml"
POINTS = "points"
KINDS = (POINTS, "landmarks", "tags")  # the first that a log has is mapped
FLAGS = {  # options of one kind of map
    "estimator": ("--estimator", "landmarks"),
    "settings": ("--set", "landmarks"),
    "tag_height": ("--tag-height", "tags"),
    "points": ("--set points", POINTS),
}
HEIGHTS = (-10.0, 20.0)  # m
OF_REFERENCE = "that of the reference"
BY_RUN = "fgloc run -e smoother --set smoother.landmarks=unknown makes a map of points without one"
SOURCES = {"log": "the log's start", "reference": "its reference"}

Progress = Callable[[float], None]


@dataclass(frozen=True)
class MapOptions:
    """How a map is made.

    ``of``: landmarks, tags or points; None: points if the log has images, landmarks if it has sightings of them, else tags.
    ``estimator`` and ``settings``: for landmarks; ``points``: settings of points, fields of
    :class:`~factorgraph_loc.mapping.point_mapping.PointSettings`. ``extend``: keep the log's map, and add what it lacks. ``poses``:
    of the robot, for tags: reference, or odometry, with estimation of the poses; None: the reference if there is one.
    ``tag_height`` [m]: of tags that the log's map lacks; None: that of the antennas. ``drop_dead``: write the log's map without the
    tags that are believed dead, and map nothing. ``prior``: see :func:`~factorgraph_loc.experiments.preparation.resolve_prior`.
    """

    of: str | None = None
    estimator: str = MAP_ESTIMATORS[0]
    settings: Mapping[str, Any] = field(default_factory=dict)
    extend: bool = False
    poses: str | None = None
    tag_height: float | None = None
    prior: str | None = None
    drop_dead: bool = False
    points: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class DroppedTags:
    """An edited map: ``dropped`` tags with their probability of being dead, and the number ``kept``."""

    dropped: Mapping[str, float]
    kept: int


@dataclass(frozen=True, eq=False)
class MadeMap:
    """A map: the ``world`` to be written; ``frame``: its frame in words; ``details``: results, by kind of map.

    ``warnings``: of the log and the run. ``draw`` makes a plot of it.
    """

    world: World
    frame: str
    details: LandmarkMap | MadeTags | PointReport | DroppedTags
    warnings: tuple[Notice, ...]
    draw: Callable[[], Figure]

    def write(self, out: Path, *, overwrite: bool = False) -> None:
        """Write the map and its plot. Raises InputError as :func:`plot_path`, or if they cannot be written."""
        picture = plot_path(out, overwrite=overwrite)
        with writing(out), replacing(picture) as temporary:  # write both or none
            temporary.write_bytes(png_bytes(self.draw()))
            write_world(self.world, out)


def plot_path(out: Path, *, overwrite: bool) -> Path:
    """The path of the plot of a map. Raises InputError for a wrong name of the map, or if a file exists already."""
    return with_ending(out, SUFFIX, ".map.png", overwrite=overwrite)


def make_map(log: Log, options: MapOptions | None = None, progress: Progress = lambda _share: None) -> MadeMap:
    """Make a map from a log. An existing map of the log is compared, or extended.

    ``progress`` is called with the fraction done. Raises InputError for options that do not fit together or the log,
    RunFailedError if nothing could be located.
    """
    options = options or MapOptions()
    if options.drop_dead:
        return _without_dead(log, options, progress)
    what = _mapped_kind(log, options)
    if what == POINTS:
        return _of_points(log, options, progress)
    return _of_tags(log, options, progress) if what == "tags" else _of_landmarks(log, options, progress)


def _mapped_kind(log: Log, options: MapOptions) -> str:
    """The kind of map. Raises InputError for options of another kind."""
    if options.of not in (None, *KINDS):
        raise InputError(f"--of is {quoted(options.of)}, expected {' or '.join(KINDS)}")
    usual = MapOptions()
    given = {flag: kind for name, (flag, kind) in FLAGS.items() if getattr(options, name) != getattr(usual, name)}
    what = options.of or next(iter(given.values()), None) or _usual_kind(log, extend=options.extend)
    if flag := next((flag for flag, kind in given.items() if kind != what), None):
        raise InputError(f"{flag} is for maps of {given[flag]}, but {what} are mapped here; leave {flag} out")
    return what


def _usual_kind(log: Log, *, extend: bool) -> str:
    """The kind of map that is made by default."""
    known = _mappable(log) - ({POINTS} if extend and log.world.points is None else set())
    return next((kind for kind in KINDS if kind in known), "landmarks")


def _mappable(log: Log) -> set[str]:
    """The layers of a world that can be mapped from a log."""
    return {
        sensor.detects
        for sensor in sensors().values()
        for name in log.streams
        if sensor.detects and kind_of(name) == sensor.channels[0].name and not lacking_section(log.rig, name)
    }


def _of_landmarks(log: Log, options: MapOptions, progress: Progress) -> MadeMap:
    estimator, settings = options.estimator, dict(options.settings)
    if estimator not in MAP_ESTIMATORS:
        raise InputError(
            f"--estimator is {quoted(estimator)}, expected one that estimates landmarks: {', '.join(MAP_ESTIMATORS)}"
        )
    if options.poses is not None:
        raise InputError("--poses is for maps of tags, but landmarks are mapped here; leave it out")
    if "landmarks" in settings:
        raise InputError(
            f"--set is {estimator}.landmarks, but --extend alone selects how the map is used; leave it out"
        )
    require_mappable(log)
    if options.extend and not log.world.landmarks:
        raise InputError(f"{log.name}: has no map that could be extended; leave --extend out")
    source = ""
    if options.extend:
        started, config = log, RunConfig(estimator, settings | {"landmarks": "extended"}, prior=options.prior)
    else:
        started, source = _started_exactly(log, options.prior)
        config = RunConfig(estimator, settings | {"landmarks": "unknown"}, prior="log")
    result = run(started, config, progress)
    made = mapping.make_map(log, result.learnt.landmarks, extend=options.extend)
    trajectory = se2.compose(made.frame, result.final.poses)
    frame = "that of the given map" if options.extend or made.judged else f"that of the start: {source}"
    draw = partial(map_figure.figure, log.name, made, trajectory)
    return MadeMap(made.world, frame, made, result.warnings, draw)


def _of_tags(log: Log, options: MapOptions, progress: Progress) -> MadeMap:
    uses_reference = _uses_reference(options, has_reference=log.reference is not None)
    height = options.tag_height
    if height is not None and not HEIGHTS[0] <= height <= HEIGHTS[1]:
        raise InputError(f"--tag-height is {height:g}, expected metres, {HEIGHTS[0]:g} to {HEIGHTS[1]:g}")
    if options.extend and not log.world.tags:
        raise InputError(f"{log.name}: has no map of tags that could be extended; leave --extend out")
    prior, frame = (None, OF_REFERENCE) if uses_reference else _start_of_tags(log, options)
    poses: tag_mapping.Poses = "reference" if uses_reference else "odometry"
    made = tag_mapping.map_tags(log, poses, prior, extend=options.extend, height=height, progress=progress)
    if options.extend or (not uses_reference and made.made.judged):
        frame = "that of the given map"
    return MadeMap(made.world, frame, made, log.warnings, partial(map_figure.tag_figure, log.name, made))


def _without_dead(log: Log, options: MapOptions, progress: Progress) -> MadeMap:
    """The map without tags that were not read where the smoother expects them to be."""
    if options != MapOptions(drop_dead=True, prior=options.prior):
        raise InputError("--drop-dead edits the log's map and maps nothing, expected no other option but --prior")
    if "tags" not in _mappable(log) or not log.world.tags:
        raise InputError(f"{log.name}: has no reads, or no map of tags, expected both to find tags that are dead")
    result = run(log, RunConfig("smoother", prior=options.prior), progress)
    dead = dict(sorted(result.diagnostics.doubted.get("dead_tags", {}).items(), key=lambda row: -row[1]))
    world = log.world.model_copy(update={"tags": {n: tag for n, tag in log.world.tags.items() if n not in dead}})
    details = DroppedTags(dead, len(world.tags))
    known = tag_map(log.world, log.rig.of(SurveySettings))
    places = dict(zip(known.names, known.tags.points[:, :2], strict=True))
    draw = partial(map_figure.dropped_figure, log.name, places, dead, result.final.poses, world.walls)
    return MadeMap(world, "that of the given map", details, result.warnings, draw)


def _of_points(log: Log, options: MapOptions, progress: Progress) -> MadeMap:
    camera = log.rig.find(CameraSettings)
    if camera is None:
        raise InputError(f"{log.name}: its rig {log.rig.name} has no [camera], so that its images cannot be mapped")
    if POINTS not in _mappable(log):
        raise InputError(f"{log.name}: has no images (camera), so that there are no points to map")
    if options.extend and log.world.points is None:
        raise InputError(f"{log.name}: has no map of points that could be extended; leave --extend out")
    if options.poses not in (None, "reference"):
        raise InputError(f"--poses is {quoted(options.poses)}, expected reference for points: {BY_RUN}")
    settings = parse_model(PointSettings, options.points, "--set points")
    if log.reference is None:
        raise InputError(f"{log.name}: has no reference that says where its images were taken: {BY_RUN}")
    observed, doubts = with_features(log, camera.frontend, lambda share: progress(share / 2.0))
    posed = posed_frames(observed)
    made = map_points(camera.model(), posed, settings, progress=lambda share: progress((1.0 + share) / 2.0))
    points, fused = made.points, 0
    if options.extend and log.world.points is not None:
        points, fused = merged(log.world.points, points)
    if settings.most is not None:
        points = thinned(points, settings.most)
    world = log.world.model_copy(update={"name": f"{log.name}-map", "points": points})
    draw = partial(map_figure.point_figure, log.name, points, made.cameras.positions, world.walls)
    details = replace(made.report, points=len(points), fused=fused)
    return MadeMap(world, OF_REFERENCE, details, (*log.warnings, *doubts), draw)


def _uses_reference(options: MapOptions, *, has_reference: bool) -> bool:
    """Whether the robot's poses are those of the reference; ``has_reference``: whether a usable one exists."""
    if options.poses not in (None, "reference", "odometry"):
        raise InputError(f"--poses is {quoted(options.poses)}, expected reference or odometry")
    return has_reference if options.poses is None else options.poses == "reference"


def _started_exactly(log: Log, prior: str | None) -> tuple[Log, str]:
    """The log with an exact start, and its position in words."""
    start, source = resolve_prior(log, prior)
    if start is None:
        t, pose, source = first_odometry(log), np.zeros(3), "the first pose is the origin (0, 0, 0)"
    else:
        t, pose, source = start.t, start.pose, _in_words(start, source)
    return replace(log, start=StartPose(t, pose, np.full(3, EXACT_SIGMA))), source


def _start_of_tags(log: Log, options: MapOptions) -> tuple[PosePrior | None, str]:
    """The start of the robot, and the frame in words. If no map is used the start is exact, as it defines the frame."""
    prior, source = resolve_prior(log, options.prior)
    if prior is None or (options.extend and not prior.has_heading):
        if options.extend:
            needed = "needs a start with a heading; give --prior X,Y,HEADING"
            raise InputError(f"{log.name}: --extend without reference poses {needed}")
        return None, "that of the start: the first pose is the origin (0, 0, 0)"
    certain = replace(prior, covariance=EXACT_SIGMA**2 * np.eye(3))
    return (prior if options.extend else certain), f"that of the start: {_in_words(prior, source)}"


def _in_words(start: PosePrior, source: str) -> str:
    x, y, heading = start.pose
    chosen = "" if start.has_heading else ", which has no heading"
    source = SOURCES.get(source, "--prior")
    return f"the robot starts at ({x:.3f} m, {y:.3f} m, {heading:.3f} rad), from {source}{chosen}"
