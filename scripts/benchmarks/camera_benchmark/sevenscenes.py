"""Real images of the data set 7-Scenes: a map is made from some images, and other images are located in this map one by one.

This is done with each kind of feature. The files of 7-Scenes are ``frame-NUMBER.color.jpg`` and ``frame-NUMBER.pose.txt``, a matrix
(4, 4) from camera to world (Shotton et al., "Scene coordinate regression forests for camera relocalization in RGB-D images", CVPR
2013).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from benchmarking.report import Options, Report
from scipy.spatial.transform import Rotation

from factorgraph_loc.errors import InputError
from factorgraph_loc.mapping.point_mapping import MadePoints, PointSettings, PosedFrames, map_points
from factorgraph_loc.mapping.triangulation import Cameras
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.frontend import with_features
from factorgraph_loc.sensors.camera.measurement import ImageStream
from factorgraph_loc.sensors.camera.settings import CameraSettings, FrontendSettings
from factorgraph_loc.sensors.camera.use import frames_of
from factorgraph_loc.vision.association import Associator
from factorgraph_loc.vision.features import EXTRACTORS
from factorgraph_loc.vision.frame import CameraFrame
from factorgraph_loc.vision.relocalization import located
from factors.se2 import Array

COUNT = 1500
MAPPED = np.arange(0, 200, 2)
QUERIES = {"A": np.arange(1, 200, 2), "B": np.arange(200, 300)}
RATE = 15.0  # Hz, nominal: the recording has no stamps
# the focal length is nominal: camera-intrinsics.txt is that of the depth camera, and the colour images have no calibration
CAMERA = CameraSettings(width=640, height=480, fx=525, fy=525, cx=320, cy=240)
TURN_SIGMA, SHIFT_SIGMA = 0.002, 0.003  # rad, m: standard deviations of the reference
GUESSED = 0.01  # rad, m: standard deviation that is added to a relocalized pose before points are matched again
ROUNDS = 2  # number of times that points are matched again
FEWEST = 12  # least number of points that must agree
NEAR, TURNED = 0.05, 5.0  # m, degrees: an image with smaller errors is located


@dataclass(frozen=True)
class Errors:
    """The errors of F located images. ``position`` (F,) [m]: of the camera's centre. ``angle`` (F,) [rad]: of the rotation.
    Both are infinite if an image is not located."""

    position: Array
    angle: Array

    def cells(self) -> tuple[str, ...]:
        success = np.mean((self.position < NEAR) & (self.angle < np.radians(TURNED)))
        p90 = [np.percentile(errors, 90, method="higher") for errors in (self.position, self.angle)]
        middle = f"{np.median(self.position):.4f}", f"{np.median(self.angle):.4f}"
        return f"{100.0 * success:.0f} %", *middle, f"{p90[0]:.3f}", f"{p90[1]:.3f}"


def section(options: Options) -> Report:
    report = Report("sevenscenes", options)
    if options.data_root is None:
        raise InputError("sevenscenes: expected --data-root with a folder sevenscenes")
    log, cameras = read(options.data_root / "sevenscenes")
    rows = []
    for feature in EXTRACTORS:
        frames = frames_of(with_features(log, FrontendSettings(feature=feature, count=COUNT))[0])[1]
        made = mapped([frames[i] for i in MAPPED], cameras[MAPPED])
        for query, numbers in QUERIES.items():
            errors = errors_of(made, [frames[i] for i in numbers], cameras[numbers])
            rows.append((feature, query, *errors.cells()))
    report.say(
        f"Each image has {COUNT} features. Errors are medians and 90th percentiles (p90). *Located*: errors within {NEAR} m and "
        f"{TURNED:.0f} degrees."
    )
    heads = ("located", "position [m]", "angle [rad]", "p90 [m]", "p90 [rad]")
    report.table(("feature", "images", *heads), rows)
    return report


def read(folder: Path) -> tuple[Log, Cameras]:
    """The images as a log, and the poses of their cameras."""
    images = sorted(folder.glob("frame-*.color.jpg"))
    if not images:
        raise InputError(f"{folder}: contains no images frame-*.color.jpg")
    poses = np.array([np.loadtxt(image.with_name(image.name.replace("color.jpg", "pose.txt"))) for image in images])
    rotations = Rotation.from_matrix(poses[:, :3, :3]).as_matrix()
    stream = ImageStream(np.arange(len(images)) / RATE, images)
    log = Log("sevenscenes", Rig(sensors=("camera",), camera=CAMERA), World(), {"camera": stream})
    return log, Cameras(poses[:, :3, 3], rotations)


def mapped(frames: list[CameraFrame], cameras: Cameras) -> MadePoints:
    """Make a map of points from frames with known cameras. The calibration of the camera is adjusted too."""
    known = np.diag(np.repeat(np.square((TURN_SIGMA, SHIFT_SIGMA)), 3))
    posed = PosedFrames(frames, cameras, np.repeat(known[None], len(frames), axis=0))
    return map_points(CAMERA.model(), posed, PointSettings(distance=0.0, angle=0.0, lens=True))


def errors_of(made: MadePoints, frames: list[CameraFrame], truth: Cameras) -> Errors:
    """Locate each frame in a map, and return the errors. ``truth``: the true camera poses."""
    associator = Associator(made.points, made.model)
    position, angle = np.full(len(frames), np.inf), np.full(len(frames), np.inf)
    for i, frame in enumerate(frames):
        found = camera_of(associator, made, frame)
        if found is not None:
            position[i] = np.linalg.norm(found[0] - truth.positions[i])
            angle[i] = Rotation.from_matrix(found[1].T @ truth.rotations[i]).magnitude()
    return Errors(position, angle)


def camera_of(associator: Associator, made: MadePoints, frame: CameraFrame) -> tuple[Array, Array] | None:
    """Locate a frame in a map: relocalize it, and then match all visible points of the map. Returns position (3,) and rotation
    (3, 3) of the camera, or None."""
    found = associator.relocalized(frame)
    if found is None:
        return None
    position, rotation, covariance, _ = found
    for _ in range(ROUNDS):
        seen = associator.guided(frame, position, rotation, covariance + GUESSED**2 * np.eye(6))
        points, pixels = made.points, np.asarray(frame.pixels, dtype=float)[seen.features]
        if len(seen.points) < FEWEST:
            break
        better = located(made.model, points.positions[seen.points], pixels, points.covariances[seen.points])
        if better is None:
            break
        camera = better.camera
        position, rotation, covariance = camera.position, camera.rotation, camera.covariance
    return position, rotation
