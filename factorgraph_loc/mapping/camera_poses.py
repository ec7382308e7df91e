"""Camera poses at the images of a log, with covariances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.mapping.triangulation import Cameras
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.camera.use import frames_of
from factorgraph_loc.vision.frame import CameraFrame
from factors.camera.model import CameraModel, camera_pose
from factors.se2 import Array, Integers

MAX_GAP = 0.5  # s between stamps of a reference, beyond which it is not interpolated
ASKEW, AFLOAT = 0.003, 0.003  # rad, m: standard deviations of tilt and height of a robot on the floor


@dataclass(frozen=True, eq=False)
class PosedFrames:
    """F frames with features, and their ``cameras``; ``covariances`` (F, 6, 6) in the cameras' own frames, rotation first."""

    frames: list[CameraFrame]
    cameras: Cameras
    covariances: Array

    def __getitem__(self, index: Integers) -> PosedFrames:
        return PosedFrames([self.frames[i] for i in index.tolist()], self.cameras[index], self.covariances[index])


def posed_frames(log: Log, turn_sigma: float = 0.01, shift_sigma: float = 0.02) -> PosedFrames:
    """The frames of a log with features, at the poses of its reference.

    ``turn_sigma`` [rad], ``shift_sigma`` [m]: standard deviations about and along each axis for a reference without
    covariances. Frames outside of the reference or in its gaps are omitted. Raises InputError if a camera, features or a
    reference are missing, or no frame remains.
    """
    t, found = frames_of(log)
    if log.rig.find(CameraSettings) is None:
        raise InputError(f"{log.name}: its rig has no [camera], expected focal length and mounting")
    model = log.rig.of(CameraSettings).model()
    usual = np.diag(np.repeat(np.square((turn_sigma, shift_sigma)), 3))
    if log.reference is None or not log.reference.has_heading:
        raise InputError(f"{log.name}: has no reference with headings that says where its images were taken")
    poses = log.reference.at(t, max_gap=MAX_GAP)
    inside = np.asarray(np.isfinite(poses).all(axis=1))
    cameras, covariances = _on_robot(model, log.reference, t[inside], poses[inside], usual)
    frames = [frame for frame, keep in zip(found, inside.tolist(), strict=True) if keep]
    if not any(len(frame.pixels) for frame in frames):
        raise InputError(f"{log.name}: none of its {len(t)} images has features and a pose of the reference")
    return PosedFrames(frames, cameras, covariances)


def _on_robot(model: CameraModel, reference: Trajectory, t: Array, poses: Array, usual: Array) -> tuple[Cameras, Array]:
    """Cameras of a robot on the floor at ``poses`` (F, 3), and their covariances."""
    places = [camera_pose(model, pose) for pose in poses]
    cameras = Cameras(
        np.array([p for p, _ in places]).reshape(-1, 3), np.array([r for _, r in places]).reshape(-1, 3, 3)
    )
    if reference.covariances is None:
        return cameras, np.repeat(usual[None], len(t), axis=0)
    nearest = np.clip(np.searchsorted(reference.t, t), 0, len(reference.t) - 1)
    # by (x, y, heading) in the world: the heading rotates about z, and moves the camera around the robot
    by_pose = np.zeros((len(t), 6, 3))
    by_pose[:, 2, 2] = by_pose[:, 3, 0] = by_pose[:, 4, 1] = 1.0
    arm = cameras.positions[:, :2] - poses[:, :2]
    by_pose[:, 3, 2], by_pose[:, 4, 2] = -arm[:, 1], arm[:, 0]
    back = cameras.rotations.transpose(0, 2, 1)
    by_pose = np.concatenate((back @ by_pose[:, :3], back @ by_pose[:, 3:]), axis=1)
    floor = np.diag(np.repeat(np.square((ASKEW, AFLOAT)), 3))
    return cameras, by_pose @ reference.covariances[nearest] @ by_pose.transpose(0, 2, 1) + floor
