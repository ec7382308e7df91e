"""The factor of a measured position, such as of a GNSS or UWB receiver, on the pose of the robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from factors import positive, se2
from factors.motion import Increment
from factors.robust import geman_mcclure_loss, geman_mcclure_weight
from factors.se2 import Array


@dataclass(frozen=True)
class PositionFactor:
    """A measured position of a point of the robot, as a factor on the robot's pose.

    ``position`` (2,) [m]: the measured position in the world frame, with ``covariance`` (2, 2).
    ``arm`` (2,) [m]: the measured point in the robot frame, such as the place of a GNSS or UWB antenna.
    ``offset``: the robot's motion from the time of the pose to the time of the measurement. None if the times are
    equal. ``robust``: scale of the Geman-McClure loss in standard deviations.

    Methods with ``values`` take a list of one pose (3,).
    """

    position: Array
    covariance: Array
    arm: Array
    robust: float
    offset: Increment | None = None

    @property
    def point(self) -> Array:
        """The measured point (2,) [m] in the robot frame at the time of the estimated pose, not of the measurement."""
        return self.arm if self.offset is None else np.asarray(se2.transform_from(self.offset.delta, self.arm))

    def errors(self, poses: Array) -> Array:
        """Return predicted minus measured positions (N, 2) [m] for poses (N, 3)."""
        return np.asarray(se2.transform_from(poses, self.point) - self.position)

    def linearized(self, poses: Array) -> tuple[Array, Array]:
        """Return whitened residuals (N, 2) at poses (N, 3), and their body-frame Jacobians (N, 2, 3) by the poses."""
        point, axes = self.point, _axes(poses[:, 2])
        jacobian = axes @ np.array(((1.0, 0.0, -point[1]), (0.0, 1.0, point[0])))
        whitener = positive.whitener(self._covariances(poses))
        return np.einsum("nij,nj->ni", whitener, self.errors(poses)), whitener @ jacobian

    def whitened(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Return the whitened residual (1, 2) and a list of its Jacobian (1, 2, 3). ``values``: a list of the pose."""
        residual, jacobian = self.linearized(values[0][None])
        return residual, [jacobian]

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Return the whitened residual (2,) with robust weights, and a list of its Jacobian (2, 3) by the pose.
        ``values``: a list of the pose (3,)."""
        residual, (jacobian,) = self.whitened(values)
        weight = np.sqrt(self.weight(residual[0] @ residual[0]))
        return weight * residual[0], [weight * jacobian[0]]

    def losses(self, poses: Array) -> Array:
        """Return the robust losses (N,) at poses (N, 3)."""
        squared = positive.squared(self.errors(poses), self._covariances(poses))
        return np.asarray(geman_mcclure_loss(squared, self.robust))

    def squared(self, pose: Array, covariance: Array) -> float:
        """Return the normalised innovation squared: the squared Mahalanobis distance from the measured position to the
        position predicted from ``pose`` (3,) with body-frame ``covariance`` (3, 3)."""
        residual, (jacobian,) = self.whitened([pose])
        return float(positive.squared(residual[0], np.eye(2) + jacobian[0] @ covariance @ jacobian[0].T))

    def cost(self, values: Sequence[Array]) -> float:
        """Return the robust loss. ``values``: a list of the pose (3,)."""
        return float(self.losses(values[0][None])[0])

    def weight(self, squared: Array) -> Array:
        """Return the robust weights for ``squared``, the squared norms of whitened residuals."""
        return np.asarray(geman_mcclure_weight(squared, self.robust))

    def dof(self) -> int:
        """Return the number of measured coordinates, which is 2."""
        return 2

    def widened(self, width: float) -> PositionFactor:
        """Return the factor with the scale of its robust loss multiplied by ``width``."""
        return replace(self, robust=width * self.robust)

    def _covariances(self, poses: Array) -> Array:
        """Return the covariances (N, 2, 2) of :meth:`errors` at ``poses`` (N, 3), in the world frame."""
        if self.offset is None:
            return np.broadcast_to(self.covariance, (len(poses), 2, 2))
        x, y = self.arm
        moved = _axes(poses[:, 2] + self.offset.delta[2]) @ np.array(((1.0, 0.0, -y), (0.0, 1.0, x)))
        return np.asarray(self.covariance + moved @ self.offset.covariance @ moved.transpose(0, 2, 1))


def _axes(headings: Array) -> Array:
    """Return the rotation matrices (N, 2, 2) of headings (N,) [rad]."""
    c, s = np.cos(headings), np.sin(headings)
    return np.stack((np.stack((c, -s), axis=-1), np.stack((s, c), axis=-1)), axis=-2)
