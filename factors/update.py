"""The robust, iterated Kalman update in information form.

Robust, because an outlier must neither dominate nor be rejected by a wrong prediction. Pixels of known points, which are many and
frequent, have a compiled version (:mod:`factors.camera.update_kernels`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from factors import positive, se2
from factors.camera import update_kernels as pixel_kernels
from factors.camera.factor import ReprojectionFactor
from factors.landmarks import update_kernels as landmark_kernels
from factors.landmarks.factor import BearingRangeFactor
from factors.landmarks.model import packed
from factors.se2 import Array

CONVERGED = 1e-6  # m and rad; convergence limit of an iterated update
TILT = 2  # roll and pitch, which all points of an image have in common
GATE = 9.21  # 99 % of chi-square with two degrees of freedom
GATES = {1: 6.63, 2: GATE, 3: 11.34}  # by degrees of freedom


class SightingFactor(Protocol):
    """A factor of K sightings with g coordinates each, such as :class:`~factors.landmarks.factor.BearingRangeFactor`."""

    def whitened(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Whitened residual (K, g) and its Jacobian (K, g, d) by each value."""

    def weight(self, squared: Array) -> Array:
        """The robust weight of squared whitened residuals."""

    def dof(self) -> int:
        """Number of measured coordinates."""


@dataclass(frozen=True)
class Correction:
    """The correction of a Gaussian by an observation: ``delta`` (S,) of the error state, and its ``covariance`` (S, S) afterwards.

    At the prediction: the whitened ``residual`` (K, g), predicted minus measured, and its normalised square (``nis``) with degrees
    of freedom. For a likelihood without residuals: the excess of its negative logarithm over the expected value (``excess_nll``),
    the ``variance`` of that, and the ``evidence``, its log-probability by Laplace's method, None where it was not computed.
    """

    delta: Array
    covariance: Array
    residual: Array
    nis: float
    dof: int
    excess_nll: float = 0.0
    variance: float = 0.0
    evidence: float | None = None


def robust_update(
    factor: ReprojectionFactor, pose: Array, covariance: Array, iterations: int, converged: float = CONVERGED
) -> Correction:
    """Kalman update of ``pose`` (3,) and correlated states by points in an image, as a factor on the pose only; see
    :func:`update_state`.

    ``covariance`` (S, S): of the error state, whose first three components are the pose's body-frame perturbation.
    """
    arrays = np.ascontiguousarray(pose, dtype=float), np.ascontiguousarray(covariance, dtype=float)
    try:
        found = Correction(*pixel_kernels.updated(factor.packed(), *arrays, iterations, converged, GATE), factor.dof())
        _require_sound(found.delta, found.covariance)
    except np.linalg.LinAlgError:
        return image_update(factor, pose, covariance, (), (), iterations, converged)
    return found


def image_update(
    factor: ReprojectionFactor,
    pose: Array,
    covariance: Array,
    values: Sequence[Array],
    columns: Sequence[slice],
    iterations: int,
    converged: float = CONVERGED,
) -> Correction:
    """:func:`robust_update` by a factor on other ``values`` too, whose ``columns`` in the error state are given. The covariance is
    that of perturbations of the updated pose: pixels are so much better than a survey that it matters."""
    size = len(covariance)

    def linearize(delta: Array) -> tuple[Array, Array]:
        at = [v + delta[column] for v, column in zip(values, columns, strict=True)]
        residual, blocks = factor.whitened([se2.compose(pose, se2.exp(delta[:3])), *at])
        jacobian = np.zeros((*residual.shape, len(delta)))
        for column, block in zip((slice(3), *columns, slice(size, None)), blocks, strict=True):
            jacobian[..., column] = block
        jacobian[..., :3] = jacobian[..., :3] @ se2.right_jacobian(delta[:3])
        return residual + blocks[-1] @ delta[size:], jacobian

    found = update_state(linearize, covariance, factor.weight, iterations, factor.dof(), converged, TILT)
    reset = np.eye(size)
    reset[:3, :3] = se2.right_jacobian(found.delta[:3])
    return replace(found, covariance=reset @ found.covariance @ reset.T)


def landmark_update(
    factor: BearingRangeFactor,
    pose: Array,
    covariance: Array,
    constants: Array,
    first: int,
    iterations: int,
    converged: float = CONVERGED,
) -> Correction | None:
    """:func:`update_state` by landmarks of a map, compiled; None for others, and where the information form has not the digits.
    ``constants`` (P,): those that are estimated, whose columns begin at ``first``."""
    if factor.free:
        return None
    before = np.ascontiguousarray(covariance)  # for each other order in memory it would be compiled anew
    known = packed(factor.model), factor.look, pose, before, constants, factor.places, first
    there, delta, after, residual, nis, dof = landmark_kernels.updated(*known, iterations, converged, GATE)
    return Correction(delta, after, residual, nis, dof) if there else None


def update_state(
    linearize: Callable[[Array], tuple[Array, Array]],
    covariance: Array,
    weight: Callable[[Array], Array],
    iterations: int,
    dof: int,
    converged: float = CONVERGED,
    common: int = 0,
) -> Correction:
    """Robust, iterated Kalman update in information form, or in square-root form if that is numerically insufficient.

    ``covariance`` (S, S): of the error state. ``linearize(delta)``: whitened residual (K, g) and Jacobian (K, g, D) by the first D
    components of the error state, at the correction ``delta`` (S,). ``weight``: the weight (K,) of squared residuals (K,), robust
    and tempered; at zero it is the tempering, which the innovation excludes. In the first iteration a sighting whose normalised
    innovation squared is outside the gate has its noise multiplied by the squared excess, which reduces its influence without
    locking the filter out. Further iterations divide the noise by the weight at the updated state (iteratively reweighted least
    squares), until a step is below ``converged``. ``common``: errors that all sightings have in common, unit Gaussians that follow
    the error state as ``linearize`` gets it.
    """
    size, priors = len(covariance), [covariance]
    if common:  # where the sightings are tempered, so are these
        priors = [np.eye(size + common), np.eye(size + common) / weight(np.zeros(1))[0]]
        for prior in priors:
            prior[:size, :size] = covariance
    iterated = priors[0], weight, iterations, dof, converged
    try:
        solve = [_informed(np.asarray(np.linalg.inv(prior))) for prior in priors]
        found = _iterated(solve[0], solve[-1], linearize, *iterated)
        _require_sound(found.delta, found.covariance)
    except np.linalg.LinAlgError:
        solve = [_rooted(positive.root(prior)) for prior in priors]
        found = _iterated(solve[0], solve[-1], linearize, *iterated)
    return replace(found, delta=found.delta[:size], covariance=found.covariance[:size, :size])


# Correction (S,) and covariance (S, S) from a Jacobian (K, g, D), residuals (K, g), their weights (K,), and the correction (D,) at
# which they are linearised.
_Solver = Callable[[Array, Array, Array, Array], tuple[Array, Array]]


def _iterated(
    first_solve: _Solver,
    solve: _Solver,
    linearize: Callable[[Array], tuple[Array, Array]],
    covariance: Array,
    weight: Callable[[Array], Array],
    iterations: int,
    dof: int,
    converged: float,
) -> Correction:
    zero = np.zeros(len(covariance))
    residual, blocks = linearize(zero)
    size = blocks.shape[2]
    widening = np.maximum(1.0, _each(residual, blocks, covariance[:size, :size]) / GATES[blocks.shape[1]])
    delta, updated = first_solve(blocks, residual, np.ones(len(residual)), zero[:size])
    # by the matrix inversion lemma
    pull = np.einsum("kij,ki->j", blocks, residual)
    nis = max(0.0, float(np.vdot(residual, residual) - pull @ updated[:size, :size] @ pull))
    tempering = weight(np.zeros(1))[0]
    if widening.max() > 1.0 or tempering < 1.0:
        delta, updated = solve(blocks, residual, tempering * widening**-2, zero[:size])
    first, before = residual, zero
    for _ in range(iterations - 1):
        if np.abs(delta - before).max() < converged:
            break
        before = delta
        residual, blocks = linearize(delta)
        weights = weight(np.einsum("ki,ki->k", residual, residual))
        delta, updated = solve(blocks, residual, weights, delta[:size])
    return Correction(delta, (updated + updated.T) / 2.0, first, nis, dof)


def _informed(prior: Array) -> _Solver:
    """A solver with the ``prior`` information (S, S)."""

    def solve(blocks: Array, residual: Array, weight: Array, at: Array) -> tuple[Array, Array]:
        size = len(at)
        jacobian = blocks.reshape(-1, size)
        weighted = jacobian.T * np.repeat(weight, blocks.shape[1])
        information = prior.copy()
        information[:size, :size] += weighted @ jacobian
        updated = np.asarray(np.linalg.inv(information), dtype=float)
        return updated[:, :size] @ (weighted @ (jacobian @ at - residual.ravel())), updated

    return solve


def _rooted(root: Array) -> _Solver:
    """A solver with the lower ``root`` (S, S) of the prior covariance, whose result is always positive definite."""

    def solve(blocks: Array, residual: Array, weight: Array, at: Array) -> tuple[Array, Array]:
        size, scale = len(at), np.sqrt(np.repeat(weight, blocks.shape[1]))
        jacobian = scale[:, None] * blocks.reshape(-1, size)
        upper = np.asarray(
            np.linalg.qr(np.concatenate((jacobian @ root[:size], np.eye(len(root)))), mode="r"), dtype=float
        )
        half = np.linalg.solve(upper.T, root.T).T
        wanted = jacobian @ at - scale * residual.ravel()
        return half @ ((jacobian @ half[:size]).T @ wanted), half @ half.T

    return solve


def _require_sound(delta: Array, covariance: Array) -> None:
    """LinAlgError if the update is invalid because of rounding."""
    np.linalg.cholesky(covariance)
    if not np.all(np.isfinite(delta)):
        raise np.linalg.LinAlgError("an update is not finite")


def _each(residual: Array, blocks: Array, covariance: Array) -> Array:
    """Normalised innovation squared (K,) of each sighting."""
    s = blocks @ covariance @ blocks.transpose(0, 2, 1)
    if s.shape[1] != 2:
        return np.asarray(positive.squared(residual, np.eye(s.shape[1]) + s))
    a, b, c = s[:, 0, 0] + 1.0, s[:, 0, 1], s[:, 1, 1] + 1.0
    x, y = residual[:, 0], residual[:, 1]
    # rounding may cancel the difference completely, which is never less than that
    determinant = np.maximum(a * c - b * b, 0.5 * (a + c))
    return np.asarray((c * x * x - 2.0 * b * x * y + a * y * y) / determinant)
