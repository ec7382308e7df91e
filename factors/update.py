"""The correction of a Gaussian by residuals: a robust, iterated Kalman update in information form.

The update is robust because an outlier must not dominate it, and because a wrong prediction must not reject good
measurements. Landmarks of a map have a compiled version in :mod:`factors.landmarks.kernels`. Without it, calls of NumPy
take most of the time of an EKF.
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

CONVERGED = 1e-6  # m and rad; an iterated update ends when a step is smaller
GATE = 9.21  # 99 % quantile of chi-square with two degrees of freedom
GATES = {1: 6.63, 2: GATE, 3: 11.34}  # 99 % quantiles of chi-square by degrees of freedom


@dataclass(frozen=True)
class Correction:
    """The correction of a Gaussian error state (S,) by an observation.

    ``delta`` (S,): the correction of the error state. ``covariance`` (S, S): the covariance after the correction.
    ``residual`` (K, g): whitened residuals of K measured objects at the prediction, predicted minus measured.
    ``nis``: the normalised innovation squared. ``dof``: its degrees of freedom.

    The last three fields are for likelihoods without residuals, such as the likelihood of RFID reads. ``excess_nll``:
    the negative log-likelihood at the prediction minus its expected value. ``variance``: the variance of
    ``excess_nll``. ``evidence``: the marginal log-likelihood by Laplace's method, or None if it was not computed.
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
    """Correct a Gaussian by K sightings (measured objects with g coordinates), with a robust, iterated Kalman update.

    ``linearize(delta)``: returns the whitened residuals (K, g) at the correction ``delta`` (S,), and their Jacobian (K,
    g, D) by the first D components of the error state.
    ``covariance`` (S, S): covariance of the error state at the prediction.
    ``weight``: maps squared norms (K,) of whitened residuals to weights (K,). A weight is the robust weight times the
    tempering exponent of the likelihood, so that ``weight(0)`` is the tempering exponent.
    ``iterations``: maximum number of iterations. They end earlier when a step is below ``converged``.
    ``dof``: number of measured values, stored in the result.
    ``common``: number of errors that all sightings have in common. They are independent unit Gaussians. ``linearize``
    gets them after the S components of the error state.

    The first iteration linearises at the prediction. It multiplies the noise of an outlier by ``(nis / gate)^2``, with
    the 99 % gate of the normalised innovation squared. Further iterations divide the noise by the weight at the updated
    state (iteratively reweighted least squares).
    """
    size, priors = len(covariance), [covariance]
    if common:  # the variance of the common errors is divided by the tempering exponent, like that of the sightings
        tempering = weight(np.zeros(1))[0]
        priors = [np.eye(size + common) / share for share in sorted({1.0, tempering}, reverse=True)]
        for prior in priors:
            prior[:size, :size] = covariance
    iterated = priors[0], weight, iterations, dof, converged
    try:
        solve = [_informed(np.asarray(np.linalg.inv(prior))) for prior in priors]
        correction = _iterated(solve[0], solve[-1], linearize, *iterated)
        np.linalg.cholesky(correction.covariance)  # raises LinAlgError if rounding made the covariance invalid
        if not np.all(np.isfinite(correction.delta)):
            raise np.linalg.LinAlgError("an update is not finite")
    except np.linalg.LinAlgError:
        solve = [_rooted(positive.root(prior)) for prior in priors]
        correction = _iterated(solve[0], solve[-1], linearize, *iterated)
    return replace(correction, delta=correction.delta[:size], covariance=correction.covariance[:size, :size])


# Arguments of a solver: the Jacobian (K, g, D), the residuals (K, g), their weights (K,), and the correction (D,) at
# which they are linearised. Results: the new correction (S,) and the covariance (S, S).
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
    """Return the result of :func:`update_state`, which has the same last arguments. ``solve``: solves one linearised
    update. ``first_solve``: the same without the tempering exponent."""
    zero = np.zeros(len(covariance))
    # contiguous arrays, because numba would compile `normalised` and `inform` again for other memory layouts
    residual, blocks = map(np.ascontiguousarray, linearize(zero))
    size = blocks.shape[2]
    squared = normalised(residual, blocks, np.arange(size), np.ascontiguousarray(covariance))
    widening = np.maximum(1.0, squared / GATES[blocks.shape[1]])
    delta, updated = first_solve(blocks, residual, np.ones(len(residual)), zero[:size])
    # the normalised innovation squared by the matrix inversion lemma
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
    """Return a function that solves linearised updates in information form. ``prior`` (S, S): inverse covariance."""

    def solve(blocks: Array, residual: Array, weight: Array, at: Array) -> tuple[Array, Array]:
        information = prior.copy()
        pull = inform(residual, blocks, np.arange(len(at)), weight, at, information)
        updated = np.asarray(np.linalg.inv(information), dtype=float)
        return updated[:, : len(at)] @ pull, updated

    return solve


def _rooted(root: Array) -> _Solver:
    """Return a function that solves linearised updates in square-root form. Its covariances are always positive
    definite. ``root`` (S, S): lower Cholesky factor of the predicted covariance."""

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
    """Add the information of K sightings to ``total`` (S, S), and return their information vector (D,). A sighting is a
    measured object with g coordinates.

    ``residual`` (K, g), ``jacobian`` (K, g, D): whitened, linearised at the correction ``at`` (S,).
    ``columns`` (D,): the components of the error state that the columns of the Jacobian belong to.
    ``weights`` (K,): weights of the sightings.

    The correction is the inverse of the information matrix times the information vector.
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
    """Run one Kalman update by K measured objects, in information form.

    ``prior`` (S, S): the inverse covariance of the prediction. ``residual`` (K, g), ``jacobian`` (K, g, D): whitened,
    linearised at the correction ``at`` (S,). ``columns`` (D,): the components of the error state of the Jacobian's
    columns. ``weights`` (K,): weights of the objects. Returns the correction (S,), the covariance (S, S) after it, and
    the information vector (D,) of the residuals. Raises LinAlgError if the total information is not positive definite.
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
    """Return the normalised innovation squared (K,) of each of K measured objects. ``residual`` (K, g): the whitened
    residuals. ``jacobian`` (K, g, D): their Jacobian by the components ``columns`` (D,) of the error state.
    ``covariance`` (S, S): the covariance of the error state."""
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
                # a pivot is at least 1 because the noise is a unit matrix, but rounding may reduce it
                left[i, j] = math.sqrt(max(element, 0.5)) if i == j else element / left[j, j]
            for m in range(i):
                whitened[i] -= left[i, m] * whitened[m]
            whitened[i] /= left[i, i]
            out[k] += whitened[i] * whitened[i]
    return out
