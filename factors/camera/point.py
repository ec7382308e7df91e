"""A point of unknown position seen in an image: a factor on a planar pose, the tilt of the robot there, and the point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from factors.camera import kernels
from factors.camera.kernels import Lens
from factors.camera.model import PARAMETERS, CameraModel, lens_of, recalibrated
from factors.robust import huber_loss
from factors.se2 import Array

BEHIND = 100.0  # residual of a point behind the camera, in standard deviations


@dataclass(frozen=True, slots=True)
class PointFactor:
    """A point seen at ``pixel`` (2,). ``lens``: of the ``model``, for compiled code.

    The values of the factor are the robot's pose (3,); corrections (P,) of the constants with indices ``estimated`` in
    :data:`~factors.camera.model.PARAMETERS`, if any; the robot's roll and pitch (2,) [rad]; and the point (3,).
    """

    model: CameraModel
    lens: Lens
    pixel: Array
    estimated: tuple[int, ...] = ()

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Whitened, robustly weighted residual (2,) and its Jacobian (2, d) by each value. A point behind the camera has a constant
        residual, as no gradient leads to its true position."""
        residual, by_pose, by_constants, by_tilt, by_point, _ = self._seen(values)
        if not self.estimated:
            return residual, [by_pose, by_tilt, by_point]
        turn = np.zeros(3)
        for place, value in zip(self.estimated, values[1].tolist(), strict=True):
            if place in (3, 4, 5):
                turn[place - 3] = value
        by_constants[:, 3:6] = by_constants[:, 3:6] @ gtsam.Rot3.ExpmapDerivative(-turn)
        return residual, [by_pose, by_constants[:, list(self.estimated)], by_tilt, by_point]

    def cost(self, values: Sequence[Array]) -> float:
        """The robust loss."""
        return float(huber_loss(self._seen(values)[-1], self.model.robust))

    def is_astray(self, values: Sequence[Array]) -> bool:
        """Whether the point cannot be what the robot saw: it is behind the camera, or :data:`BEHIND` standard deviations away."""
        return bool(self._seen(values)[-1] >= BEHIND**2)

    def _seen(self, values: Sequence[Array]) -> tuple[Array, Array, Array, Array, Array, float]:
        model, lens, (pose, *constants, tilt, point) = self.model, self.lens, values
        if constants:
            changes = np.zeros(len(PARAMETERS))
            changes[list(self.estimated)] = constants[0]
            model = recalibrated(model, changes)
            lens = lens_of(model)
        camera = lens, model.position, model.rotation
        return kernels.seen_by_tilted(*camera, pose, tilt, point, self.pixel, model.sigma, model.robust, BEHIND)
