"""The Kalman update of all estimators by what is seen of landmarks and points: robust and iterated, in information form.

A factor of sightings tells of K of them two coordinates each; one that is wrong must neither pull far nor be dropped by a
prediction that is wrong itself. Of pixels of known points, which come often and in numbers, the same is done by compiled code
(:mod:`factors.pixel_kernels`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from factors import pixel_kernels, se2
from factors.reprojection_factor import ReprojectionFactor
from factors.se2 import Array

CONVERGED = 1e-6  # of an iterated update, m and rad
GATE = 9.21  # 99 % of chi-square with two degrees of freedom


class Sightings(Protocol):
    """A factor of sightings: :class:`~factors.bearing_range_factor.BearingRangeFactor` and
    :class:`~factors.reprojection_factor.ReprojectionFactor`."""

    def whitened(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Whitened residual (K, 2) and its Jacobian (K, 2, d) by each value."""

    def weight(self, squared: Array) -> Array:
        """The robust weight of squared whitened residuals."""

    def dof(self) -> int:
        """How many coordinates are measured."""


@dataclass(frozen=True)
class Update:
    """What a Kalman update gives: ``delta`` (S,) of the error state, its ``covariance`` (S, S) afterwards, and at the prediction
    the whitened ``residual`` (K, 2), predicted less measured, and its normalised square (``nis``) with degrees of freedom."""

    delta: Array
    covariance: Array
    residual: Array
    nis: float
    dof: int


def robust_update(
    factor: Sightings, pose: Array, covariance: Array, iterations: int, converged: float = CONVERGED
) -> Update:
    """Kalman update of ``pose`` (3,) and further states by a factor on the pose alone; see :func:`update_state`.

    ``covariance`` (S, S): of the error state, whose first three components are the pose's body-frame perturbation.
    """
    if isinstance(factor, ReprojectionFactor) and factor.of_pose_alone:
        arrays = np.ascontiguousarray(pose, dtype=float), np.ascontiguousarray(covariance, dtype=float)
        found = pixel_kernels.updated(factor.packed(), *arrays, iterations, converged, GATE)
        return Update(*found, factor.dof())
    return linearized_update(factor, pose, covariance, iterations, converged)


def linearized_update(
    factor: Sightings, pose: Array, covariance: Array, iterations: int, converged: float = CONVERGED
) -> Update:
    """:func:`robust_update` by a factor of any kind."""

    def linearize(delta: Array) -> tuple[Array, Array]:
        residual, (block,) = factor.whitened([se2.compose(pose, se2.exp(delta[:3]))])
        return residual, block

    return update_state(linearize, covariance, factor.weight, iterations, factor.dof(), converged)


def update_state(
    linearize: Callable[[Array], tuple[Array, Array]],
    covariance: Array,
    weight: Callable[[Array], Array],
    iterations: int,
    dof: int,
    converged: float = CONVERGED,
) -> Update:
    """Kalman update, robust and iterated, in information form.

    ``covariance`` (S, S): of the error state. ``linearize(delta)``: whitened residual (K, 2) and Jacobian (K, 2, D) by the
    first D components of the error state, with the state moved by ``delta`` (S,). ``weight``: the weight (K,) of squared
    residuals (K,), robust and tempered: that of zero is the tempering, which the innovation is free of. At first a sighting
    whose normalised innovation squared lies beyond the gate has its noise widened by the square of the excess, so that it
    pulls the less the farther off it is, but never locks the filter out. Further iterations widen it by the inverse of its
    weight at the updated state (iteratively reweighted least squares), until a step is below ``converged``.
    """
    prior = np.asarray(np.linalg.inv(covariance), dtype=float)
    zero = np.zeros(len(covariance))
    residual, blocks = linearize(zero)
    size = blocks.shape[2]
    widening = np.maximum(1.0, _each(residual, blocks, covariance[:size, :size]) / GATE)
    delta, updated = _solve(prior, blocks, residual, np.ones(len(residual)), zero[:size])
    # by the matrix inversion lemma
    pull = np.einsum("kij,ki->j", blocks, residual)
    nis = float(np.vdot(residual, residual) - pull @ updated[:size, :size] @ pull)
    tempering = weight(np.zeros(1))[0]
    if widening.max() > 1.0 or tempering < 1.0:
        delta, updated = _solve(prior, blocks, residual, tempering * widening**-2, zero[:size])
    first, before = residual, zero
    for _ in range(iterations - 1):
        if np.abs(delta - before).max() < converged:
            break
        before = delta
        residual, blocks = linearize(delta)
        weights = weight(np.einsum("ki,ki->k", residual, residual))
        delta, updated = _solve(prior, blocks, residual, weights, delta[:size])
    return Update(delta, (updated + updated.T) / 2.0, first, nis, dof)


def _solve(prior: Array, blocks: Array, residual: Array, weight: Array, at: Array) -> tuple[Array, Array]:
    """Correction (S,) and covariance (S, S) from weighted residuals (K, 2) linearised at the correction ``at`` (D,)."""
    size = len(at)
    jacobian = blocks.reshape(-1, size)
    weighted = jacobian.T * np.repeat(weight, 2)
    information = prior.copy()
    information[:size, :size] += weighted @ jacobian
    updated = np.asarray(np.linalg.inv(information), dtype=float)
    return updated[:, :size] @ (weighted @ (jacobian @ at - residual.ravel())), updated


def _each(residual: Array, blocks: Array, covariance: Array) -> Array:
    """Normalised innovation squared (K,) of each landmark by itself."""
    s = blocks @ covariance @ blocks.transpose(0, 2, 1)
    a, b, c = s[:, 0, 0] + 1.0, s[:, 0, 1], s[:, 1, 1] + 1.0
    x, y = residual[:, 0], residual[:, 1]
    return np.asarray((c * x * x - 2.0 * b * x * y + a * y * y) / (a * c - b * b))
