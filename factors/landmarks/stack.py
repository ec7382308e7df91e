"""Many looks at landmarks, linearised by one compiled call."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from factors.landmarks import kernels
from factors.landmarks.model import PARAMETERS, packed
from factors.robust import geman_mcclure_loss
from factors.se2 import Array, Integers

if TYPE_CHECKING:
    from factors.landmarks.factor import BearingRangeFactor


class BearingRangeStack:
    """Looks of one sensor: ``factors`` on the poses ``pose_of`` (L,) by number, of one model and with the same constants estimated,
    which are the parameters from ``column`` on. None of them is of a free landmark."""

    def __init__(self, factors: Sequence[BearingRangeFactor], pose_of: Sequence[int], column: int) -> None:
        first = factors[0]
        self._model, self._estimated, self._column = packed(first.model), list(first.estimated), column
        self._robust = first.model.robust
        self._pose_of = np.array(pose_of, dtype=np.int64)
        sizes = np.array([len(f.points) for f in factors])
        self._ends = np.cumsum(sizes)
        self._seen = (
            np.concatenate([f.points for f in factors]),
            np.concatenate([f.ranges for f in factors]),
            np.concatenate([f.bearings for f in factors]),
        )
        parts = [f.look for f in factors]
        spreads = [f.point_covariances for f in factors]
        self._flags = np.array([(p[3], p[5], p[8], s is not None) for p, s in zip(parts, spreads, strict=True)])
        self._offsets, self._covariances = np.array([p[4] for p in parts]), np.array([p[6] for p in parts])
        self._counts, self._twists = np.array([p[7] for p in parts]), np.array([p[9] for p in parts])
        none = [np.zeros((size, 2, 2)) for size in sizes.tolist()]
        self._spreads = np.concatenate([n if s is None else s for n, s in zip(none, spreads, strict=True)])
        self.rows = 2 * int(self._ends[-1])

    @property
    def first(self) -> Integers:
        """The number of the pose that each residual depends on."""
        return np.repeat(np.repeat(self._pose_of, np.diff(self._ends, prepend=0)), 2)

    def linearize(self, poses: Array, parameters: Array, jacobian: Array, residual: Array) -> None:
        """Fill ``residual`` (2 K,) and ``jacobian`` (2 K, 6 + P), see :mod:`factors.chain`, weighted."""
        error, by_pose, by_sensor = self._whitened(poses, parameters)
        kernels.weigh(error, by_pose, by_sensor, self._robust)
        residual[:], jacobian[:, :3] = error.ravel(), by_pose.reshape(-1, 3)
        end = self._column + len(self._estimated)
        jacobian[:, 6 + self._column : 6 + end] = by_sensor.reshape(len(residual), -1)[:, self._estimated]

    def cost(self, poses: Array, parameters: Array) -> float:
        """The robust loss of all."""
        error, _, _ = self._whitened(poses, parameters)
        return float(np.sum(geman_mcclure_loss(np.einsum("ki,ki->k", error, error), self._robust)))

    def _whitened(self, poses: Array, parameters: Array) -> tuple[Array, Array, Array]:
        changes, count = np.zeros(len(PARAMETERS)), self.rows // 2
        changes[self._estimated] = parameters[self._column : self._column + len(self._estimated)]
        found = np.zeros((count, 2)), np.zeros((count, 2, 3)), np.zeros((count, 2, len(PARAMETERS)))
        looks = self._flags, self._offsets, self._covariances, self._counts, self._twists, self._spreads
        kernels.linearize_all(self._model, poses, self._pose_of, changes, self._ends, self._seen, *looks, *found)
        return found
