"""Conversion of this package's factors to GTSAM's.

A factor has ``linearize(values)``, whose values are arrays: poses (3,), vectors (P,). It returns the whitened, robustly weighted
residual and one Jacobian per variable, by body-frame perturbation. GTSAM gets it as a linear factor: callbacks would copy all
variables, and an exception in a callback leaves iSAM2 in an inconsistent state.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import lru_cache
from typing import Any, Protocol, runtime_checkable

import gtsam
import numpy as np

from factors import positive, se2
from factors.se2 import Array, Integers

MOST_TERMS = 3  # that a `gtsam.JacobianFactor` takes in Python; a conditional is one, and takes any number


class Factor(Protocol):
    """A factor that :func:`jacobian_factor` accepts."""

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Whitened, weighted residual (m,) and a Jacobian (m, d) for each variable."""

    def cost(self, values: Sequence[Array]) -> float:
        """The loss, robust if the factor is."""


class Stack(Protocol):
    """Factors of one kind on N poses in a row and on P parameters that all have in common, linearised by one call."""

    rows: int

    @property
    def first(self) -> Integers:
        """The number (M,) of the first pose that each of the ``rows`` residuals depends on."""

    def linearize(self, poses: Array, parameters: Array, jacobian: Array, residual: Array) -> None:
        """Fill ``residual`` (M,) and ``jacobian`` (M, 6 + P), see :mod:`factors.chain`, at ``poses`` (N, 3) and ``parameters``."""

    def cost(self, poses: Array, parameters: Array) -> float:
        """The loss of all."""


class Alike(Factor, Protocol):
    """A factor of which many are linearised by one call."""

    @property
    def alike(self) -> Hashable:
        """What those have in common that are linearised together."""

    @staticmethod
    def linearize_all(factors: Sequence[Any], values: Sequence[Sequence[Array]]) -> tuple[Array, list[Array]]:
        """Residuals (N, m) of N factors, and a Jacobian (N, m, d) for each of their variables."""


@runtime_checkable
class Stackable(Factor, Protocol):
    """A factor on one pose or on two that follow one another, and perhaps on one vector, many of which become a stack."""

    @property
    def kind(self) -> Hashable:
        """What those that go into one stack have in common beside their type and their vector; None for one that goes into none."""

    def stack(self, factors: Sequence[Any], numbers: Sequence[int], column: int) -> Stack:
        """``factors`` of this type and kind as one, each on the pose with its number; ``column``: of the vector among the
        parameters."""


def pose_array(pose: gtsam.Pose2) -> Array:
    """A ``gtsam.Pose2`` as (x, y, heading)."""
    return np.array((pose.x(), pose.y(), pose.theta()))


def silenced(factor: Factor, rows: int, on_failure: Callable[[str], None]) -> Factor:
    """``factor`` with ``rows`` residuals; a residual or Jacobian that is not finite or has a wrong shape is replaced by zeros and
    reported to ``on_failure``. One of :class:`Alike` ones is taken as it is."""
    return factor if hasattr(factor, "alike") else _Silenced(factor, rows, on_failure)


def jacobian_factor(factor: Factor, keys: Sequence[int], values: Sequence[Array]) -> gtsam.GaussianFactor:
    """``factor`` linearised at ``values``."""
    return gaussian_factor(keys, *factor.linearize(values))


def jacobian_factors(
    factors: Sequence[tuple[Factor, Sequence[int]]], values: Mapping[int, Array]
) -> list[gtsam.GaussianFactor]:
    """Factors, each with the keys of its variables, linearised at ``values``; those that are alike together."""
    out: list[Any] = [None] * len(factors)
    alike: defaultdict[Hashable, list[int]] = defaultdict(list)
    for i, (factor, keys) in enumerate(factors):
        if hasattr(factor, "alike"):
            alike[factor.alike].append(i)
        else:
            out[i] = jacobian_factor(factor, keys, [values[key] for key in keys])
    for numbers in alike.values():
        some = [factors[i] for i in numbers]
        first: Any = some[0][0]
        residuals, blocks = first.linearize_all(
            [f for f, _ in some], [[values[key] for key in keys] for _, keys in some]
        )
        for i, (_, keys), residual, *parts in zip(numbers, some, residuals, *blocks, strict=True):
            out[i] = gaussian_factor(keys, residual, parts)
    return out


def gaussian_factor(keys: Sequence[int], residual: Array, blocks: Sequence[Array]) -> gtsam.GaussianFactor:
    """A linear factor from the whitened ``residual`` (m,) and a Jacobian (m, d) for each of its variables."""
    unit = _unit(len(residual))
    if len(blocks) > MOST_TERMS:
        return gtsam.GaussianConditional(list(zip(keys, blocks, strict=True)), 1, -residual, unit)
    arguments: list[Any] = [part for pair in zip(keys, blocks, strict=True) for part in pair]
    arguments += [-residual, unit]
    return gtsam.JacobianFactor(*arguments)


@lru_cache(maxsize=256)
def _unit(size: int) -> gtsam.noiseModel.Unit:
    return gtsam.noiseModel.Unit.Create(size)


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


class _Silenced:
    def __init__(self, factor: Factor, rows: int, on_failure: Callable[[str], None]) -> None:
        self._factor, self._rows, self._on_failure = factor, rows, on_failure
        self.cost = factor.cost

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        try:
            residual, blocks = self._factor.linearize(values)
            _check(residual, blocks, self._rows, values)
        except (ValueError, FloatingPointError, np.linalg.LinAlgError) as failure:
            self._on_failure(str(failure))
            return np.zeros(self._rows), [np.zeros((self._rows, len(value))) for value in values]
        return residual, blocks


def _check(residual: Array, blocks: Sequence[Array], rows: int, values: Sequence[Array]) -> None:
    if residual.shape != (rows,) or [b.shape for b in blocks] != [(rows, len(value)) for value in values]:
        raise ValueError(f"shapes {residual.shape}, {[b.shape for b in blocks]}, expected {rows} rows")
    # a product with zeros is not a number if any value is not finite
    if not math.isfinite(sum([np.vdot(part, _zeros(part.size)) for part in (residual, *blocks)])):
        raise ValueError("a residual or Jacobian is not finite")


@lru_cache(maxsize=256)
def _zeros(size: int) -> Array:
    return np.zeros(size)
