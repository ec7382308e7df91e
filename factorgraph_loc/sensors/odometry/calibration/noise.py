"""Maximum-likelihood estimation of the growth of odometry errors.

The covariance of relative motion is linear in the variances of :class:`factors.odometry.model.Growth`, so the noise is a sum of
non-negative variance components (Searle, Casella, McCulloch, "Variance Components", 1992, chapter 6). Windows of several
lengths separate growing errors from the constant ones of the reference.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.odometry.calibration.constants import Windows, cut
from factors import chi_squared
from factors.odometry.model import MINIMUM_HEADING_VARIANCE, MINIMUM_POSITION_VARIANCE, Growth, OdometryModel
from factors.se2 import Array

LENGTHS = (1.0, 3.0, 10.0)  # s
BLACKOUT = 30.0  # s
MIN_BLACKOUTS = 10
ERRORS = ("along", "lateral", "heading")
STUDENT = 5.0  # degrees of freedom of the robust initial fit
GATE = chi_squared.quantile(0.9999, 3)  # squared error above which a window is an outlier
_SMALLEST = 1e-8  # variance per unit below which a component is zero
# Lower bounds for wheels, by error and driver. A reference that depends on the odometry gives lower values.
FLOOR = np.array(((0.01, 0.0, 0.0), (0.005, 0.0, 0.0), (0.003, 0.005, 0.0)))


@dataclass(frozen=True)
class NoiseFit:
    """``growth`` by error; ``reference`` (2,): standard deviations of reference position [m] and heading [rad] at the ends of
    windows; ``outliers``: share of windows outside the gate; ``widened``: factor already included in the growth, because errors
    of wheels are correlated and grow faster than a random walk; ``floored``: errors raised to the lower bound."""

    growth: Mapping[str, Growth]
    reference: Array
    outliers: float
    widened: float
    floored: tuple[str, ...]


def with_noise(model: OdometryModel, growth: Mapping[str, Growth]) -> OdometryModel:
    """The model with a different noise, by error."""
    return replace(model, along=growth["along"], lateral=growth["lateral"], heading=growth["heading"])


def fit_noise(logs: Sequence[Log], model: OdometryModel) -> NoiseFit:
    """Fit the noise of the odometry ``model`` to the residuals of windows of several lengths with equal weight.

    First with a Student density, which is robust to outliers; then with a Gaussian density without outliers. Finally the noise is
    widened so that the median error over half a minute, the length of a blackout, is correct.
    """
    windows = [cut(log, length) for log in logs for length in LENGTHS]
    bases = np.concatenate([_bases(one, model) for one in windows])
    residuals = np.concatenate([one.residuals(model) for one in windows])
    lengths = np.concatenate([one.end - one.begin for one in windows])
    weights = lengths / lengths.mean()
    size = np.median(np.abs(residuals), axis=0) ** 2 / np.median(lengths)
    variances = np.concatenate([np.repeat(size, 3), (1e-6, 1e-6)])
    variances = _maximise(bases, residuals, weights, variances, STUDENT)
    for _ in range(2):
        inside = _squared(bases, residuals, variances)[0] < GATE
        variances = _maximise(bases[inside], residuals[inside], weights[inside], variances, None)
    outliers = float(np.mean(_squared(bases, residuals, variances)[0] >= GATE))
    sigmas = np.sqrt(np.where(variances[:9] > _SMALLEST, variances[:9], 0.0)).reshape(3, 3)
    floored = tuple(error for error, row, floor in zip(ERRORS, sigmas, FLOOR, strict=True) if np.all(row <= floor))
    sigmas = np.maximum(sigmas, FLOOR)
    widened = _widening(logs, with_noise(model, _growth(sigmas)))
    return NoiseFit(_growth(widened * sigmas), np.sqrt(variances[9:]), outliers, widened, floored)


def _widening(logs: Sequence[Log], model: OdometryModel) -> float:
    """Factor by which the errors over a blackout exceed the model; 1 if they do not or there are too few windows."""
    windows = [cut(log, BLACKOUT) for log in logs]
    residuals = np.concatenate([one.residuals(model) for one in windows])
    if len(residuals) < MIN_BLACKOUTS:
        return 1.0
    covariances = np.concatenate([one.covariances(model) for one in windows])
    squared = np.einsum("mi,mi->m", residuals, np.linalg.solve(covariances, residuals[..., None])[..., 0])
    return max(1.0, float(np.sqrt(np.median(squared) / chi_squared.quantile(0.5, 3))))


def _growth(sigmas: Array) -> dict[str, Growth]:
    """``sigmas`` (3, 3) of longitudinal, lateral and heading errors, by distance, rotation and time."""
    return {error: Growth(*row) for error, row in zip(ERRORS, sigmas.tolist(), strict=True)}


def _bases(windows: Windows, model: OdometryModel) -> Array:
    """Covariances (M, 11, 3, 3) for unit variances: three drivers of each error, then position and heading of the reference."""
    start, end = windows.states(model)
    drivers = np.abs(end - start)[:, [4, 5, 0]]  # distance, rotation, time in motion
    drivers[:, 2] -= end[:, 7] - start[:, 7]
    moved = drivers[:, 2] > 0.0
    floor = np.diag((MINIMUM_POSITION_VARIANCE, MINIMUM_POSITION_VARIANCE, MINIMUM_HEADING_VARIANCE))
    known = replace(model, unknown_distance=0.0, unknown_rotation=0.0)
    out = np.zeros((len(start), 11, 3, 3))
    for i, error in enumerate(ERRORS):
        alone = {e: Growth(per_time=1.0 if e == error else 0.0) for e in ERRORS}
        unit = windows.covariances(with_noise(known, alone)) - floor
        unit[moved] /= drivers[moved, 2, None, None]
        unit[~moved] = 0.0
        out[:, 3 * i : 3 * i + 3] = drivers[:, :, None, None] * unit[:, None]
    out[:, 9] = 2.0 * np.diag((1.0, 1.0, 0.0))
    out[:, 10] = 2.0 * np.diag((0.0, 0.0, 1.0))
    return out


def _squared(bases: Array, residuals: Array, variances: Array) -> tuple[Array, Array, Array]:
    """Squared Mahalanobis distances (M,), log-determinants (M,) and inverse covariances (M, 3, 3)."""
    floor = np.diag((MINIMUM_POSITION_VARIANCE, MINIMUM_POSITION_VARIANCE, MINIMUM_HEADING_VARIANCE))
    covariance = np.einsum("mkij,k->mij", bases, variances) + floor
    inverse = np.linalg.inv(covariance)
    squared = np.einsum("mi,mij,mj->m", residuals, inverse, residuals)
    return squared, np.linalg.slogdet(covariance)[1], inverse


def _maximise(bases: Array, residuals: Array, weights: Array, start: Array, student: float | None) -> Array:
    """Variances (11,) that maximise the likelihood; optimised as logarithms with the exact gradient."""

    def cost(logs: Array) -> tuple[float, Array]:
        variances = np.exp(logs)
        squared, log_determinant, inverse = _squared(bases, residuals, variances)
        solved = np.einsum("mij,mj->mi", inverse, residuals)
        if student is None:
            penalty, slope = 0.5 * squared, np.full(len(squared), 0.5)
        else:
            penalty = 0.5 * (student + 3.0) * np.log1p(squared / student)
            slope = 0.5 * (student + 3.0) / (student + squared)
        by_variance = 0.5 * np.einsum("mij,mkji->mk", inverse, bases)
        by_variance -= slope[:, None] * np.einsum("mi,mkij,mj->mk", solved, bases, solved)
        total = weights @ (penalty + 0.5 * log_determinant)
        return float(total / len(weights)), (weights @ by_variance) * variances / len(weights)

    bounds = [(np.log(1e-14), np.log(25.0))] * len(start)
    found = minimize(cost, np.log(np.maximum(start, 1e-10)), jac=True, method="L-BFGS-B", bounds=bounds)
    return np.asarray(np.exp(found.x))
