"""The reprojection factor: points seen by a camera, on a pose and optionally on camera constants and a point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from factors import se2
from factors.camera import update_kernels as pixel_kernels
from factors.camera.kernels import NEAREST
from factors.camera.model import (
    PARAMETERS,
    TIME_OFFSET,
    CameraModel,
    in_camera,
    lens_of,
    linearize,
    project,
    recalibrated,
)
from factors.displaced import carried, common_error, delayed, displaced
from factors.robust import huber_loss, huber_weight
from factors.se2 import Array

NOT_MOVED, NO_SPREAD, EXACT = np.zeros(3), np.zeros((3, 3)), np.empty((0, 3, 3))
BEHIND = 100.0  # residual of a point behind the camera, in standard deviations


@dataclass(frozen=True, slots=True)
class ReprojectionFactor:
    """K points seen in one image, as a factor on the robot's pose at that time or shortly before.

    ``points`` (K, 3): in the world; ``pixels`` (K, 2): measured; ``point_covariances`` (K, 3, 3) of an inexact map are added to the
    noise. ``offset`` (3,): the pose at the image's time in the frame of the variable's pose, from odometry; its body-frame
    covariance ``offset_covariance`` (3, 3) is added to the noise. ``twist`` (3,): the robot's velocity at that time.

    The values of the factor are the pose (3,); corrections (P,) of the constants with indices ``estimated`` in :data:`PARAMETERS`,
    if any; and, if ``free``, the displacement of the points from ``points``: one for all (3,), or one for each (K, 3), with the
    Jacobian (K, 2, 3) of each residual by its own. ``in_image``: the number of points of the image, of which these are a part; by
    default K.
    """

    model: CameraModel
    points: Array
    pixels: Array
    offset: Array | None = None
    offset_covariance: Array | None = None
    point_covariances: Array | None = None
    estimated: tuple[int, ...] = ()
    free: bool = False
    twist: Array | None = None
    in_image: int | None = None

    @property
    def of_pose_alone(self) -> bool:
        """Whether the pose is its only variable."""
        return not self.estimated and not self.free

    def packed(self) -> pixel_kernels.Seen:
        """The arguments of the compiled code, for a factor :attr:`of_pose_alone`."""
        model, offset, noise, spreads = self.model, self.offset, self.offset_covariance, self.point_covariances
        if noise is not None and self.in_image is not None:  # which the code multiplies by the number of points here
            noise = self.in_image / max(1, len(self.points)) * noise
        return pixel_kernels.Seen(
            lens_of(model),
            model.position,
            model.rotation,
            np.ascontiguousarray(self.points, dtype=float),
            np.ascontiguousarray(self.pixels, dtype=float),
            EXACT if spreads is None else np.ascontiguousarray(spreads),
            NOT_MOVED if offset is None else offset,
            NO_SPREAD if noise is None else noise,
            float(model.sigma),
            float(model.robust),
            float(model.tempering),
        )

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Whitened, robustly weighted residual (2K,) and its Jacobian (2K, d) by each value."""
        if self.of_pose_alone:
            residual, jacobian = pixel_kernels.linearized(self.packed(), np.ascontiguousarray(values[0], dtype=float))
            return residual, [jacobian]
        error, blocks = self.whitened(values)
        weight = np.sqrt(self.weight(np.einsum("ki,ki->k", error, error)))
        weighted = [(weight[:, None, None] * block).reshape(-1, block.shape[2]) for block in blocks]
        return (weight[:, None] * error).ravel(), weighted

    def cost(self, values: Sequence[Array]) -> float:
        """The robust loss."""
        error, _ = self.whitened(values)
        return self.model.tempering * float(np.sum(huber_loss(np.sum(error**2, axis=-1), self.model.robust)))

    def weight(self, squared: Array) -> Array:
        """The robust weight of squared whitened residuals."""
        return self.model.tempering * huber_weight(squared, self.model.robust)

    def whitened(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Whitened residual (K, 2), predicted minus measured, and its Jacobian (K, 2, d) by each value, without robust weights."""
        if self.of_pose_alone:
            residual, jacobian = pixel_kernels.whitened(self.packed(), np.ascontiguousarray(values[0], dtype=float))
            return residual, [jacobian]
        here = self.fixed(values[1 : 1 + bool(self.estimated)], values[-1] if self.free else None)
        offset = here.offset
        at = values[0] if offset is None else se2.compose(values[0], offset)
        pixels, by_pose, by_point, by_parameters = linearize(here.model, at, here.points)
        error = (pixels - self.pixels) / self.model.sigma
        if self.free:
            # a point behind the camera has a constant residual, as no gradient leads to its true position
            behind = in_camera(here.model, at, here.points)[:, 2] < NEAREST
            error[behind] = BEHIND
            by_pose, by_point, by_parameters = (
                np.where(behind[:, None, None], 0.0, part) for part in (by_pose, by_point, by_parameters)
            )
        scale = 1.0 / self.model.sigma
        by_pose = scale * by_pose
        blocks = [by_pose]
        if self.estimated:
            by_parameters = scale * by_parameters
            by_parameters[..., 3:6] = by_parameters[..., 3:6] @ _turns(self.estimated, values[1])
            if self.twist is not None:
                by_parameters[..., TIME_OFFSET] = by_pose @ self.twist
            blocks.append(by_parameters[..., list(self.estimated)])
        if self.free:
            blocks.append(scale * by_point)
        spread = None
        if self.point_covariances is not None:
            spread = carried(scale * by_point, self.point_covariances)
        if self.offset_covariance is not None:
            common = common_error(by_pose, self.offset_covariance, self.in_image)
            spread = common if spread is None else spread + common
        return displaced(error, blocks, offset, spread)

    def is_astray(self, pose: Array, displacement: Array) -> bool:
        """Whether a free point, with this ``displacement`` (3,), cannot be what a robot at the variable's ``pose`` (3,) saw: it is
        behind the camera, or :data:`BEHIND` standard deviations away."""
        at = pose if self.offset is None else se2.compose(pose, self.offset)
        local = in_camera(self.model, at, self.points + displacement)
        error = (project(self.model, local) - self.pixels) / self.model.sigma
        return bool(np.any((local[:, 2] < NEAREST) | (np.sum(error**2, axis=1) > BEHIND**2)))

    def fixed(self, parameters: Sequence[Array], displacement: Array | None) -> ReprojectionFactor:
        """The factor on the pose only, at given constants (one array (P,), or none) and ``displacement`` of free points."""
        if not parameters and displacement is None:
            return self
        model, offset = self.model, self.offset
        if parameters:
            changes = np.zeros(len(PARAMETERS))
            changes[list(self.estimated)] = parameters[0]
            model = recalibrated(model, changes)
            offset = delayed(offset, self.twist, float(changes[TIME_OFFSET]))
        points = self.points if displacement is None else self.points + displacement
        return replace(self, model=model, points=points, offset=offset, estimated=(), free=False)

    def dof(self) -> int:
        """Number of measured pixel coordinates."""
        return 2 * len(self.pixels)


def _turns(estimated: tuple[int, ...], changes: Array) -> Array:
    """Jacobian (3, 3) of a small rotation by the corrections of the camera's rotation: the left Jacobian of SO(3), which is the
    right one of the opposite rotation."""
    turn = np.zeros(3)
    for place, value in zip(estimated, changes.tolist(), strict=True):
        if place in (3, 4, 5):
            turn[place - 3] = value
    return np.asarray(gtsam.Rot3.ExpmapDerivative(-turn))
