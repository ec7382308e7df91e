"""Common parts of the factors of landmarks, positions and image points: an offset between pose variable and
measurement, and the marginalisation of all values except the pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from factors import positive, se2
from factors.se2 import Array


class SightingFactor(Protocol):
    """The interface of a factor with K sightings that were measured at one time, such as the ranges and bearings of K
    landmarks in :class:`~factors.landmarks.factor.BearingRangeFactor`. Each sighting has g coordinates."""

    def whitened(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Whitened residual (K, g) and its Jacobian (K, g, d) by each value."""

    def weight(self, squared: Array) -> Array:
        """The robust weights of ``squared`` norms of whitened residuals."""

    def dof(self) -> int:
        """Number of measured coordinates."""


def delayed(offset: Array | None, twist: Array | None, seconds: float) -> Array | None:
    """Extend an ``offset`` (3,) to a time ``seconds`` later, at the robot's body-frame velocity ``twist`` (3,).

    ``offset``: the pose at the measurement's time in the frame of the pose variable, None for zero. It is returned
    unchanged if the twist is None.
    """
    if twist is None or seconds == 0.0:
        return offset
    later = se2.exp(twist * seconds)
    return later if offset is None else se2.compose(offset, later)


@dataclass(frozen=True)
class Marginalized:
    """A sighting factor on the pose only. Its remaining values are fixed, and their covariances are added to the noise.

    ``factor``: the factor on the pose and further values, such as sensor constants or the position of a landmark.
    ``values``: the estimates of the further values. ``covariances``: the covariance of each, None if the value is exact.

    All K sightings have the error of a value in common. Its covariance is therefore multiplied by K, so that it does
    not average out.
    """

    factor: SightingFactor
    values: tuple[Array, ...]
    covariances: tuple[Array | None, ...]

    def whitened(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Whitened residual (K, g), and its Jacobian (K, g, 3) by the pose."""
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
        """The whitened residual (K g,) with robust weights, and its Jacobian (K g, 3) by the pose."""
        residual, (by_pose,) = self.whitened(values)
        weight = np.sqrt(self.weight(np.einsum("ki,ki->k", residual, residual)))
        return (weight[:, None] * residual).ravel(), [(weight[:, None, None] * by_pose).reshape(-1, 3)]

    def weight(self, squared: Array) -> Array:
        """The robust weights of ``squared`` norms of whitened residuals."""
        return self.factor.weight(squared)

    def cost(self, values: Sequence[Array]) -> float:
        """Half the sum of weighted squares of the residuals."""
        residual, _ = self.whitened(values)
        squared = np.einsum("ki,ki->k", residual, residual)
        return float(0.5 * np.sum(self.weight(squared) * squared))

    def dof(self) -> int:
        """Number of measured values."""
        return self.factor.dof()
