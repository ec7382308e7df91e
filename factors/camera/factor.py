"""The reprojection factor of known points in an image. It depends on a robot pose, and optionally on camera constants
and on displacements of points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from factors import se2
from factors.camera import update_kernels as pixel_kernels
from factors.camera.kernels import CONSTANTS, POINT, TILT, WIDTH
from factors.camera.model import (
    PARAMETERS,
    TIME_OFFSET,
    CameraModel,
    lens_of,
    recalibrated,
)
from factors.robust import huber_loss, huber_weight
from factors.se2 import Array, moved
from factors.sighting import delayed
from factors.update import CONVERGED, Correction, update_state

TILTS = 2  # the number of errors that all points of an image have in common: roll and pitch of the robot
# Arguments of compiled code that replace None: a zero offset, an offset without covariance, and exact points.
NOT_MOVED, NO_SPREAD, EXACT = np.zeros(3), np.zeros((3, 3)), np.empty((0, 3, 3))


@dataclass(frozen=True, slots=True)
class ReprojectionFactor:
    """A factor on the robot's pose from K known points in one image, taken at the time of the pose or later.

    ``model``: the camera. ``points`` (K, 3) [m]: world positions. ``pixels`` (K, 2): their measured pixels.
    ``offset`` (3,): the robot's pose at the time of the image in the frame of the estimated pose, from odometry. None
    if the two poses are equal. ``offset_covariance`` (3, 3): its body-frame covariance, which is added to the noise.
    ``point_covariances`` (K, 3, 3): covariances of the points, which are added to the noise. None if exact.
    ``estimated``: indices in :data:`PARAMETERS` of the P camera constants that are estimated.
    ``moved_by`` (K,): for each point, the index of the estimated displacement that is added to the point, or -1. Empty
    if no displacement is estimated. ``twist`` (3,): the robot's body-frame velocity at the time of the image. Required
    if the time offset is estimated.

    The methods take ``values``, a list in this order: the pose (3,), the corrections (P,) of the estimated constants if
    P > 0, and each displacement (3,) [m] in the world. All points share the robot's unknown roll and pitch.
    """

    model: CameraModel
    points: Array
    pixels: Array
    offset: Array | None = None
    offset_covariance: Array | None = None
    point_covariances: Array | None = None
    estimated: tuple[int, ...] = ()
    moved_by: tuple[int, ...] = ()
    twist: Array | None = None

    @property
    def of_pose_alone(self) -> bool:
        """True if the factor depends on the pose only."""
        return not self.estimated and not self.moved_by

    def packed(self) -> pixel_kernels.PackedImage:
        """Return the fields of the factor as a tuple, for compiled code. The factor must depend on the pose only."""
        model, offset, noise, covariances = self.model, self.offset, self.offset_covariance, self.point_covariances
        return pixel_kernels.PackedImage(
            lens_of(model),
            model.position,
            model.rotation,
            np.ascontiguousarray(self.points, dtype=float),
            np.ascontiguousarray(self.pixels, dtype=float),
            EXACT if covariances is None else np.ascontiguousarray(covariances),
            NOT_MOVED if offset is None else offset,
            NO_SPREAD if noise is None else noise,
            float(model.sigma),
            float(model.robust),
            float(model.tempering),
            float(model.tilt),
        )

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Return the whitened residual (2K,) of K pixels and its Jacobian (2K, d) by each variable of size d.
        ``values``: the pose (3,), then the estimated constants and displacements, see the class. Both are scaled by the
        robust weights and the root of the tempering exponent. The noise includes the robot's unknown roll and pitch."""
        if self.of_pose_alone:
            residual, jacobian = pixel_kernels.linearized(self.packed(), np.ascontiguousarray(values[0], dtype=float))
            return residual, [jacobian]
        error, blocks = self.whitened(values)
        model, jacobian = self.model, np.concatenate(blocks, axis=2)
        residual, jacobian = pixel_kernels.marginal(error, jacobian, float(model.robust), float(model.tempering))
        ends = np.cumsum([block.shape[2] for block in blocks[:-1]])
        return residual, np.split(jacobian, ends[:-1], axis=1)

    def cost(self, values: Sequence[Array]) -> float:
        """Return the robust loss for the best-fitting roll and pitch, multiplied by the tempering exponent. ``values``:
        the pose (3,), then the estimated constants and displacements, see the class."""
        error, tilt = self.levelled(values)
        loss = np.sum(huber_loss(np.sum(error**2, axis=-1), self.model.robust)) + 0.5 * tilt @ tilt
        return self.model.tempering * float(loss)

    def levelled(self, values: Sequence[Array]) -> tuple[Array, Array]:
        """Fit roll and pitch to the K pixels of the image. ``values``: pose, constants, displacements, see the class.
        Returns the whitened residual (K, 2) after the fit, and roll and pitch (2,) in units of their prior sigma."""
        error, (*_, by_tilt) = self.whitened(values)
        roll, pitch, _ = pixel_kernels.tilted(error, np.ascontiguousarray(by_tilt), float(self.model.robust))
        tilt = np.array((roll, pitch))
        return error + by_tilt @ tilt, tilt

    def weight(self, squared: Array) -> Array:
        """Return the robust weights (K,) for ``squared`` (K,), the squared norms of whitened residuals, multiplied by
        the tempering exponent."""
        return self.model.tempering * huber_weight(squared, self.model.robust)

    def whitened(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Return the whitened residual (K, 2) of a level robot, predicted minus measured, and a list of Jacobians.

        ``values``: the pose (3,), then the estimated constants and displacements, see the class. The list has the
        Jacobian (K, 2, d) by each variable of size d. Its last element is the Jacobian (K, 2, 2) by roll and pitch in
        units of their prior standard deviation. Robust weights are not included.
        """
        moved_by, displacements = np.array(self.moved_by, dtype=np.int64), values[1 + bool(self.estimated) :]
        moves = None if not self.moved_by else np.array((*displacements, np.zeros(3)))[moved_by]
        on_pose = self.fixed(values[1 : 1 + bool(self.estimated)], moves)
        pose, width = np.ascontiguousarray(values[0], dtype=float), POINT if self.of_pose_alone else WIDTH
        residual, jacobian = pixel_kernels.whitened(on_pose.packed(), pose, width)
        blocks = [jacobian[..., :TILT]]
        if self.estimated:
            by_parameters = jacobian[..., CONSTANTS:]
            by_parameters[..., 3:6] = by_parameters[..., 3:6] @ turns(self.estimated, values[1])
            if self.twist is not None:
                twist = self.twist if on_pose.offset is None else se2.adjoint(on_pose.offset) @ self.twist
                by_parameters[..., TIME_OFFSET] = blocks[0] @ twist
            blocks.append(by_parameters[..., list(self.estimated)])
        by_point = jacobian[..., POINT:CONSTANTS]
        blocks += [np.where((moved_by == i)[:, None, None], by_point, 0.0) for i in range(len(displacements))]
        return residual, [*blocks, jacobian[..., TILT:POINT]]

    def fixed(self, parameters: Sequence[Array], displacement: Array | None) -> ReprojectionFactor:
        """Return a factor on the pose only, with constants and displacements fixed at the given values.

        ``parameters``: a sequence of one array (P,), the corrections of the estimated constants, or an empty sequence.
        ``displacement`` (K, 3) [m]: is added to the points. None for zero.
        """
        if not parameters and displacement is None:
            return self
        model, offset = self.model, self.offset
        if parameters:
            changes = np.zeros(len(PARAMETERS))
            changes[list(self.estimated)] = parameters[0]
            model = recalibrated(model, changes)
            offset = delayed(offset, self.twist, float(changes[TIME_OFFSET]))
        points = self.points if displacement is None else self.points + displacement
        return replace(self, model=model, points=points, offset=offset, estimated=(), moved_by=())

    def dof(self) -> int:
        """Return the number of measured pixel coordinates, two per point."""
        return 2 * len(self.pixels)


def image_update(
    factor: ReprojectionFactor,
    pose: Array,
    covariance: Array,
    iterations: int,
    converged: float = CONVERGED,
    values: Sequence[Array] = (),
    columns: Sequence[slice] = (),
) -> Correction:
    """Correct the Gaussian estimate of a robot pose by the image points of ``factor``, with an iterated Kalman update.

    ``pose`` (3,): the predicted pose.
    ``covariance`` (S, S): covariance of the error state. Its first three components are the pose's body-frame
    perturbation. ``iterations``: the maximum number of iterations. They end earlier when a step is below ``converged``.
    ``values``: the predicted values of the factor's variables except the pose. ``columns``: for each of these
    variables, the slice of its components in the error state.

    Returns the correction (S,) of the error state, the new covariance (S, S) and statistics as one object. The new
    covariance is in the body frame of the predicted pose. With ``values``, it is in that of the updated pose.
    """
    size = len(covariance)
    packed = factor.packed() if factor.of_pose_alone else None

    def linearize(delta: Array) -> tuple[Array, Array]:
        if packed is not None and size == len(pose):
            residual, jacobian = pixel_kernels.whitened(packed, moved(pose, delta))
            return residual + jacobian[..., size:] @ delta[size:], jacobian
        at = [v + delta[column] for v, column in zip(values, columns, strict=True)]
        residual, blocks = factor.whitened([se2.compose(pose, se2.exp(delta[:3])), *at])
        jacobian = np.zeros((*residual.shape, len(delta)))
        for column, block in zip((slice(3), *columns, slice(size, None)), blocks, strict=True):
            jacobian[..., column] = block
        if values:
            jacobian[..., :3] = jacobian[..., :3] @ se2.right_jacobian(delta[:3])
        return residual + blocks[-1] @ delta[size:], jacobian

    correction = update_state(linearize, covariance, factor.weight, iterations, factor.dof(), converged, TILTS)
    if not values:
        return correction
    reset = np.eye(size)
    reset[:3, :3] = se2.right_jacobian(correction.delta[:3])
    return replace(correction, covariance=reset @ correction.covariance @ reset.T)


def turns(estimated: tuple[int, ...], changes: Array) -> Array:
    """Return the Jacobian (3, 3) that converts a change of the camera's estimated rotation vector to a small rotation.
    Both are about the robot's axes. ``changes`` (P,): the corrections of the constants with indices ``estimated`` in
    :data:`PARAMETERS`, which include roll, pitch and yaw. It is the left Jacobian of SO(3)."""
    full = np.zeros(len(PARAMETERS))
    full[list(estimated)] = changes
    return np.asarray(gtsam.Rot3.ExpmapDerivative(-full[3:6]))
