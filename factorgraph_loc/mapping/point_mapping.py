"""Maps of 3-D points from images with known camera poses.

The steps are these. Keyframes are selected. Their features are matched near epipolar lines, and matches are chained
into tracks. Tracks with enough parallax are triangulated. Points and cameras are adjusted together. Points with enough
observations and small enough covariances become points of the map, with descriptors from a few directions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError, RunFailedError
from factorgraph_loc.files.models import FileModel, InUnit
from factorgraph_loc.mapping import bundle
from factorgraph_loc.mapping.bundle import Bundle
from factorgraph_loc.mapping.triangulation import (
    PARALLAX,
    Cameras,
    Tracks,
    angles_between,
    chained,
    keyframes,
    matched_pairs,
    overlapping_pairs,
    parallax,
    reproject,
    triangulate,
)
from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.camera.use import frames_of
from factorgraph_loc.text import error_text
from factorgraph_loc.vision.frame import CameraFrame
from factors.camera.model import CameraModel, camera_pose
from factors.positive import worst_sigma
from factors.se2 import Array, Integers

MOST_KEYFRAMES = 600
WIDER = 1.3  # the distance between keyframes is multiplied by this while there are more than MOST_KEYFRAMES
DEPTH = 2.0  # m: typical depth of points, to convert an error of the camera position to pixels
GATE = 3.0  # largest distance of a match from the epipolar line, in standard deviations
NARROW, WIDE = 3.0, 25.0  # px: bounds of this gate
MAX_GAP = 0.5  # s: a reference is not interpolated between stamps that are farther apart
ASKEW, AFLOAT = 0.003, 0.003  # rad, m: standard deviations of tilt and height of a robot on the floor


@dataclass(frozen=True, eq=False)
class PosedFrames:
    """F images with known camera poses. ``frames``: the features of the images. ``cameras``: the camera poses.
    ``covariances`` (F, 6, 6): of perturbations of these poses in the cameras' own frames, rotation first."""

    frames: list[CameraFrame]
    cameras: Cameras
    covariances: Array

    def __getitem__(self, index: Integers) -> PosedFrames:
        return PosedFrames([self.frames[i] for i in index.tolist()], self.cameras[index], self.covariances[index])


class PointSettings(FileModel):
    """Settings of mapping points: keyframes, calibration, and the conditions that a point of the map must meet."""

    distance: Annotated[float, Field(ge=0.0, le=10.0), InUnit("m")] = 0.1
    """distance between keyframes; 0 uses all frames"""
    angle: Annotated[float, Field(ge=0.0, le=3.2), InUnit("rad")] = 0.1
    """angle between keyframes; 0 uses all frames"""
    focal: bool = False
    """whether to adjust the focal length"""
    lens: bool = False
    """whether to adjust focal length, principal point and distortion"""
    observations: Annotated[int, Field(ge=2, le=1000)] = 3
    """least number of keyframes that must observe a point"""
    parallax: Annotated[float, Field(ge=1e-4, le=3.0), InUnit("rad")] = PARALLAX
    """least angle between two rays to a point"""
    sigma: Annotated[float, Field(ge=1e-6, le=100.0), InUnit("m")] = 0.2
    """largest standard deviation of a point, in its worst direction"""
    views: Annotated[int, Field(ge=1, le=100)] = 4
    """largest number of descriptors of a point in the map, each from another keyframe"""
    most: Annotated[int, Field(ge=1, le=10_000_000)] | None = None
    """largest number of points in the map; in each part of space the points with the smallest covariances are kept.
    Without this setting all points are kept"""


@dataclass(frozen=True)
class PointReport:
    """Statistics of a map of points.

    Numbers: ``keyframes``, ``pairs`` of compared images, ``tracks``, ``triangulated`` points, ``points`` of the map,
    and ``observations`` of these points. ``rms``, ``mad`` [px]: root mean square and median absolute value of the
    residuals. ``parallax`` [rad], ``sigma`` [m]: medians over points of the parallax and of the standard deviation in
    the worst direction. ``shifted`` [m], ``turned`` [rad]: median corrections of the camera poses. ``focal`` [px]: the
    focal length fx. ``fused``: the number of points that were already in an older map, if the new map extends one.
    """

    keyframes: int
    pairs: int
    tracks: int
    triangulated: int
    points: int
    observations: int
    rms: float
    mad: float
    parallax: float
    sigma: float
    shifted: float
    turned: float
    focal: float
    fused: int = 0


@dataclass(frozen=True, eq=False)
class MadePoints:
    """A new map of points. ``points``: the map. ``cameras``: the adjusted poses of its keyframes. ``model``: the
    calibration of the camera, adjusted if that was requested. ``report``: statistics of the map."""

    points: PointMap
    cameras: Cameras
    model: CameraModel
    report: PointReport


def map_points(
    model: CameraModel,
    posed: PosedFrames,
    settings: PointSettings | None = None,
    progress: Callable[[float], None] = lambda _: None,
) -> MadePoints:
    """Return a map of points, triangulated from images with known camera poses (``posed``).

    ``model``: the calibration of the camera. ``settings``: None means the defaults. ``progress``: a function that is
    called with the completed fraction, 0 to 1. Raises RunFailedError if no point is observed from several positions, if
    the adjustment fails, or if no point meets the settings. Raises InputError if the settings require a new
    calibration, and the camera has another distortion model than Brown's.
    """
    settings = settings or PointSettings()
    posed = posed[chosen_keyframes(posed, settings)]
    pairs = overlapping_pairs(posed.cameras)
    gate = epipolar_gate(model, posed.covariances)
    matches = []
    for begin in range(0, len(pairs), 50):
        matches += matched_pairs(model, posed.cameras, posed.frames, pairs[begin : begin + 50], gate)
        progress(0.7 * min(1.0, (begin + 50) / len(pairs)))
    tracks = chained(posed.frames, matches)
    triangulated = triangulate(model, posed.cameras, tracks)
    # before the adjustment, residuals also contain the errors of the camera poses: allow as much as the epipolar gate
    good = triangulated.good(tracks, replace(model, sigma=gate / GATE), settings.parallax)
    if not good.any():
        raise RunFailedError("no feature was matched between images from several places, so no point was mapped")
    total, (chosen, old) = tracks.count, tracks.kept(good[tracks.track])
    if (settings.focal or settings.lens) and not model.is_brown:
        raise InputError(
            "focal and lens need a camera with distortion_model plumb_bob and the coefficients k1, k2, p1, p2: "
            "remove both settings"
        )
    try:
        adjusted = bundle.adjust(
            model,
            posed.cameras,
            posed.covariances,
            chosen,
            triangulated.positions[old],
            focal=settings.focal,
            lens=settings.lens,
            progress=lambda share: progress(0.7 + 0.3 * share),
        )
    except RuntimeError as error:  # raised by GTSAM for an underdetermined system
        raise RunFailedError(f"points and cameras cannot be adjusted: {error_text(error)}") from error
    return _made(posed, adjusted, settings, len(pairs), total, int(np.count_nonzero(good)))


def chosen_keyframes(posed: PosedFrames, settings: PointSettings) -> Integers:
    """Return the indices of the images that become keyframes. Any two of them differ by ``settings.distance`` or
    ``settings.angle``. Both limits are increased until there are at most :data:`MOST_KEYFRAMES`."""
    filled = np.flatnonzero([len(frame.pixels) > 0 for frame in posed.frames])
    distance, angle = settings.distance, settings.angle
    while True:
        chosen = filled[keyframes(posed.cameras[filled], distance, angle)]
        if len(chosen) <= MOST_KEYFRAMES:
            return np.asarray(chosen)
        distance, angle = max(WIDER * distance, 0.02), max(WIDER * angle, 0.02)


def epipolar_gate(model: CameraModel, covariances: Array) -> float:
    """Return the largest distance [px] of a correct match from its epipolar line. ``covariances`` (F, 6, 6): of the
    camera poses, in the cameras' own frames, rotation first."""
    turn, shift = (np.median(np.trace(covariances[:, i : i + 3, i : i + 3], axis1=1, axis2=2)) / 3.0 for i in (0, 3))
    sigma = np.sqrt(2.0 * (model.sigma**2 + model.fx**2 * (turn + shift / DEPTH**2)))
    return float(np.clip(GATE * sigma, NARROW, WIDE))


def point_map(
    posed: PosedFrames, cameras: Cameras, tracks: Tracks, points: Array, covariances: Array, views: int
) -> PointMap:
    """Return a map of T points. Each point has the descriptors of at most ``views`` of its observations.

    ``posed``: the images. ``points`` (T, 3), ``covariances`` (T, 3, 3): positions and their covariances. ``cameras``:
    the camera poses, one per image. ``tracks``: the observations of the points.
    """
    shown = _different_views(cameras, tracks, points, views)
    views_of = list(zip(tracks.frame[shown].tolist(), tracks.feature[shown].tolist(), strict=True))
    return PointMap(
        names=tuple(f"p{i}" for i in range(len(points))),
        positions=points,
        covariances=covariances,
        feature=posed.frames[0].feature,
        owners=tracks.track[shown],
        descriptors=np.array([posed.frames[i].descriptors[k] for i, k in views_of]),
        seen_from=cameras.positions[tracks.frame[shown]],
    )


def _made(
    posed: PosedFrames, adjusted: Bundle, settings: PointSettings, pairs: int, total: int, triangulated: int
) -> MadePoints:
    """Return the map of the points that meet the ``settings``, with its statistics. ``posed``: the images.
    ``adjusted``: the adjusted points and cameras. ``pairs``, ``total``, ``triangulated``: the numbers of compared pairs
    of keyframes, of tracks, and of triangulated points."""
    kept, points, covariances, angles = _kept(adjusted, settings)
    errors = reproject(adjusted.model, adjusted.cameras, points, kept)[0]
    shift = np.linalg.norm(adjusted.cameras.positions - posed.cameras.positions, axis=1)
    turn = angles_between(posed.cameras.rotations, adjusted.cameras.rotations)
    report = PointReport(
        keyframes=len(posed.frames),
        pairs=pairs,
        tracks=total,
        triangulated=triangulated,
        points=len(points),
        observations=len(kept),
        rms=float(np.sqrt(np.mean(errors**2))),
        mad=float(np.median(np.abs(errors))),
        parallax=float(np.median(angles)),
        sigma=float(np.median(worst_sigma(covariances))),
        shifted=float(np.median(shift)),
        turned=float(np.median(turn)),
        focal=adjusted.model.fx,
    )
    made = point_map(posed, adjusted.cameras, kept, points, covariances, settings.views)
    return MadePoints(made, adjusted.cameras, adjusted.model, report)


def _kept(adjusted: Bundle, settings: PointSettings) -> tuple[Tracks, Array, Array, Array]:
    """Return the points that meet ``settings``: their tracks, positions (T, 3), covariances (T, 3, 3) and parallaxes
    (T,) [rad]. Raises RunFailedError if no point meets them."""
    tracks, points, covariances = adjusted.tracks, adjusted.points, adjusted.point_covariances
    angles = parallax(adjusted.cameras, points, tracks)
    good = (
        (tracks.lengths() >= settings.observations)
        & (angles >= settings.parallax)
        & (worst_sigma(covariances) <= settings.sigma)
    )
    if not good.any():
        raise RunFailedError(
            f"none of {len(points)} points is observed in {settings.observations} keyframes with a standard deviation "
            f"of at most {settings.sigma:g} m and a parallax of at least {settings.parallax:g} rad"
        )
    kept, old = tracks.kept(good[tracks.track])
    return kept, points[old], covariances[old], angles[old]


def _different_views(cameras: Cameras, tracks: Tracks, points: Array, views: int) -> Integers:
    """Return the indices (V,) of at most ``views`` observations of each point, from different viewpoints.

    The first selected observation of a point has the most typical direction and distance of the camera. Each further
    one differs most from those already selected. ``cameras``, ``tracks``, ``points`` (T, 3): the camera poses, all
    observations, and positions.
    """
    chosen: list[int] = []
    order = np.argsort(tracks.track, kind="stable")
    for rows in np.split(order, np.cumsum(tracks.lengths())[:-1]):
        if len(rows) <= views:
            chosen += rows.tolist()
            continue
        rays = cameras.positions[tracks.frame[rows]] - points[tracks.track[rows[0]]]
        distances = np.linalg.norm(rays, axis=1, keepdims=True)
        places = np.column_stack((rays / distances, np.log(distances)))
        taken = [int(np.linalg.norm(places - places.mean(axis=0), axis=1).argmin())]
        apart = np.linalg.norm(places - places[taken[0]], axis=1)
        while len(taken) < views:
            taken.append(int(apart.argmax()))
            apart = np.minimum(apart, np.linalg.norm(places - places[taken[-1]], axis=1))
        chosen += rows[taken].tolist()
    return np.array(chosen, dtype=np.int64)


def posed_frames(log: Log, turn_sigma: float = 0.01, shift_sigma: float = 0.02) -> PosedFrames:
    """Return the images of a log with camera poses from the log's reference trajectory.

    Images before or after the reference, or in its gaps, are left out. ``turn_sigma`` [rad], ``shift_sigma`` [m]:
    standard deviations of rotation and position of each camera, per axis. They are used if the reference has no
    covariances. Raises InputError if the log has no camera, no features or no reference with headings, or if no image
    remains.
    """
    t, all_frames = frames_of(log)
    if log.rig.find(CameraSettings) is None:
        raise InputError(f"{log.name}: its rig has no section [camera]: add it with focal length and mounting")
    model = log.rig.of(CameraSettings).model()
    usual = np.diag(np.repeat(np.square((turn_sigma, shift_sigma)), 3))
    if log.reference is None or not log.reference.has_heading:
        raise InputError(
            f"{log.name}: has no reference with headings, but the camera poses of its images are computed from it"
        )
    poses = log.reference.at(t, max_gap=MAX_GAP)
    inside = np.asarray(np.isfinite(poses).all(axis=1))
    cameras, covariances = _on_robot(model, log.reference, t[inside], poses[inside], usual)
    frames = [frame for frame, keep in zip(all_frames, inside.tolist(), strict=True) if keep]
    if not any(len(frame.pixels) for frame in frames):
        raise InputError(
            f"{log.name}: none of its {len(t)} images has both features and a pose of the reference at its time"
        )
    return PosedFrames(frames, cameras, covariances)


def _on_robot(model: CameraModel, reference: Trajectory, t: Array, poses: Array, usual: Array) -> tuple[Cameras, Array]:
    """Return the camera poses of a robot on the floor at ``poses`` (F, 3), and their covariances (F, 6, 6).

    ``t`` (F,) [s]: the times of the poses. ``reference``: the trajectory that supplies their covariances. ``usual``
    (6, 6): the covariance of a camera pose, used if the reference has no covariances.
    """
    places = [camera_pose(model, pose) for pose in poses]
    cameras = Cameras(
        np.array([p for p, _ in places]).reshape(-1, 3), np.array([r for _, r in places]).reshape(-1, 3, 3)
    )
    if reference.covariances is None:
        return cameras, np.repeat(usual[None], len(t), axis=0)
    nearest = np.clip(np.searchsorted(reference.t, t), 0, len(reference.t) - 1)
    # Jacobian of the camera pose by x, y and heading in the world frame: the heading turns the camera and moves it around the robot
    by_pose = np.zeros((len(t), 6, 3))
    by_pose[:, 2, 2] = by_pose[:, 3, 0] = by_pose[:, 4, 1] = 1.0
    arm = cameras.positions[:, :2] - poses[:, :2]
    by_pose[:, 3, 2], by_pose[:, 4, 2] = -arm[:, 1], arm[:, 0]
    back = cameras.rotations.transpose(0, 2, 1)
    by_pose = np.concatenate((back @ by_pose[:, :3], back @ by_pose[:, 3:]), axis=1)
    floor = np.diag(np.repeat(np.square((ASKEW, AFLOAT)), 3))
    return cameras, by_pose @ reference.covariances[nearest] @ by_pose.transpose(0, 2, 1) + floor
