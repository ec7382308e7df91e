"""Conversion of this package's factors to GTSAM's.

A factor has ``linearize(values)``, whose values are arrays: poses (3,), vectors (P,). It returns the whitened, robustly weighted
residual and one Jacobian per variable, by body-frame perturbation. The functions here validate both, because GTSAM silently accepts
Jacobians of wrong shape, and an exception in a callback leaves iSAM2 in an inconsistent state.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import gtsam
import numpy as np

from factors import positive, se2
from factors.se2 import Array


class Factor(Protocol):
    """A factor that :func:`custom_factor` and :func:`jacobian_factor` accept."""

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Whitened, weighted residual (m,) and a Jacobian (m, d) for each variable."""

    def cost(self, values: Sequence[Array]) -> float:
        """The loss, robust if the factor is."""


def pose_array(pose: gtsam.Pose2) -> Array:
    """A ``gtsam.Pose2`` as (x, y, heading)."""
    return np.array((pose.x(), pose.y(), pose.theta()))


def read_pose(values: gtsam.Values, key: int) -> Array:
    """The pose (3,) of a variable."""
    return pose_array(values.atPose2(key))


def read_vector(values: gtsam.Values, key: int) -> Array:
    """The vector of a variable."""
    return np.asarray(values.atVector(key), dtype=float)


def custom_factor(
    factor: Factor,
    keys: Sequence[int],
    readers: Sequence[Callable[[gtsam.Values, int], Array]],
    dimensions: Sequence[int],
    rows: int,
    on_failure: Callable[[str], None],
) -> gtsam.NonlinearFactor:
    """``factor`` on the variables ``keys``, read by ``readers``, with tangent ``dimensions`` and ``rows`` residuals.

    A residual or Jacobian that is not finite or has a wrong shape is replaced by zeros and reported to ``on_failure``.
    """

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Any) -> Array:
        try:
            residual, blocks = factor.linearize([read(values, key) for read, key in zip(readers, keys, strict=True)])
            _check(residual, blocks, rows, dimensions)
        except (ValueError, FloatingPointError, np.linalg.LinAlgError) as failure:
            on_failure(str(failure))
            residual, blocks = np.zeros(rows), [np.zeros((rows, d)) for d in dimensions]
        if jacobians is not None:
            for i, block in enumerate(blocks):
                jacobians[i] = block
        return residual

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(rows), list(keys), error)


def jacobian_factor(factor: Factor, keys: Sequence[int], values: Sequence[Array]) -> gtsam.JacobianFactor:
    """``factor`` linearised at ``values``."""
    residual, blocks = factor.linearize(values)
    arguments: list[Any] = [part for pair in zip(keys, blocks, strict=True) for part in pair]
    arguments += [-residual, gtsam.noiseModel.Unit.Create(len(residual))]
    return gtsam.JacobianFactor(*arguments)


class PriorFactor:
    """A Gaussian prior of a pose: ``mean`` (3,) and the ``covariance`` (3, 3) of its body-frame perturbation."""

    def __init__(self, mean: Array, covariance: Array) -> None:
        self._mean = mean
        self._whitener = positive.whitener(covariance)

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Whitened residual (3,) ``log(mean^-1 * pose)`` and its Jacobian."""
        error = se2.log(se2.between(self._mean, values[0]))
        return self._whitener @ error, [self._whitener @ np.linalg.inv(se2.right_jacobian(error))]

    def cost(self, values: Sequence[Array]) -> float:
        """Half the squared whitened residual."""
        error = self._whitener @ se2.log(se2.between(self._mean, values[0]))
        return 0.5 * float(error @ error)


class VectorPriorFactor:
    """A Gaussian prior of a vector: ``mean`` (P,), and standard deviations (P,) or a covariance (P, P)."""

    def __init__(self, mean: Array, spread: Array) -> None:
        self._mean = mean
        self._whitener = np.diag(1.0 / spread) if spread.ndim == 1 else positive.whitener(spread)

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Whitened residual (P,) and its Jacobian."""
        return self._whitener @ (values[0] - self._mean), [self._whitener]

    def cost(self, values: Sequence[Array]) -> float:
        """Half the squared whitened residual."""
        return 0.5 * float(np.sum((self._whitener @ (values[0] - self._mean)) ** 2))


def _check(residual: Array, blocks: Sequence[Array], rows: int, dimensions: Sequence[int]) -> None:
    if residual.shape != (rows,) or [b.shape for b in blocks] != [(rows, d) for d in dimensions]:
        raise ValueError(f"shapes {residual.shape}, {[b.shape for b in blocks]}, expected {rows} rows")
    # the sum is not finite if any value is not
    if not math.isfinite(float(residual.sum()) + sum(float(b.sum()) for b in blocks)):
        raise ValueError("a residual or Jacobian is not finite")
