"""Making of a map from a log: of its landmarks, of the RFID tags that it read, or of the points in its images."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
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
from factorgraph_loc.sensors.landmarks.measurement import Landmark
from factorgraph_loc.sensors.landmarks.summary import detected, require_mappable
from factorgraph_loc.sensors.registry import sensors
from factorgraph_loc.sensors.rfid.known_tags import tag_map
from factorgraph_loc.sensors.rfid.settings import SurveySettings
from factorgraph_loc.text import Notice, quoted
from factors import se2

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SUFFIX = ".world.toml"
POINTS = "points"
KINDS = (POINTS, "landmarks", "tags")  # kinds of maps; by default the first kind that a log has is mapped
FLAGS: dict[
    str, tuple[str, tuple[str, ...]]
] = {  # by field of MapOptions, its option on the command line, and the kinds of maps that have it
    "estimator": ("--estimator", ("landmarks",)),
    "settings": ("--set", ("landmarks",)),
    "height": ("--height", ("landmarks", "tags")),
    "points": ("--set points", (POINTS,)),
}
HEIGHTS = (-10.0, 20.0)  # m; bounds of the height of tags and landmarks
OF_REFERENCE = "that of the reference"
BY_RUN = "fgloc run -e smoother --set smoother.landmarks=unknown makes a map of points without a reference"
SOURCES = {"log": "the log's start", "reference": "its reference"}

Progress = Callable[[float], None]


@dataclass(frozen=True)
class MapOptions:
    """How a map is made.

    ``of``: landmarks, tags or points. None: points if the log has images, landmarks if it has measurements of
    landmarks, else tags. ``estimator``, ``settings``: the estimator of landmarks, and its settings {key: value}.
    ``points``: settings of a map of points, {field of :class:`~factorgraph_loc.mapping.point_mapping.PointSettings`:
    value}. ``extend``: whether to keep the log's map and to add missing objects. ``poses``: source of the robot poses
    for a map of tags: "reference", or "odometry" to estimate the poses together with the tags. None: "reference" if the
    log has one, else "odometry". ``height`` [m]: height of new tags or landmarks, None for the height of the antennas
    or of the radio. ``drop_dead``: make no new map, but remove dead tags from the log's map. A dead tag is never read,
    although the smoother expects reads. ``prior``: the start pose, such as "log" or "unknown", see
    :func:`~factorgraph_loc.experiments.preparation.resolve_prior`.
    """

    of: str | None = None
    estimator: str = MAP_ESTIMATORS[0]
    settings: Mapping[str, Any] = field(default_factory=dict)
    extend: bool = False
    poses: str | None = None
    height: float | None = None
    prior: str | None = None
    drop_dead: bool = False
    points: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class DroppedTags:
    """The result of the removal of dead tags from a map. ``dropped``: {removed tag: probability that it is dead}.
    ``kept``: number of the remaining tags."""

    dropped: Mapping[str, float]
    kept: int


@dataclass(frozen=True, eq=False)
class MadeMap:
    """A new map. ``world``: its content. ``frame``: a description of its frame. ``details``: results of the mapping.

    ``warnings``: warnings about the log and the run. ``draw``: a function that returns a plot of the map.
    """

    world: World
    frame: str
    details: LandmarkMap | MadeTags | PointReport | DroppedTags
    warnings: tuple[Notice, ...]
    draw: Callable[[], Figure]

    def write(self, out: Path, *, overwrite: bool = False) -> None:
        """Write the map to the file ``out``, and its plot next to it. Raises InputError if a file exists and
        ``overwrite`` is not set. Also raises it if a file cannot be written, or if ``out`` has a wrong suffix."""
        picture = plot_path(out, overwrite=overwrite)
        with writing(out), replacing(picture) as temporary:  # so that either both files are written, or none
            temporary.write_bytes(png_bytes(self.draw()))
            write_world(self.world, out)


def plot_path(out: Path, *, overwrite: bool) -> Path:
    """Return the path of the plot of a map with the path ``out``.

    Raises InputError if ``out`` does not end in :data:`SUFFIX`, or a file exists and ``overwrite`` is not set.
    """
    return with_ending(out, SUFFIX, ".map.png", overwrite=overwrite)


def make_map(log: Log, options: MapOptions | None = None, progress: Progress = lambda _share: None) -> MadeMap:
    """Return a map made from a log. If the log has a map already, it is compared with the new map, or extended.

    ``options``: how to make the map, None for the defaults. ``progress``: called with the completed fraction. Raises
    InputError if options contradict each other or do not fit the log, and RunFailedError if nothing could be located.
    """
    options = options or MapOptions()
    if options.drop_dead:
        return _without_dead(log, options, progress)
    what = _mapped_kind(log, options)
    if what == POINTS:
        return _of_points(log, options, progress)
    return _of_tags(log, options, progress) if what == "tags" else _of_landmarks(log, options, progress)


def _mapped_kind(log: Log, options: MapOptions) -> str:
    """Return the kind of map to make: ``options.of``, or the kind that other options imply, or the default for the log.

    Raises InputError if an option applies only to another kind.
    """
    if options.of not in (None, *KINDS):
        raise InputError(f"--of is {quoted(options.of)}, expected {' or '.join(KINDS)}")
    usual = MapOptions()
    given = {flag: kinds for name, (flag, kinds) in FLAGS.items() if getattr(options, name) != getattr(usual, name)}
    only = next((kinds[0] for kinds in given.values() if len(kinds) == 1), None)
    what = options.of or only or _usual_kind(log, extend=options.extend)
    if flag := next((flag for flag, kinds in given.items() if what not in kinds), None):
        raise InputError(
            f"{flag} is for maps of {' or '.join(given[flag])}, but this is a map of {what}: remove {flag}"
        )
    if options.height is not None and not HEIGHTS[0] <= options.height <= HEIGHTS[1]:
        raise InputError(f"--height is {options.height:g}, expected metres, {HEIGHTS[0]:g} to {HEIGHTS[1]:g}")
    return what


def _usual_kind(log: Log, *, extend: bool) -> str:
    """Return the default kind of map for a log: points, landmarks or tags. ``extend``: points are the default only if
    the log's map has points."""
    known = _mappable(log) - ({POINTS} if extend and log.world.points is None else set())
    return next((kind for kind in KINDS if kind in known), "landmarks")


def _mappable(log: Log) -> set[str]:
    """Return the kinds of maps that can be made from the streams of a log with its rig."""
    return {
        sensor.detects
        for sensor in sensors().values()
        for name in log.streams
        if sensor.detects and kind_of(name) == sensor.channels[0].name and not lacking_section(log.rig, name)
    }


def _of_landmarks(log: Log, options: MapOptions, progress: Progress) -> MadeMap:
    """Return a map of landmarks, made by a run of an estimator."""
    estimator, settings = options.estimator, dict(options.settings)
    if estimator not in MAP_ESTIMATORS:
        raise InputError(
            f"--estimator is {quoted(estimator)}, expected one that estimates landmarks: {', '.join(MAP_ESTIMATORS)}"
        )
    if options.poses is not None:
        raise InputError("--poses is for maps of tags, but this is a map of landmarks: remove --poses")
    if "landmarks" in settings:
        raise InputError(
            f"--set {estimator}.landmarks cannot be used to make a map: remove it. To keep the given landmarks, give --extend"
        )
    require_mappable(log)
    if options.extend and not log.world.landmarks:
        raise InputError(f"{log.name}: has no map that --extend could extend: remove --extend")
    if options.extend and options.height is not None:
        raise InputError(
            "--height does not apply to landmarks with --extend: state z of the landmarks in the map instead"
        )
    source, new = "", [name for name in detected(log) if name not in log.world.landmarks]
    if options.extend:
        started, config = log, RunConfig(estimator, settings | {"landmarks": "extended"}, prior=options.prior)
    else:
        started, source = _started_exactly(log, options.prior)
        started = replace(started, world=_at_height(log.world, new, options.height))
        config = RunConfig(estimator, settings | {"landmarks": "unknown"}, prior="log")
    result = run(started, config, progress)
    made = mapping.make_map(log, result.learnt.landmarks, extend=options.extend)
    mapped = [name for name in new if name in made.world.landmarks]
    made = replace(made, world=_at_height(made.world, mapped, options.height))
    trajectory = se2.compose(made.frame, result.final.poses)
    frame = "that of the given map" if options.extend or made.judged else f"that of the start: {source}"
    draw = partial(map_figure.figure, log.name, made, trajectory)
    return MadeMap(made.world, frame, made, result.warnings, draw)


def _at_height(world: World, names: Iterable[str], height: float | None) -> World:
    """Return the world with the landmarks ``names`` at ``height`` [m], or unchanged if it is None. Landmarks that are
    not in the world are added at x = y = 0, because their estimators use only the height."""
    if height is None:
        return world
    marks = {name: world.landmarks.get(name, Landmark(x=0.0, y=0.0)).model_copy(update={"z": height}) for name in names}
    return world.model_copy(update={"landmarks": {**world.landmarks, **marks}})


def _of_tags(log: Log, options: MapOptions, progress: Progress) -> MadeMap:
    """Return a map of RFID tags, made with the poses of the reference or with estimated poses."""
    uses_reference = _uses_reference(options, has_reference=log.reference is not None)
    if options.extend and not log.world.tags:
        raise InputError(f"{log.name}: has no map of tags that --extend could extend: remove --extend")
    prior, frame = (None, OF_REFERENCE) if uses_reference else _start_of_tags(log, options)
    poses: tag_mapping.Poses = "reference" if uses_reference else "odometry"
    made = tag_mapping.map_tags(log, poses, prior, extend=options.extend, height=options.height, progress=progress)
    if options.extend or (not uses_reference and made.made.judged):
        frame = "that of the given map"
    return MadeMap(made.world, frame, made, log.warnings, partial(map_figure.tag_figure, log.name, made))


def _without_dead(log: Log, options: MapOptions, progress: Progress) -> MadeMap:
    """Return the log's map without its dead tags: tags that were not read although the smoother expected reads."""
    if options != MapOptions(drop_dead=True, prior=options.prior):
        raise InputError("--drop-dead only removes dead tags from the log's map: remove all options but --prior")
    if "tags" not in _mappable(log) or not log.world.tags:
        raise InputError(f"{log.name}: has no reads or no map of tags, but --drop-dead requires both")
    result = run(log, RunConfig("smoother", prior=options.prior), progress)
    dead = dict(sorted(result.diagnostics.doubted.get("dead_tags", {}).items(), key=lambda row: -row[1]))
    world = log.world.model_copy(update={"tags": {n: tag for n, tag in log.world.tags.items() if n not in dead}})
    details = DroppedTags(dead, len(world.tags))
    known = tag_map(log.world, log.rig.of(SurveySettings))
    places = dict(zip(known.names, known.tags.points[:, :2], strict=True))
    draw = partial(map_figure.dropped_figure, log.name, places, dead, result.final.poses, world.walls)
    return MadeMap(world, "that of the given map", details, result.warnings, draw)


def _of_points(log: Log, options: MapOptions, progress: Progress) -> MadeMap:
    """Return a map of points, made from the images of a log and the poses of its reference."""
    camera = log.rig.find(CameraSettings)
    if camera is None:
        raise InputError(f"{log.name}: its rig {log.rig.name} has no [camera], so that its images cannot be mapped")
    if POINTS not in _mappable(log):
        raise InputError(f"{log.name}: has no images (camera), so that there are no points to map")
    if options.extend and log.world.points is None:
        raise InputError(f"{log.name}: has no map of points that --extend could extend: remove --extend")
    if options.poses not in (None, "reference"):
        raise InputError(f"--poses is {quoted(options.poses)}, expected reference for points: {BY_RUN}")
    settings = parse_model(PointSettings, options.points, "--set points")
    if log.reference is None:
        raise InputError(f"{log.name}: has no reference with the poses of its images: {BY_RUN}")
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
    """True if a map of tags uses the poses of the reference. ``has_reference``: whether the log has a reference."""
    if options.poses not in (None, "reference", "odometry"):
        raise InputError(f"--poses is {quoted(options.poses)}, expected reference or odometry")
    return has_reference if options.poses is None else options.poses == "reference"


def _started_exactly(log: Log, prior: str | None) -> tuple[Log, str]:
    """Return the log with a start pose that is known exactly, and a description of the start. ``prior``: the requested
    start, such as "log", or None. The start is exact, because it defines the frame of the map."""
    start, source = resolve_prior(log, prior)
    if start is None:
        t, pose, source = first_odometry(log), np.zeros(3), "the first pose is the origin (0, 0, 0)"
    else:
        t, pose, source = start.t, start.pose, _describe_start(start, source)
    return replace(log, start=StartPose(t, pose, np.full(3, EXACT_SIGMA))), source


def _start_of_tags(log: Log, options: MapOptions) -> tuple[PosePrior | None, str]:
    """Return the prior of the start for a map of tags without a reference, and a description of the map's frame.

    The prior is None if the start is unknown. The start of a new map is exact, because it defines the frame.
    """
    prior, source = resolve_prior(log, options.prior)
    if prior is None or (options.extend and not prior.has_heading):
        if options.extend:
            needed = "needs a start with a heading; give --prior X,Y,HEADING"
            raise InputError(f"{log.name}: --extend without reference poses {needed}")
        return None, "that of the start: the first pose is the origin (0, 0, 0)"
    certain = replace(prior, covariance=EXACT_SIGMA**2 * np.eye(3))
    return (prior if options.extend else certain), f"that of the start: {_describe_start(prior, source)}"


def _describe_start(start: PosePrior, source: str) -> str:
    """Return a description of a start pose. ``source``: "log", "reference" or another value of the prior."""
    x, y, heading = start.pose
    chosen = "" if start.has_heading else ", which has no heading"
    source = SOURCES.get(source, "--prior")
    return f"the robot starts at ({x:.3f} m, {y:.3f} m, {heading:.3f} rad), from {source}{chosen}"
