"""The correction of a Gaussian by residuals: the robust, iterated Kalman update in information form.

Robust, because an outlier must neither dominate nor be rejected by a wrong prediction. Landmarks of a map have a compiled version
(:mod:`factors.landmarks.kernels`), because an EKF updates so often that calls of NumPy would take most of its time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from factors import positive
from factors.compiled import compiled
from factors.gaussian import invert_covariance
from factors.se2 import Array, Integers

CONVERGED = 1e-6  # m and rad; convergence limit of an iterated update
GATE = 9.21  # 99 % of chi-square with two degrees of freedom
GATES = {1: 6.63, 2: GATE, 3: 11.34}  # by degrees of freedom


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
    if common:  # they are tempered like the sightings
        tempering = weight(np.zeros(1))[0]
        priors = [np.eye(size + common) / share for share in sorted({1.0, tempering}, reverse=True)]
        for prior in priors:
            prior[:size, :size] = covariance
    iterated = priors[0], weight, iterations, dof, converged
    try:
        solve = [_informed(np.asarray(np.linalg.inv(prior))) for prior in priors]
        correction = _iterated(solve[0], solve[-1], linearize, *iterated)
        np.linalg.cholesky(correction.covariance)  # LinAlgError if it is invalid because of rounding
        if not np.all(np.isfinite(correction.delta)):
            raise np.linalg.LinAlgError("an update is not finite")
    except np.linalg.LinAlgError:
        solve = [_rooted(positive.root(prior)) for prior in priors]
        correction = _iterated(solve[0], solve[-1], linearize, *iterated)
    return replace(correction, delta=correction.delta[:size], covariance=correction.covariance[:size, :size])


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
    residual, blocks = map(np.ascontiguousarray, linearize(zero))  # other memory orders would compile the code again
    size = blocks.shape[2]
    squared = normalised(residual, blocks, np.arange(size), np.ascontiguousarray(covariance))
    widening = np.maximum(1.0, squared / GATES[blocks.shape[1]])
    delta, updated = first_solve(blocks, residual, np.ones(len(residual)), zero[:size])
    # by the matrix inversion lemma
    pull = np.einsum("kij,ki->j", blocks, residual)
    nis = max(0.0, float(np.vdot(residual, residual) - pull @ updated[:size, :size] @ pull))
    tempering = weight(np.zeros(1))[0]
    if widening.max() > 1.0 or tempering < 1.0:
        delta, updated = solve(blocks, residual, tempering * widening**-2, zero[:size])
    first, previous = residual, zero
    for _ in range(iterations - 1):
        if np.abs(delta - previous).max() < converged:
            break
        previous = delta
        residual, blocks = map(np.ascontiguousarray, linearize(delta))
        weights = weight(np.einsum("ki,ki->k", residual, residual))
        delta, updated = solve(blocks, residual, weights, delta[:size])
    return Correction(delta, (updated + updated.T) / 2.0, first, nis, dof)


def _informed(prior: Array) -> _Solver:
    """A solver with the ``prior`` information (S, S)."""

    def solve(blocks: Array, residual: Array, weight: Array, at: Array) -> tuple[Array, Array]:
        information = prior.copy()
        pull = inform(residual, blocks, np.arange(len(at)), weight, at, information)
        updated = np.asarray(np.linalg.inv(information), dtype=float)
        return updated[:, : len(at)] @ pull, updated

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


@compiled(error_model="numpy")
def inform(residual: Array, jacobian: Array, columns: Integers, weights: Array, at: Array, total: Array) -> Array:
    """Add the information of K residuals to ``total`` (S, S), and return the vector (D,) that the correction solves for.

    ``residual`` (K, g) and ``jacobian`` (K, g, D): linearised at the correction ``at`` (S,); ``columns`` (D,): those of the
    Jacobian in the error state; ``weights`` (K,). The correction is the inverse of the information times this vector.
    """
    wide = len(columns)
    pull = np.zeros(wide)
    for k in range(len(residual)):
        for i in range(residual.shape[1]):
            row = jacobian[k, i]
            wanted = -residual[k, i]
            for a in range(wide):
                wanted += row[a] * at[columns[a]]
            for a in range(wide):
                weighted = weights[k] * row[a]
                if weighted != 0.0:
                    pull[a] += weighted * wanted
                    for b in range(wide):
                        total[columns[a], columns[b]] += weighted * row[b]
    return pull


@compiled(error_model="numpy")
def corrected(
    prior: Array, residual: Array, jacobian: Array, columns: Integers, weights: Array, at: Array
) -> tuple[Array, Array, Array]:
    """The correction (S,), the covariance (S, S) after it, and the vector (D,) of :func:`inform`.

    ``prior`` (S, S): the information of the prediction; the other arguments are those of :func:`inform`. LinAlgError if there is no
    solution.
    """
    total = prior.copy()
    pull = inform(residual, jacobian, columns, weights, at, total)
    posterior, delta = invert_covariance(total), np.zeros(len(prior))
    for i in range(len(prior)):
        for a in range(len(columns)):
            delta[i] += posterior[i, columns[a]] * pull[a]
    return delta, posterior, pull


@compiled(error_model="numpy")
def normalised(residual: Array, jacobian: Array, columns: Integers, covariance: Array) -> Array:
    """Normalised innovation squared (K,) of K independent whitened residuals (K, g) with Jacobians (K, g, D) by the
    ``columns`` (D,) of a state with this ``covariance`` (S, S)."""
    size, wide = residual.shape[1], len(columns)
    out, left, whitened = np.zeros(len(residual)), np.empty((size, size)), np.empty(size)
    for k in range(len(residual)):
        for i in range(size):
            whitened[i] = residual[k, i]
            for j in range(i + 1):
                element = 1.0 if i == j else 0.0
                for a in range(wide):
                    if jacobian[k, i, a] != 0.0:
                        carried = 0.0
                        for b in range(wide):
                            carried += covariance[columns[a], columns[b]] * jacobian[k, j, b]
                        element += jacobian[k, i, a] * carried
                for m in range(j):
                    element -= left[i, m] * left[j, m]
                # with unit noise a pivot is at least 1, whatever rounding leaves of it
                left[i, j] = math.sqrt(max(element, 0.5)) if i == j else element / left[j, j]
            for m in range(i):
                whitened[i] -= left[i, m] * whitened[m]
            whitened[i] /= left[i, i]
            out[k] += whitened[i] * whitened[i]
    return out
