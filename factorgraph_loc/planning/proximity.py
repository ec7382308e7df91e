"""Proximity sensor: free lengths in several directions, compared with the walls of the map.

Lengths of one reading are less independent than the model assumes, as they share errors of the grid and of the walls' shape; the
likelihood is therefore tempered (:data:`TEMPERING`).
"""

import math

import numpy as np

from factorgraph_loc.maps.free_space import FreeSpace
from factorgraph_loc.planning.paths import DIRECTIONS, free_steps, straight
from factors.se2 import Array

SIGMA = 0.3  # m
UNEXPECTED = 0.05  # likelihood of an unexpected length, relative to the Gaussian's peak
TEMPERING = 0.25


class ProximitySensor:
    """Measures free lengths up to ``sight`` [m] in :data:`~factorgraph_loc.planning.paths.DIRECTIONS` directions in ``space``."""

    def __init__(self, space: FreeSpace, sight: float) -> None:
        self.space = space
        self._rays = [straight(2.0 * math.pi * k / DIRECTIONS, sight) for k in range(DIRECTIONS)]
        self._sight = sight

    def expected(self, poses: Array) -> Array:
        """Expected free lengths [m] (M, D) at poses (M, 3)."""
        steps = free_steps(self.space, poses, self._rays)
        return np.stack([ray.way[at] for ray, at in zip(self._rays, steps, strict=True)], axis=1)

    def read(self, pose: Array, rng: np.random.Generator) -> Array:
        """Measured free lengths [m] (D,) at a pose (3,)."""
        true = self.expected(pose[None])[0]
        return np.asarray(np.clip(true + SIGMA * rng.standard_normal(len(true)), 0.0, self._sight))

    def log_likelihood(self, poses: Array, lengths: Array) -> Array:
        """Log-likelihood (M,) of ``lengths`` (D,) at poses (M, 3), up to a constant: a Gaussian per length plus a floor for
        unexpected ones (after Thrun, Burgard, Fox, "Probabilistic Robotics", 2005, section 6.3.1, but not normalised).
        """
        errors = (self.expected(poses) - lengths) / SIGMA
        return np.asarray(TEMPERING * np.log((1.0 - UNEXPECTED) * np.exp(-0.5 * errors**2) + UNEXPECTED).sum(axis=1))
