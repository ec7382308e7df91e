"""Operations on covariances that may be numerically singular.

A covariance whose components have very different scales may be singular in floating point, although its correlation
matrix is well conditioned. Eigenvalues of the correlation matrix below :data:`LEAST` are rounding errors, and are
raised to :data:`LEAST`. Well-conditioned covariances are used unchanged.
"""

from __future__ import annotations

import math

import numpy as np

from factors import gaussian
from factors.compiled import compiled
from factors.se2 import Array

LEAST = 1e-12  # minimum eigenvalue of an invertible correlation matrix
CLEAR = 1e-9  # a correlation matrix with a larger determinant is certainly invertible
SKEW = 1e-6  # largest asymmetry of a correlation matrix that counts as a rounding error


def nearest(covariances: Array) -> Array:
    """Return the symmetric, invertible matrices (..., D, D) that are nearest to ``covariances`` (..., D, D). Raises
    LinAlgError if a variance is not positive, or if an element is not finite."""
    sigmas, values, vectors = _parts(covariances)
    shares = (vectors * values[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    shares = (shares + np.swapaxes(shares, -1, -2)) / 2.0
    return np.asarray(shares * sigmas[..., :, None] * sigmas[..., None, :])


def sound(covariance: Array) -> Array:
    """Return the covariance (D, D) if it is numerically invertible, otherwise the :func:`nearest` invertible one."""
    if is_clear(covariance):
        return covariance
    sigmas = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    if not np.all(sigmas > 0.0):
        return nearest(covariance)
    shares = covariance / sigmas[:, None] / sigmas
    return covariance if np.linalg.eigvalsh(shares)[0] > LEAST else nearest(covariance)


@compiled(error_model="numpy")
def is_clear(covariance: Array) -> bool:
    """True if a covariance (D, D) is finite, symmetric and far from singular. It is a fast test. If it is False,
    :func:`sound` decides whether the covariance is invertible."""
    size, shares = len(covariance), np.empty(covariance.shape)
    for i in range(size):
        if not 0.0 < covariance[i, i] < np.inf:
            return False
        for j in range(i + 1):
            shares[i, j] = covariance[i, j] / math.sqrt(covariance[i, i]) / math.sqrt(covariance[j, j])
            skew = shares[i, j] - covariance[j, i] / math.sqrt(covariance[i, i]) / math.sqrt(covariance[j, j])
            if not abs(skew) <= SKEW:
                return False
    lower, exists = gaussian.cholesky(shares)
    determinant = 1.0
    for i in range(size):
        determinant *= lower[i, i] * lower[i, i]
    # the smallest eigenvalue of a correlation matrix exceeds its determinant / e, and is therefore far above LEAST
    return exists and determinant > CLEAR


def whitener(covariances: Array) -> Array:
    """Return matrices W (..., D, D) that whiten errors with these covariances (..., D, D): ``W covariance W^T`` is the
    identity. If a covariance is not positive definite, its small eigenvalues are raised first."""
    try:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariances)))
    except np.linalg.LinAlgError:
        return _whitener(covariances)


def root(covariances: Array) -> Array:
    """Return lower Cholesky factors (..., D, D) of ``covariances``, or of the :func:`nearest` ones if none exist."""
    try:
        return np.asarray(np.linalg.cholesky(covariances))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.cholesky(nearest(covariances)))


def solve(covariances: Array, right: Array) -> Array:
    """Return the solution x (..., D, N) of ``covariances @ x = right``. ``covariances``: (..., D, D)."""
    try:
        return np.asarray(np.linalg.solve(covariances, right))
    except np.linalg.LinAlgError:
        whitened = _whitener(covariances)
        return np.asarray(np.swapaxes(whitened, -1, -2) @ (whitened @ right))


def inverse(covariances: Array) -> Array:
    """Return the inverses of covariances (..., D, D). Small eigenvalues of a singular covariance are raised first."""
    try:
        inverses = np.asarray(np.linalg.inv(covariances), dtype=float)
        if np.all(np.diagonal(inverses, axis1=-2, axis2=-1) > 0.0):
            return inverses
    except np.linalg.LinAlgError:
        pass
    root = _whitener(covariances)
    return np.asarray(np.swapaxes(root, -1, -2) @ root)


def squared(errors: Array, covariances: Array) -> Array:
    """Return the squared Mahalanobis distances (...) of ``errors`` (..., D) with covariances (..., D, D)."""
    return np.asarray(np.sum(errors * solve(covariances, errors[..., None])[..., 0], axis=-1))


def smoothed(covariance: Array, transition: Array, noise: Array, change: Array, later: Array) -> tuple[Array, Array]:
    """Return the correction (S,) of a state and its smoothed covariance (S, S), as :func:`factors.gaussian.smoothed`
    does with the same arguments, also for nearly singular covariances. If that function fails, the smoothed covariance
    is computed in Joseph's form, which is positive semi-definite for any gain."""
    arrays = (np.ascontiguousarray(part, dtype=float) for part in (covariance, transition, noise, change, later))
    try:
        correction, smoothed_covariance = gaussian.smoothed(*arrays)
        return correction, smoothed_covariance
    except np.linalg.LinAlgError:
        rows, full, later = len(transition), np.eye(len(change)), later.copy()
    full[:rows] = transition
    later[:rows, :rows] += noise
    predicted = full @ covariance @ full.T
    predicted[:rows, :rows] += noise
    gain = solve(nearest(predicted), full @ covariance).T
    left = np.eye(len(change)) - gain @ full
    return gain @ change, nearest(left @ covariance @ left.T + gain @ later @ gain.T)


def worst_sigma(covariances: Array) -> Array:
    """Return the largest standard deviation (...), over all directions, of each of ``covariances`` (..., D, D)."""
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(covariances)[..., -1], 0.0)))


def draws(covariance: Array, count: int, rng: np.random.Generator) -> Array:
    """Return ``count`` samples (count, D) of a zero-mean Gaussian, drawn by ``rng``. ``covariance`` may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(rng.standard_normal((count, len(values))) @ root.T)


def _whitener(covariances: Array) -> Array:
    """Return the result of :func:`whitener`. Eigenvalues of correlation matrices below :data:`LEAST` are raised."""
    sigmas, values, vectors = _parts(covariances)
    return np.asarray(np.swapaxes(vectors / np.sqrt(values)[..., None, :], -1, -2) / sigmas[..., None, :])


def _parts(covariances: Array) -> tuple[Array, Array, Array]:
    """Decompose covariances (..., D, D). Returns the standard deviations (..., D), and the eigenvalues (..., D), raised
    to at least :data:`LEAST`, and eigenvectors (..., D, D) of the correlation matrices."""
    variances = np.diagonal(covariances, axis1=-2, axis2=-1)
    if not (np.all(np.isfinite(covariances)) and np.all(variances > 0.0)):
        raise np.linalg.LinAlgError("a covariance is not finite, or has a variance that is not positive")
    sigmas = np.sqrt(variances)
    # two divisions, because the product of the standard deviations may overflow
    shares = covariances / sigmas[..., :, None] / sigmas[..., None, :]
    values, vectors = np.linalg.eigh((shares + np.swapaxes(shares, -1, -2)) / 2.0)
    return sigmas, np.maximum(values, LEAST), vectors
