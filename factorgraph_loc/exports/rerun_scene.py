"""Exports a log and its runs as a Rerun recording (https://rerun.io).

All positions are in the world frame [m], z up. The timeline ``log_time`` counts seconds from the start of the log. All
data are sent as columns, because Rerun 0.41 writes broken files for single values logged with
``set_time(duration=...)``. The library ``rerun-sdk`` is optional. Without it, this module cannot be imported.
"""

from __future__ import annotations

import itertools
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from factorgraph_loc.drawing.figures import ellipses
from factorgraph_loc.errors import InputError
from factorgraph_loc.exports import scene
from factorgraph_loc.exports.rerun_viewer import LOOPBACK, open_viewer
from factorgraph_loc.exports.runs import StoredRun
from factorgraph_loc.exports.scene import DARK, DETECTION, GAP, REFERENCE, SIGHTING, Colour, colours
from factorgraph_loc.files.models import replacing
from factorgraph_loc.files.temporary import writing
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.camera import summary as pictures_of
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factors.camera import model as reprojection
from factors.se2 import Array

TIMELINE = "log_time"
WORLD, CAMERA = "/world", "/camera"  # entity paths in Rerun: the scene, and the camera of a robot without poses
FRUSTUM = 0.4  # m from the drawn camera to its image
BATCH = 16  # images per message
NEAREST = 300  # maximum number of map points that are drawn into an image
PLOTS, EVENTS = "/plots", "/events"
LINE, POINT = 0.02, 0.06  # m: radii of lines and points
ARROW = 0.6  # m: length of the arrow of a heading


def write_rrd(log: Log, runs: Sequence[StoredRun], path: Path) -> None:
    """Write a log and the estimates of runs on it to a file that the command ``rerun FILE`` shows.

    Raises InputError if an image cannot be read, or the file cannot be written.
    """
    recording = rr.RecordingStream("fgloc")
    stream = rr.binary_stream(recording)  # in memory, because Rerun's own writer hangs when the disk is full
    recording.send_blueprint(_blueprint(log, runs), make_active=False)
    _record(recording, log, runs)
    content = stream.read()
    recording.disconnect()
    with writing(path), replacing(path) as temporary:
        temporary.write_bytes(content or b"")


def show(log: Log, runs: Sequence[StoredRun], bind: str = LOOPBACK) -> None:
    """Show a log and the estimates of runs on it in the Rerun viewer. A new viewer is started unless one is open.

    ``bind``: the IP address at which a new viewer listens. The default accepts only connections from this machine.
    Raises InputError if an image cannot be read, if there is no display, or if the viewer does not start.
    """
    if sys.platform == "linux" and not any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")):
        raise InputError("there is no display for the viewer: use --rrd FILE to write a file for another machine")
    recording = rr.RecordingStream("fgloc")
    with open_viewer(bind) as url:
        recording.connect_grpc(url, default_blueprint=_blueprint(log, runs))
        _record(recording, log, runs)
        recording.flush()


def _record(recording: rr.RecordingStream, log: Log, runs: Sequence[StoredRun]) -> None:
    recording.log(WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    _map(recording, log)
    if log.reference is not None:
        _path(recording, f"{WORLD}/reference/path", log.reference, REFERENCE)
        _robot(recording, f"{WORLD}/reference/robot", log.reference, REFERENCE)
    for run, colour in zip(runs, colours(), strict=False):
        _run(recording, run, colour)
    _camera(recording, log, runs)


def _map(recording: rr.RecordingStream, log: Log) -> None:
    """Draw walls and mapped objects (landmarks, tags, points), and highlight each object when it was observed."""
    if log.world.walls:
        walls = np.array(log.world.walls).reshape(-1, 2, 2)
        lines = np.concatenate((walls, np.zeros((len(walls), 2, 1))), axis=2)
        recording.log(f"{WORLD}/walls", rr.LineStrips3D(lines, radii=LINE, colors=DARK), static=True)
    for marks, positions, lights in scene.layers(log):
        if not marks.dense:
            _lamps(recording, marks.layer, positions, lights)
        elif positions:
            dots = rr.Points3D(marks.positions, radii=LINE, colors=DARK)
            recording.log(f"{WORLD}/{marks.layer}", dots, static=True)


def _lamps(recording: rr.RecordingStream, what: str, positions: Mapping[str, Array], lights: scene.Lights) -> None:
    if not positions:
        return
    places = np.array(list(positions.values()))
    marks = rr.Points3D(places, radii=POINT, colors=DARK, labels=list(positions), show_labels=False)
    recording.log(f"{WORLD}/{what}", marks, static=True)
    lit = [[name for name in names if name in positions] for names in lights.names]
    if any(lit):
        flat = [name for names in lit for name in names]
        columns = rr.Points3D.columns(positions=np.array([positions[name] for name in flat]), labels=flat)
        columns = columns.partition([len(names) for names in lit])
        recording.send_columns(f"{WORLD}/{what}/lit", _times(lights.t), columns)
        style = rr.Points3D.from_fields(radii=2.0 * POINT, colors=DETECTION, show_labels=True)
        recording.log(f"{WORLD}/{what}/lit", style, static=True)


def _run(recording: rr.RecordingStream, run: StoredRun, colour: Colour) -> None:
    """Draw the estimates of a run, and plot their errors and events over time."""
    at = f"{WORLD}/{run.name}"
    _path(recording, f"{at}/final", run.final, colour)
    _trail(recording, f"{at}/causal", run.causal, colour)
    _robot(recording, f"{at}/robot", run.played(), colour)
    t, outlines = scene.ellipses(run.played())
    _lines_over_time(recording, f"{at}/ellipse", t, outlines, colour)
    if run.landmarks:
        centres = np.array([point.position for point in run.landmarks.values()])
        covariances = np.array([point.covariance for point in run.landmarks.values()])
        rims = ellipses(centres, covariances, scene.SCALE_95)
        learnt = rr.Points3D(
            _on_floor(centres), radii=POINT, colors=colour, labels=list(run.landmarks), show_labels=False
        )
        recording.log(f"{at}/landmarks", learnt, static=True)
        recording.log(
            f"{at}/landmarks/ellipses", rr.LineStrips3D(list(_on_floor(rims)), radii=LINE, colors=colour), static=True
        )
    for name, (stamps, values) in run.series.items():
        if len(stamps):
            plot = f"{PLOTS}/{name}/{run.name}"
            recording.log(plot, rr.SeriesLines(colors=colour, names=run.name), static=True)
            recording.send_columns(plot, _times(stamps), rr.Scalars.columns(scalars=values))
    if run.events:
        when, texts = zip(*run.events, strict=True)
        recording.send_columns(f"{EVENTS}/{run.name}", _times(np.array(when)), rr.TextLog.columns(text=texts))


def _path(recording: rr.RecordingStream, at: str, trajectory: Trajectory, colour: Colour) -> None:
    """Draw a whole trajectory, visible at all times. ``at``: its entity path in Rerun."""
    lines = [_on_floor(part) for part in scene.segments(trajectory)]
    if lines:
        recording.log(at, rr.LineStrips3D(lines, radii=LINE / 2.0, colors=colour), static=True)


def _trail(recording: rr.RecordingStream, at: str, trajectory: Trajectory, colour: Colour) -> None:
    """Draw the path up to the displayed time, as segments that appear when the robot drives there. Gaps are not drawn.

    ``at``: the entity path in Rerun."""
    positions = trajectory.poses[:, :2]
    near = np.diff(trajectory.t) <= scene.GAP
    pieces = np.stack((positions[:-1], positions[1:]), axis=1)
    _lines_over_time(recording, at, trajectory.t[1:][near], pieces[near], colour)


def _lines_over_time(recording: rr.RecordingStream, at: str, t: Array, lines: Array, colour: Colour) -> None:
    """Draw the line ``lines[i]`` (L, 2) of L points from the time ``t[i]`` [s] to ``t[i + 1]``. ``at``: entity path."""
    if len(t):
        recording.send_columns(at, _times(t), rr.LineStrips3D.columns(strips=list(_on_floor(lines))))
        recording.log(at, rr.LineStrips3D.from_fields(radii=LINE, colors=colour), static=True)


def _robot(recording: rr.RecordingStream, at: str, trajectory: Trajectory, colour: Colour) -> None:
    """Draw the robot over time, as a point, and as an arrow if its heading is known. ``at``: its entity path in Rerun."""
    if not len(trajectory):
        return
    half = trajectory.poses[:, 2] / 2.0 if trajectory.has_heading else np.zeros(len(trajectory))
    turns = np.column_stack((np.zeros((len(half), 2)), np.sin(half), np.cos(half)))
    poses = rr.Transform3D.columns(translation=_on_floor(trajectory.poses[:, :2]), quaternion=turns)
    recording.send_columns(at, _times(trajectory.t), poses)
    recording.log(f"{at}/place", rr.Points3D([(0.0, 0.0, 0.0)], radii=2.0 * POINT, colors=colour), static=True)
    if trajectory.has_heading:
        arrow = rr.Arrows3D(vectors=[(ARROW, 0.0, 0.0)], radii=LINE, colors=colour)
        recording.log(f"{at}/heading", arrow, static=True)


def _camera(recording: rr.RecordingStream, log: Log, runs: Sequence[StoredRun]) -> None:
    """Draw the images, with identified points and predicted map points, in front of the robot of the first run."""
    settings = log.rig.find(CameraSettings)
    if settings is None or not pictures_of.has_pictures(log):
        return
    model, (at, poses) = settings.model(), _camera_and_robot(log, runs)
    if at != CAMERA:
        place = rr.Transform3D(translation=model.position, mat3x3=model.rotation)
        recording.log(at, place, static=True)
    lens = rr.Pinhole(
        image_from_camera=model.matrix(),
        resolution=(model.width, model.height),
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=FRUSTUM,
    )
    recording.log(at, lens, static=True)
    pictures = pictures_of.images(log)
    while some := list(itertools.islice(pictures, BATCH)):
        t, contents = zip(*some, strict=True)
        columns = rr.EncodedImage.columns(blob=list(contents), media_type=["image/jpeg"] * len(contents))
        recording.send_columns(f"{at}/image", _times(np.array(t)), columns)
        if log.world.points is not None and poses is not None:
            path = poses.at(np.array(t), max_gap=GAP)
            expected = [_predicted_pixels(model, pose, log.world.points.positions) for pose in path]
            _pixels_over_time(recording, f"{at}/image/map", np.array(t), expected)
            recording.log(f"{at}/image/map", rr.Points2D.from_fields(radii=2.0, colors=DETECTION), static=True)
    sightings = list(pictures_of.sightings(log))
    if sightings:
        labels = [name for _, names, _ in sightings for name in names]
        stamps = np.array([t for t, _, _ in sightings])
        _pixels_over_time(recording, f"{at}/image/landmarks", stamps, [pixels for _, _, pixels in sightings], labels)
        style = rr.Points2D.from_fields(radii=3.0, colors=SIGHTING, show_labels=False)
        recording.log(f"{at}/image/landmarks", style, static=True)


def _pixels_over_time(
    recording: rr.RecordingStream, at: str, t: Array, pixels: Sequence[Array], labels: Sequence[str] | None = None
) -> None:
    """Draw points over images. ``pixels[i]`` (K, 2) is drawn at ``t[i]`` [s]. ``labels``: names of the points of all images."""
    # the viewer's origin is a corner of the first pixel; the origin of ``pixels`` is the centre of the first pixel
    columns = rr.Points2D.columns(positions=np.concatenate(pixels) + 0.5, labels=labels)
    recording.send_columns(at, _times(t), columns.partition([len(p) for p in pixels]))


def _predicted_pixels(model: reprojection.CameraModel, pose: Array, points: Array) -> Array:
    """Return the pixels (K, 2) of at most :data:`NEAREST` visible ``points`` (P, 3), nearest to the camera first.

    ``pose`` (3,): x, y, heading of the robot. If it is NaN, no pixels are returned (K = 0)."""
    if not np.isfinite(pose).all():
        return np.empty((0, 2))
    pixels, depths = reprojection.predict(model, pose, points)
    visible = np.flatnonzero((depths > 0.0) & model.contains(pixels))
    return np.asarray(pixels[visible[np.argsort(depths[visible])[:NEAREST]]])


def _camera_and_robot(log: Log, runs: Sequence[StoredRun]) -> tuple[str, Trajectory | None]:
    """Return the entity path of the camera in Rerun, and the trajectory of the robot that carries the camera, or None.

    The trajectory is that of the first run that has one, or else the reference of the log."""
    for run in runs:
        if len(run.played()):
            return f"{WORLD}/{run.name}/robot/camera", run.played()
    return CAMERA if log.reference is None else f"{WORLD}/reference/robot/camera", log.reference


def _times(t: Array) -> list[rr.TimeColumn]:
    """Return times of the log (N,) [s] as a time column of Rerun."""
    return [rr.TimeColumn(TIMELINE, duration=t)]


def _blueprint(log: Log, runs: Sequence[StoredRun]) -> rrb.Blueprint:
    """Return the layout of the viewer: a view from above, and if they exist, the camera, errors and events."""
    past = rrb.VisibleTimeRanges(
        timeline=TIMELINE, start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.cursor_relative()
    )
    centre, size = _extent(log, runs)
    eye = rrb.EyeControls3D(
        position=(centre[0], centre[1] - 0.2 * size, 0.8 * size), look_target=(*centre, 0.0), eye_up=(0.0, 0.0, 1.0)
    )
    plan = rrb.Spatial3DView(
        origin=WORLD, name="plan", overrides={f"{WORLD}/{run.name}/causal": past for run in runs}, eye_controls=eye
    )
    beside: list[rrb.View] = []
    if log.rig.find(CameraSettings) is not None and pictures_of.has_pictures(log):
        beside.append(rrb.Spatial2DView(origin=_camera_and_robot(log, runs)[0], name="camera"))
    titles = {"error_position": "error of position [m]", "error_heading": "error of heading [rad]", "nees": "NEES"}
    beside += [
        rrb.TimeSeriesView(origin=f"{PLOTS}/{name}", name=title)
        for name, title in titles.items()
        if any(len(run.series[name][0]) for run in runs)
    ]
    if any(run.events for run in runs):
        beside.append(rrb.TextLogView(origin=EVENTS, name="events"))
    shares = [3 if isinstance(part, rrb.Spatial2DView) else 1 for part in beside]
    column = rrb.Vertical(*beside, row_shares=shares)
    whole = rrb.Horizontal(plan, column, column_shares=(2, 1)) if beside else plan
    return rrb.Blueprint(whole, rrb.TimePanel(timeline=TIMELINE, state="collapsed"), collapse_panels=True)


def _extent(log: Log, runs: Sequence[StoredRun]) -> tuple[Array, float]:
    """Return the centre (2,) [m] and the larger side [m] of the drawn scene.

    The side is at least 5 m, to keep the viewpoint outside of a small scene."""
    parts = [run.final.poses[:, :2] for run in runs] + [np.array(log.world.walls).reshape(-1, 2)]
    parts += [marks.positions[:, :2] for marks, _, _ in scene.layers(log) if not marks.dense]
    if log.reference is not None:
        parts.append(log.reference.poses[:, :2])
    points = np.concatenate(parts)
    if not len(points):
        return np.zeros(2), 10.0
    low, high = points.min(axis=0), points.max(axis=0)
    return (low + high) / 2.0, max(float((high - low).max()), 5.0)


def _on_floor(points: Array) -> Array:
    """Return planar points (..., 2) as points in space (..., 3) with z = 0."""
    return np.concatenate((points, np.zeros((*points.shape[:-1], 1))), axis=-1)
