"""One point of unknown place seen in an image, as GTSAM's own factor on a planar pose and the point.

Its error, Jacobians and loss are those of a free :class:`factors.camera.factor.ReprojectionFactor` without estimated
constants, at a tenth of the time. Unlike that it throws where the point is behind the camera.
"""

import gtsam

from factors.camera.model import CameraModel
from factors.se2 import Array


class PointSightings:
    """Makes the factors of a camera."""

    def __init__(self, model: CameraModel) -> None:
        self._mounting = gtsam.Pose3(gtsam.Rot3(model.rotation), model.position)
        self._calibration = model.calibration()
        loss = gtsam.noiseModel.mEstimator.Huber.Create(model.robust)
        self._noise = gtsam.noiseModel.Robust.Create(loss, gtsam.noiseModel.Isotropic.Sigma(2, model.sigma))

    def factor(self, pose: int, point: int, pixel: Array) -> gtsam.NonlinearFactor:
        """The point with the key ``point``, seen at ``pixel`` (2,) from the pose with the key ``pose``."""
        return gtsam.PlanarProjectionFactor2(pose, point, pixel, self._mounting, self._calibration, self._noise)
