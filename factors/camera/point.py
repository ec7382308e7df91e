"""A point of unknown position seen in an image: a factor on a planar pose, the tilt of the robot there, and the point."""

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
    """A point observed at a ``pixel`` (2,). ``lens``: of the ``model``, for compiled code.

    The values of the factor are the robot's pose (3,); corrections (P,) of the constants with indices ``estimated`` in
    :data:`~factors.camera.model.PARAMETERS`, if any; the robot's roll and pitch (2,) [rad]; and the point (3,). ``twist`` (3,): the
    robot's velocity, needed if the time offset is among them.
    """

    model: CameraModel
    lens: Lens
    pixel: Array
    estimated: tuple[int, ...] = ()
    twist: Array | None = None

    @property
    def alike(self) -> Hashable:
        """The camera."""
        return id(self.model)

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Whitened, robustly weighted residual (2,) and its Jacobian (2, d) by each value. A point behind the camera has a constant
        residual, as no gradient leads to its true position."""
        residuals, blocks = self.linearize_all([self], [values])
        return residuals[0], [block[0] for block in blocks]

    @staticmethod
    def linearize_all(factors: Sequence[PointFactor], values: Sequence[Sequence[Array]]) -> tuple[Array, list[Array]]:
        """:meth:`linearize` of N factors with the same camera and constants: residuals (N, 2) and Jacobians (N, 2, d)."""
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
        """The robust loss."""
        return float(huber_loss(_linearize_all([self], [values])[2], self.model.robust).sum())

    def is_astray(self, values: Sequence[Array]) -> bool:
        """Whether the point cannot be what the robot saw: it is behind the camera, or :data:`BEHIND` standard deviations away."""
        return bool(_linearize_all([self], [values])[2][0] >= BEHIND**2)


def _linearize_all(factors: Sequence[PointFactor], values: Sequence[Sequence[Array]]) -> tuple[Array, Array, Array]:
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
    """The velocities (N, 3) of the robot, and how far (N, 3) it moves within the time offset."""
    twists = np.array([f.twist for f in factors], dtype=float)
    seconds = float(values[0][1][factors[0].estimated.index(TIME_OFFSET)])
    return twists, se2.exp(seconds * twists)


@dataclass(frozen=True, slots=True)
class PointPrior:
    """A weak prior of a point: where it is from the robot, ``mean`` (3,) [m] with the standard deviation ``sigma`` [m] of each
    coordinate.

    The values of the factor are the robot's pose (3,) and the point (3,). Priors in the world frame would
    constrain the robot: a thousand priors of 30 m fix its position to a metre.
    """

    mean: Array
    sigma: float

    @classmethod
    def of(cls, pose: Array, point: Array, sigma: float) -> PointPrior:
        """That of a ``point`` (3,) estimated from a ``pose`` (3,)."""
        return cls(_from_robot(pose, point), sigma)

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Whitened residual (3,) and its Jacobians."""
        pose, point = values
        relative = _from_robot(pose, point)
        c, s = math.cos(pose[2]), math.sin(pose[2])
        by_pose = np.array(((-1.0, 0.0, relative[1]), (0.0, -1.0, -relative[0]), (0.0, 0.0, 0.0)))
        by_point = np.array(((c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)))
        return (relative - self.mean) / self.sigma, [by_pose / self.sigma, by_point / self.sigma]

    def cost(self, values: Sequence[Array]) -> float:
        """Half the squared whitened residual."""
        residual = (_from_robot(*values) - self.mean) / self.sigma
        return 0.5 * float(residual @ residual)


def _from_robot(pose: Array, point: Array) -> Array:
    return np.append(se2.transform_to(pose, point[:2]), point[2])
