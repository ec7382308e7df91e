"""Common parts of the factors of landmarks, positions and image points: the motion from the estimated pose to the pose
at the time of the measurement, and the marginalisation of all variables except the pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from factors import positive, se2
from factors.se2 import Array


class SightingFactor(Protocol):
    """The interface of a factor with K sightings, which are measured objects with g coordinates each. All are measured
    at one time, such as the ranges and bearings of K landmarks."""

    def whitened(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Return the whitened residual (K, g), and a list of its Jacobians (K, g, d) by each of ``values`` (d,)."""

    def weight(self, squared: Array) -> Array:
        """Return the robust weights (K,) for ``squared`` (K,), the squared norms of whitened residuals."""

    def dof(self) -> int:
        """Return the number of measured coordinates."""


def delayed(offset: Array | None, twist: Array | None, seconds: float) -> Array | None:
    """Return the robot's pose ``seconds`` after the pose ``offset`` (3,), in the same frame.

    ``offset``: the robot's pose at the time of a measurement, in the frame of the estimated pose. None if both poses
    are equal. ``twist`` (3,): the robot's velocity in the body frame. If it is None, ``offset`` is returned unchanged.
    """
    if twist is None or seconds == 0.0:
        return offset
    later = se2.exp(twist * seconds)
    return later if offset is None else se2.compose(offset, later)


@dataclass(frozen=True)
class Marginalized:
    """A sighting factor on the pose only, made from a factor on the pose and further variables.

    ``factor``: the factor on the pose and the further variables, such as sensor constants or the position of a
    landmark. ``values``: the estimates of the further variables. ``covariances``: the covariance of each estimate, or
    None if it is exact. The covariances increase the noise of the sightings. They are multiplied by the number of
    sightings, because the error is common to all sightings and does not average out.
    """

    factor: SightingFactor
    values: tuple[Array, ...]
    covariances: tuple[Array | None, ...]

    def whitened(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Return the whitened residual (K, g) and a list of its Jacobian (K, g, 3). ``values``: a list of the pose."""
        residual, (by_pose, *by_values) = self.factor.whitened([values[0], *self.values])
        noise = np.eye(residual.shape[1])
        for block, covariance in zip(by_values, self.covariances, strict=True):
            if covariance is not None:
                noise = noise + len(block) * block @ covariance @ block.transpose(0, 2, 1)
        if noise.ndim == 2:
            return residual, [by_pose]
        whitener = positive.whitener(noise)
        return np.einsum("kij,kj->ki", whitener, residual), [whitener @ by_pose]

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Return the whitened residual (K g,) with robust weights, and a list of its Jacobian (K g, 3) by the pose.
        ``values``: a list of the pose (3,)."""
        residual, (by_pose,) = self.whitened(values)
        weight = np.sqrt(self.weight(np.einsum("ki,ki->k", residual, residual)))
        return (weight[:, None] * residual).ravel(), [(weight[:, None, None] * by_pose).reshape(-1, 3)]

    def weight(self, squared: Array) -> Array:
        """Return the robust weights (K,) for ``squared`` (K,), the squared norms of whitened residuals."""
        return self.factor.weight(squared)

    def cost(self, values: Sequence[Array]) -> float:
        """Return half the weighted sum of squared residuals. ``values``: a list of the pose (3,)."""
        residual, _ = self.whitened(values)
        squared = np.einsum("ki,ki->k", residual, residual)
        return float(0.5 * np.sum(self.weight(squared) * squared))

    def dof(self) -> int:
        """Return the number of measured coordinates."""
        return self.factor.dof()
