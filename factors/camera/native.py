"""GTSAM's own factor of one point with unknown position seen in an image, on a planar pose and the point.

It is equal to a free :class:`factors.camera.factor.ReprojectionFactor` without estimated constants, and ten times as fast, but it
raises if the point is behind the camera.
"""

import gtsam

from factors.camera.model import CameraModel
from factors.se2 import Array


class PointSightings:
    """Creates the factors of a camera."""

    def __init__(self, model: CameraModel) -> None:
        self._mounting = gtsam.Pose3(gtsam.Rot3(model.rotation), model.position)
        self._calibration = model.calibration()
        loss = gtsam.noiseModel.mEstimator.Huber.Create(model.robust)
        self._noise = gtsam.noiseModel.Robust.Create(loss, gtsam.noiseModel.Isotropic.Sigma(2, model.sigma))

    def factor(self, pose: int, point: int, pixel: Array) -> gtsam.NonlinearFactor:
        """The factor of ``point`` (a key) seen at ``pixel`` (2,) from ``pose`` (a key)."""
        return gtsam.PlanarProjectionFactor2(pose, point, pixel, self._mounting, self._calibration, self._noise)
