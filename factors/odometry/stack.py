"""Many increments of odometry, linearised by one compiled call."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from factors.odometry import kernels
from factors.se2 import Array, Integers

if TYPE_CHECKING:
    from factors.odometry.model import OdometryFactor


class OdometryStack:
    """Increments ``factors``, each between the pose ``first`` (K,) by number and the next one. All have the same constants
    estimated, which are the parameters from ``column`` on."""

    def __init__(self, factors: Sequence[OdometryFactor], first: Sequence[int], column: int) -> None:
        self._first, self._column = np.array(first, dtype=np.int64), column
        self._indices = np.array(factors[0].estimated, dtype=np.int64)
        packed = [f.packed for f in factors]
        self._deltas, self._twists = np.array([p[0] for p in packed]), np.array([p[1] for p in packed])
        self._moving, self._whiteners = np.array([p[2] for p in packed]), np.array([p[3] for p in packed])
        self.rows = 3 * len(packed)

    @property
    def first(self) -> Integers:
        """The number of the first pose that each residual depends on."""
        return np.repeat(self._first, 3)

    def linearize(self, poses: Array, parameters: Array, jacobian: Array, residual: Array) -> None:
        """Fill ``residual`` (3 K,) and ``jacobian`` (3 K, 6 + P), see :mod:`factors.chain`."""
        given = self._deltas, self._twists, self._moving, self._constants(parameters), self._indices, self._whiteners
        kernels.linearize_all(poses, self._first, *given, jacobian, residual, 6 + self._column)

    def cost(self, poses: Array, parameters: Array) -> float:
        """Half the sum of the squared residuals."""
        given = self._deltas, self._twists, self._moving, self._constants(parameters), self._indices, self._whiteners
        return float(kernels.cost_of_all(poses, self._first, *given))

    def _constants(self, parameters: Array) -> Array:
        return np.ascontiguousarray(parameters[self._column : self._column + len(self._indices)])
