"""Covariances that rounding has taken from being positive definite: what stands for them where they are inverted.

A matrix whose largest part is more than 1e16 times its smallest is singular as numbers go, although what it stands for is not. In
units of its own standard deviations that part is small for every covariance that means something; what is below :data:`LEAST`
there is a matter of rounding, and is raised to that. Covariances that need no help are taken as they are, to the last bit.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dpotrf

from factors.se2 import Array

LEAST = 1e-12  # the smallest eigenvalue of a correlation matrix that can be inverted
CLEAR = 1e-9  # a determinant of one


def nearest(covariances: Array) -> Array:
    """Covariances (..., D, D) that are symmetric and can be inverted, next to those given. LinAlgError where a variance is not
    above zero or not finite."""
    sigmas, values, vectors = _parts(covariances)
    shares = (vectors * values[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    shares = (shares + np.swapaxes(shares, -1, -2)) / 2.0
    return np.asarray(shares * sigmas[..., :, None] * sigmas[..., None, :])


def sound(covariance: Array) -> Array:
    """The covariance (D, D) itself where it can be inverted, else the :func:`nearest` that can."""
    sigmas = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    if not np.all(sigmas > 0.0):
        return nearest(covariance)
    shares = covariance / sigmas[:, None] / sigmas
    root, failed = dpotrf(shares, lower=1)
    # with such a determinant the smallest eigenvalue of a correlation matrix is far above the least: det < e * smallest
    if not failed and np.prod(root.diagonal()) ** 2 > CLEAR:
        return covariance
    return covariance if np.linalg.eigvalsh(shares)[0] > LEAST else nearest(covariance)


def whitener(covariances: Array) -> Array:
    """The inverses of the lower roots of covariances (..., D, D); of other roots, which whiten as well, where there are none."""
    try:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariances)))
    except np.linalg.LinAlgError:
        return _whitener(covariances)


def root(covariances: Array) -> Array:
    """The lower roots of covariances (..., D, D)."""
    try:
        return np.asarray(np.linalg.cholesky(covariances))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.cholesky(nearest(covariances)))


def solve(covariances: Array, right: Array) -> Array:
    """What covariances (..., D, D) must be multiplied with to give ``right`` (..., D, N)."""
    try:
        return np.asarray(np.linalg.solve(covariances, right))
    except np.linalg.LinAlgError:
        whitened = _whitener(covariances)
        return np.asarray(np.swapaxes(whitened, -1, -2) @ (whitened @ right))


def inverse(covariances: Array) -> Array:
    """The inverses of covariances (..., D, D)."""
    try:
        found = np.asarray(np.linalg.inv(covariances), dtype=float)
        if np.all(np.diagonal(found, axis1=-2, axis2=-1) > 0.0):
            return found
    except np.linalg.LinAlgError:
        pass
    root = _whitener(covariances)
    return np.asarray(np.swapaxes(root, -1, -2) @ root)


def squared(errors: Array, covariances: Array) -> Array:
    """Squared Mahalanobis distances (...) of ``errors`` (..., D) under covariances (..., D, D)."""
    try:
        return np.asarray(np.sum(errors * np.linalg.solve(covariances, errors[..., None])[..., 0], axis=-1))
    except np.linalg.LinAlgError:
        return np.asarray(np.sum((_whitener(covariances) @ errors[..., None])[..., 0] ** 2, axis=-1))


def draws(covariance: Array, count: int, rng: np.random.Generator) -> Array:
    """Draws (count, D) from a Gaussian of zero mean whose covariance (D, D) may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(rng.standard_normal((count, len(values))) @ root.T)


def _whitener(covariances: Array) -> Array:
    sigmas, values, vectors = _parts(covariances)
    return np.asarray(np.swapaxes(vectors / np.sqrt(values)[..., None, :], -1, -2) / sigmas[..., None, :])


def _parts(covariances: Array) -> tuple[Array, Array, Array]:
    """Standard deviations (..., D), and eigenvalues (..., D), raised, with eigenvectors (..., D, D) of the correlations."""
    variances = np.diagonal(covariances, axis1=-2, axis2=-1)
    if not (np.all(np.isfinite(covariances)) and np.all(variances > 0.0)):
        raise np.linalg.LinAlgError("a covariance is not finite, or not above zero")
    sigmas = np.sqrt(variances)
    # by parts, as products of the largest and the smallest may be beyond numbers
    shares = covariances / sigmas[..., :, None] / sigmas[..., None, :]
    values, vectors = np.linalg.eigh((shares + np.swapaxes(shares, -1, -2)) / 2.0)
    return sigmas, np.maximum(values, LEAST), vectors
