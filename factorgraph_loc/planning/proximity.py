"""What a robot's proximity sensor finds: how far it could go in each of some directions.

It tells the particles where they cannot be: a crossing, a dead end and a long corridor look
different, whatever the tags. The lengths of one look are not as independent as their model has it, of which the map of cells and
the walls' own shape are in error alike: each look counts as few (:data:`TEMPERING`).
"""

import math

import numpy as np

from factorgraph_loc.maps.free_space import FreeSpace
from factorgraph_loc.planning.paths import DIRECTIONS, free_steps, straight
from factors.se2 import Array

SIGMA = 0.3  # m
UNEXPECTED = 0.05  # of the Gaussian's peak: what a length counts for that has nothing to do with the map
TEMPERING = 0.25


class ProximitySensor:
    """Looks up to ``sight`` [m] in :data:`~factorgraph_loc.planning.paths.DIRECTIONS` directions, all around, in ``space``."""

    def __init__(self, space: FreeSpace, sight: float) -> None:
        self.space = space
        self._rays = [straight(2.0 * math.pi * k / DIRECTIONS, sight) for k in range(DIRECTIONS)]
        self._sight = sight

    def expected(self, poses: Array) -> Array:
        """Free lengths [m] (M, D) at poses (M, 3)."""
        steps = free_steps(self.space, poses, self._rays)
        return np.stack([ray.way[at] for ray, at in zip(self._rays, steps, strict=True)], axis=1)

    def read(self, pose: Array, rng: np.random.Generator) -> Array:
        """Free lengths [m] (D,) as they are measured at a pose (3,)."""
        true = self.expected(pose[None])[0]
        return np.asarray(np.clip(true + SIGMA * rng.standard_normal(len(true)), 0.0, self._sight))

    def log_likelihood(self, poses: Array, lengths: Array) -> Array:
        """Of ``lengths`` (D,) at poses (M, 3), up to a constant: a Gaussian each, above a floor for what is anything (after
        Thrun, Burgard, Fox, "Probabilistic Robotics", 2005, section 6.3.1, but not normalised)."""
        errors = (self.expected(poses) - lengths) / SIGMA
        return np.asarray(TEMPERING * np.log((1.0 - UNEXPECTED) * np.exp(-0.5 * errors**2) + UNEXPECTED).sum(axis=1))
