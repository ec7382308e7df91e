"""The factors of points with unknown positions in images: the factor of one pixel, and a weak prior of a point's position."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np

from factors import se2
from factors.camera import kernels
from factors.camera.factor import turns
from factors.camera.kernels import BEHIND, CONSTANTS, POINT, TILT, Lens
from factors.camera.model import PARAMETERS, TIME_OFFSET, CameraModel, lens_of, recalibrated
from factors.robust import huber_loss
from factors.se2 import Array


@dataclass(frozen=True, slots=True)
class PointFactor:
    """The pixel of one point as a factor on the robot's pose, the robot's tilt and the point's position.

    ``model``: the camera. ``lens``: its constants for compiled code, from :func:`~factors.camera.model.lens_of`.
    ``pixel`` (2,): the measured pixel of the point.
    ``estimated``: indices in :data:`~factors.camera.model.PARAMETERS` of the P camera constants that are estimated.
    ``twist`` (3,): the robot's body-frame velocity. Needed if the time offset is estimated.

    The methods take a list of values in this order: the robot's pose (3,), the corrections (P,) of the estimated
    constants if P > 0, the robot's roll and pitch (2,) [rad], and the point (3,) in the world.
    """

    model: CameraModel
    lens: Lens
    pixel: Array
    estimated: tuple[int, ...] = ()
    twist: Array | None = None

    @property
    def alike(self) -> Hashable:
        """A hashable key that is equal for factors of one camera. Such factors can be linearised together."""
        return id(self.model)

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Return the whitened residual (2,) with robust weight, and its Jacobian (2, d) by each variable of size d.
        ``values``: pose, estimated constants, roll and pitch, and point, see the class. If the point is behind the
        camera, the residual is constant and the Jacobian is zero."""
        residuals, blocks = self.linearize_all([self], [values])
        return residuals[0], [block[0] for block in blocks]

    @staticmethod
    def linearize_all(factors: Sequence[PointFactor], values: Sequence[Sequence[Array]]) -> tuple[Array, list[Array]]:
        """Linearise N factors of one camera. ``values``: the variables of each factor (pose, estimated constants, roll
        and pitch, point). The camera's constants must be equal in all. Returns residuals (N, 2) and the Jacobian (N, 2,
        d) by each variable."""
        estimated, constants = factors[0].estimated, values[0][1]
        residual, jacobian, _ = _linearize_all(factors, values)
        if TIME_OFFSET in estimated:
            twists, later = _later(factors, values)
            jacobian[..., CONSTANTS + TIME_OFFSET] = np.einsum("nri,ni->nr", jacobian[..., :TILT], twists)
            jacobian[..., :TILT] = jacobian[..., :TILT] @ se2.adjoint(se2.inverse(later))
        blocks = [jacobian[..., :TILT], jacobian[..., TILT:POINT], jacobian[..., POINT:CONSTANTS]]
        if estimated:
            by_constants = jacobian[..., CONSTANTS:]
            by_constants[..., 3:6] = by_constants[..., 3:6] @ turns(estimated, constants)
            blocks.insert(1, by_constants[..., list(estimated)])
        return residual, blocks

    def cost(self, values: Sequence[Array]) -> float:
        """Return the robust loss of the pixel. ``values``: pose, constants, roll and pitch, point, see the class."""
        return float(huber_loss(_linearize_all([self], [values])[2], self.model.robust).sum())

    def is_astray(self, values: Sequence[Array]) -> bool:
        """True if the pixel is certainly a false match: the point is behind the camera, or its predicted pixel is at
        least :data:`BEHIND` standard deviations from the measured one. ``values``: the variables, see the class."""
        return bool(_linearize_all([self], [values])[2][0] >= BEHIND**2)


def _linearize_all(factors: Sequence[PointFactor], values: Sequence[Sequence[Array]]) -> tuple[Array, Array, Array]:
    """Return the robustly weighted residuals (N, 2) of N factors, their Jacobian (N, 2, WIDTH), and the squared norms
    (N,) of the unweighted residuals. ``values``: the variables of each factor."""
    first = factors[0]
    model, lens, (_, *constants, _, _) = first.model, first.lens, values[0]
    if constants:
        changes = np.zeros(len(PARAMETERS))
        changes[list(first.estimated)] = constants[0]
        model = recalibrated(model, changes)
        lens = lens_of(model)
    poses, tilts, points, pixels = (
        np.array([v[0] for v in values], dtype=float),
        np.array([v[-2] for v in values], dtype=float),
        np.array([v[-1] for v in values], dtype=float),
        np.array([f.pixel for f in factors], dtype=float),
    )
    if TIME_OFFSET in first.estimated:
        poses = se2.compose(poses, _later(factors, values)[1])
    return kernels.whiten(lens, model.position, model.rotation, poses, tilts, points, pixels, model.sigma, model.robust)


def _later(factors: Sequence[PointFactor], values: Sequence[Sequence[Array]]) -> tuple[Array, Array]:
    """Return the robot's velocities (N, 3) at N factors, and its motions (N, 3) during the estimated time offset.
    ``values``: the variables of each factor."""
    twists = np.array([f.twist for f in factors], dtype=float)
    seconds = float(values[0][1][factors[0].estimated.index(TIME_OFFSET)])
    return twists, se2.exp(seconds * twists)


@dataclass(frozen=True, slots=True)
class PointPrior:
    """A weak prior of a point's position in the robot frame, as a factor on the robot's pose and the point.

    ``mean`` (3,) [m]: the expected position in the robot frame. ``sigma`` [m]: the standard deviation of each
    coordinate. The methods take ``values``, a list of the robot's pose (3,) and the point (3,) in the world.

    A prior in the world frame would constrain the robot: a thousand, each of 30 m, would fix its position to a metre.
    """

    mean: Array
    sigma: float

    @classmethod
    def of(cls, pose: Array, point: Array, sigma: float) -> PointPrior:
        """Return the prior of a world ``point`` (3,) with standard deviation ``sigma`` [m]. ``pose`` (3,): of the
        robot."""
        return cls(_from_robot(pose, point), sigma)

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Return the whitened residual (3,), and a list of its Jacobians (3, 3) by pose and point, the ``values``."""
        pose, point = values
        relative = _from_robot(pose, point)
        c, s = math.cos(pose[2]), math.sin(pose[2])
        by_pose = np.array(((-1.0, 0.0, relative[1]), (0.0, -1.0, -relative[0]), (0.0, 0.0, 0.0)))
        by_point = np.array(((c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)))
        return (relative - self.mean) / self.sigma, [by_pose / self.sigma, by_point / self.sigma]

    def cost(self, values: Sequence[Array]) -> float:
        """Return half the squared norm of the whitened residual. ``values``: the robot's pose and the point."""
        residual = (_from_robot(*values) - self.mean) / self.sigma
        return 0.5 * float(residual @ residual)


def _from_robot(pose: Array, point: Array) -> Array:
    """Transform a world point (3,) to the frame of a robot at ``pose`` (3,)."""
    return np.append(se2.transform_to(pose, point[:2]), point[2])
