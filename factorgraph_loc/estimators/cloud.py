"""A cloud of weighted particles: its moments, its modes, and drawing from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_loc.estimators.base import Mode
from factors import se2
from factors.se2 import Array

# of a cloud that has collapsed to one point: its covariance must still be one
MINIMUM_VARIANCE = 1e-10
MODES = 5  # at most
REACH = np.array((1.0, 1.0, 0.6))  # m, m, rad: from the middle of a mode to its ends
CELL = np.array((0.5, 0.5, 0.3))  # m, m, rad, in which the heaviest place is looked for


@dataclass(frozen=True)
class Cloud:
    """``poses`` (N, 3), ``parameters`` (N, P) of the odometry, and normalised ``log_weights`` (N,).

    ``localized``: the place is known. ``slow`` and ``fast``: averages of the likelihood over many and over few stamps.
    """

    poses: Array
    parameters: Array
    log_weights: Array
    localized: bool = True
    slow: float = 0.0
    fast: float = 0.0

    @property
    def weights(self) -> Array:
        return np.asarray(np.exp(self.log_weights))

    def moments(self) -> tuple[Array, Array]:
        """Mean (3,) and covariance (3, 3) in the world's frame."""
        return pose_moments(self.poses, self.weights)

    def modes(self) -> tuple[Mode, ...]:
        """The places where the weight is, the heaviest first: each with the moments of the particles around it."""
        weights = self.weights
        found: list[Mode] = []
        cells = np.floor(self.poses / CELL).astype(int)
        free = np.ones(len(weights), dtype=bool)
        while len(found) < MODES and weights[free].sum() > 0.01:
            _, which = np.unique(cells[free], axis=0, return_inverse=True)
            heaviest = np.argmax(np.bincount(which.ravel(), weights[free]))
            middle, _ = _normalised_moments(self.poses[free], weights[free] * (which.ravel() == heaviest))
            for _ in range(2):
                difference = np.abs(self.poses - middle)
                difference[:, 2] = np.abs(se2.wrap(difference[:, 2]))
                near = free & np.all(difference < REACH, axis=1)
                middle, covariance = _normalised_moments(self.poses[near], weights[near])
            found.append(Mode(float(weights[near].sum()), middle, covariance))
            free &= ~near
        return tuple(sorted(found, key=lambda m: -m.weight))


def systematic(weights: Array, rng: np.random.Generator, count: int | None = None) -> Array:
    """Indices of ``count`` draws (as many as weights by default) by systematic resampling (Kitagawa, 1996)."""
    count = len(weights) if count is None else count
    positions = (rng.random() + np.arange(count)) / count
    cumulative = np.cumsum(weights)
    return np.minimum(np.searchsorted(cumulative / cumulative[-1], positions), len(weights) - 1)


def pose_moments(poses: Array, weights: Array) -> tuple[Array, Array]:
    """Weighted mean (3,), circular in heading, and covariance (3, 3) of poses (N, 3) in the world's frame."""
    heading = np.arctan2(weights @ np.sin(poses[:, 2]), weights @ np.cos(poses[:, 2]))
    mean = np.array((weights @ poses[:, 0], weights @ poses[:, 1], heading))
    error = poses - mean
    error[:, 2] = se2.wrap(error[:, 2])
    covariance = (weights[:, None] * error).T @ error
    return mean, covariance + np.diag(np.full(3, MINIMUM_VARIANCE))


def vector_moments(values: Array, weights: Array) -> tuple[Array, Array]:
    """Weighted mean (P,) and covariance (P, P) of vectors (N, P)."""
    mean = weights @ values
    error = values - mean
    return mean, (weights[:, None] * error).T @ error


def _normalised_moments(poses: Array, weights: Array) -> tuple[Array, Array]:
    return pose_moments(poses, weights / weights.sum())
