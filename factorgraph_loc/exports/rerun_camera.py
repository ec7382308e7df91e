"""Camera data in a Rerun recording: images, identified points, and predicted positions of map points."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
import rerun as rr

from factorgraph_loc.exports.runs import StoredRun
from factorgraph_loc.exports.scene import DETECTION, GAP, SIGHTING
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.camera import summary as pictures_of
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factors.camera import model as reprojection
from factors.se2 import Array

TIMELINE = "log_time"
WORLD, CAMERA = "/world", "/camera"  # the latter without a robot pose
FRUSTUM = 0.4  # m from the camera to its image
BATCH = 16  # images per message
NEAREST = 300  # map points drawn into an image


def record_camera(recording: rr.RecordingStream, log: Log, runs: Sequence[StoredRun]) -> None:
    """Record images with the identified points and the predicted map points, as a picture in front of the first robot."""
    settings = log.rig.find(CameraSettings)
    if settings is None or not pictures_of.has_pictures(log):
        return
    model, at, poses = settings.model(), camera_path(log, runs), _carrier(log, runs)
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
    for some in _batches(pictures_of.images(log)):
        _pictures(recording, f"{at}/image", some)
        if log.world.points is not None and poses is not None:
            t = np.array([t for t, _ in some])
            expected = [_expected(model, pose, log.world.points.positions) for pose in poses.at(t, max_gap=GAP)]
            _pixels_over_time(recording, f"{at}/image/map", t, expected)
            recording.log(f"{at}/image/map", rr.Points2D.from_fields(radii=2.0, colors=DETECTION), static=True)
    sightings = list(pictures_of.sightings(log))
    if sightings:
        labels = [name for _, names, _ in sightings for name in names]
        t = np.array([t for t, _, _ in sightings])
        _pixels_over_time(recording, f"{at}/image/landmarks", t, [pixels for _, _, pixels in sightings], labels)
        style = rr.Points2D.from_fields(radii=3.0, colors=SIGHTING, show_labels=False)
        recording.log(f"{at}/image/landmarks", style, static=True)


def _batches(pictures: Iterator[tuple[float, bytes]]) -> Iterator[list[tuple[float, bytes]]]:
    while some := list(itertools.islice(pictures, BATCH)):
        yield some


def _pictures(recording: rr.RecordingStream, at: str, pictures: Sequence[tuple[float, bytes]]) -> None:
    t, contents = zip(*pictures, strict=True)
    columns = rr.EncodedImage.columns(blob=list(contents), media_type=["image/jpeg"] * len(contents))
    recording.send_columns(at, times(np.array(t)), columns)


def _pixels_over_time(
    recording: rr.RecordingStream, at: str, t: Array, pixels: Sequence[Array], labels: Sequence[str] | None = None
) -> None:
    """Points (K, 2) in each image, shifted by half a pixel: the viewer's origin is a corner of the first pixel, not its centre."""
    columns = rr.Points2D.columns(positions=np.concatenate(pixels) + 0.5, labels=labels)
    recording.send_columns(at, times(t), columns.partition([len(p) for p in pixels]))


def _expected(model: reprojection.CameraModel, pose: Array, points: Array) -> Array:
    """Pixels (K, 2) of the nearest ``points`` (P, 3) visible from ``pose`` (3,), none if the pose is unknown."""
    if not np.isfinite(pose).all():
        return np.empty((0, 2))
    pixels, depths = reprojection.predict(model, pose, points)
    visible = np.flatnonzero((depths > 0.0) & model.contains(pixels))
    return np.asarray(pixels[visible[np.argsort(depths[visible])[:NEAREST]]])


def _carrier(log: Log, runs: Sequence[StoredRun]) -> Trajectory | None:
    """Trajectory of the robot that carries the drawn camera: of the first run that has one, else the reference."""
    trajectories = [run.played() for run in runs if len(run.played())]
    return trajectories[0] if trajectories else log.reference


def camera_path(log: Log, runs: Sequence[StoredRun]) -> str:
    """The entity path of the camera: below the first robot drawn, if there is one."""
    robots = [run.name for run in runs if len(run.played())]
    if log.reference is not None:
        robots.append("reference")
    return f"{WORLD}/{robots[0]}/robot/camera" if robots else CAMERA


def times(t: Array) -> list[rr.TimeColumn]:
    """Seconds of the log as a Rerun time column."""
    return [rr.TimeColumn(TIMELINE, duration=t)]
