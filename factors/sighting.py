"""Common parts of sighting factors: a pose variable at a known motion before the sighting, and marginalization."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from factors import positive, se2
from factors.se2 import Array


class SightingFactor(Protocol):
    """A factor of K sightings with g coordinates each, such as :class:`~factors.landmarks.factor.BearingRangeFactor`."""

    def whitened(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Whitened residual (K, g) and its Jacobian (K, g, d) by each value."""

    def weight(self, squared: Array) -> Array:
        """The robust weight of squared whitened residuals."""

    def dof(self) -> int:
        """Number of measured coordinates."""


def delayed(offset: Array | None, twist: Array | None, seconds: float) -> Array | None:
    """The ``offset`` (3,) of a sighting ``seconds`` later, at the robot velocity ``twist`` (3,)."""
    if twist is None or seconds == 0.0:
        return offset
    later = se2.exp(twist * seconds)
    return later if offset is None else se2.compose(offset, later)


@dataclass(frozen=True)
class Marginalized:
    """A sighting factor on the pose only: its other values are fixed at ``values``, with ``covariances``, None for exact values.

    An error of a value is common to all K sightings: its covariance is multiplied by K, so that it does not average out.
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
        """Whitened, robustly weighted residual and its Jacobian by the pose."""
        residual, (by_pose,) = self.whitened(values)
        weight = np.sqrt(self.weight(np.einsum("ki,ki->k", residual, residual)))
        return (weight[:, None] * residual).ravel(), [(weight[:, None, None] * by_pose).reshape(-1, 3)]

    def weight(self, squared: Array) -> Array:
        """The robust weight of squared whitened residuals."""
        return self.factor.weight(squared)

    def cost(self, values: Sequence[Array]) -> float:
        """The robust loss, consistent with the weights."""
        residual, _ = self.whitened(values)
        squared = np.einsum("ki,ki->k", residual, residual)
        return float(0.5 * np.sum(self.weight(squared) * squared))

    def dof(self) -> int:
        """Number of measured values."""
        return self.factor.dof()
