"""Maximum a posteriori estimates of parameters that are equal in several logs, such as the constants of a sensor.

The cost is the negative log-likelihood of all logs, plus that of Gaussian priors. Damped Gauss-Newton steps minimise the cost over
all parameters together, because parameters with similar effects, such as two kinds of drift, may be correlated.

Measurements that are close in time have correlated errors. Time is therefore divided into intervals, which count as
independent. The log-likelihood is multiplied by a factor of at most 1 (Pauli, Racugno, Ventura, "Bayesian composite
marginal likelihoods", Statistica Sinica 21, 2011). The covariance is computed from the scores (gradients of the
log-likelihood) of the intervals (Liang and Zeger, "Longitudinal data analysis using generalized linear models", 1986).
Residuals have the soft-L1 loss (Charbonnier et al., "Two deterministic half-quadratic regularization algorithms for
computed imaging", 1994).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from factors.least_squares import minimum
from factors.se2 import Array, Integers

LOSS_SCALE = 2.0  # standard deviations at which the loss changes from quadratic to linear
MAD_TO_SIGMA = 1.4826  # factor from the median absolute deviation of a Gaussian to its standard deviation
# maximum number of steps; the step at which the fit has converged, and the largest step, both in standard deviations of the prior
ITERATIONS, CONVERGED, LARGEST = 30, 3e-3, 2.0
STEP = 1e-4  # step of numerical derivatives, in standard deviations of the prior
LEAST_SHARE = 1e-3  # minimum of the result of :func:`independent_share`
DETERMINED = 0.7  # a parameter counts as determined if its standard error is below this fraction of its prior sigma
CORRELATED = 0.8  # two parameters with a larger absolute correlation are reported


@dataclass(frozen=True)
class Parameter:
    """A scalar parameter ``name`` with a Gaussian prior (``mean``, ``sigma``) and the bounds ``low`` and ``high``."""

    name: str
    mean: float
    sigma: float
    low: float = -np.inf
    high: float = np.inf


class LikelihoodTerms(NamedTuple):
    """A likelihood and its derivatives at given values of P parameters. ``cost``: the negative log-likelihood of all
    measurements. ``scores`` (B, P): row b is the gradient of this cost for the measurements in time interval b. The
    rows add up to the whole gradient. ``information`` (P, P): the Fisher information of all measurements."""

    cost: float
    scores: Array
    information: Array


Likelihood = Callable[[Array], LikelihoodTerms]


@dataclass(frozen=True)
class Posterior:
    """The estimate of P ``parameters``. ``values`` (P,): the values with the largest posterior density. ``covariance``
    (P, P): the covariance of their errors. ``share``: the exponent of the likelihood in the posterior, from 0 to 1. It
    is below 1 if the errors of measurements are correlated."""

    parameters: tuple[Parameter, ...]
    values: Array
    covariance: Array
    share: float

    @property
    def errors(self) -> Array:
        """The standard errors (P,) of the values."""
        return np.sqrt(np.diag(self.covariance))

    def as_dict(self) -> dict[str, float]:
        return {p.name: float(v) for p, v in zip(self.parameters, self.values, strict=True)}

    def correlations(self) -> list[tuple[str, str, float]]:
        """Return a tuple (name, other name, correlation) for each pair of parameters with an absolute correlation above
        :data:`CORRELATED`."""
        matrix = self.covariance / np.outer(self.errors, self.errors)
        rows, columns = np.nonzero(np.abs(np.triu(matrix, 1)) > CORRELATED)
        names = [p.name for p in self.parameters]
        return [(names[i], names[k], float(matrix[i, k])) for i, k in zip(rows, columns, strict=True)]


@dataclass(frozen=True)
class FittedConstant:
    """The calibration result of the constant ``name`` of the sensor ``sensor``.

    ``initial``, ``fitted``: the values before and after the fit. ``error``: the standard error of the fitted value.
    ``prior``: the standard deviation of the prior, or None if there is no prior.
    ``per_log``: for each log, the value fitted to this log only. Empty if unknown.
    ``uncertainty``: the standard deviation of the constant between logs, or None if it is unknown.
    """

    sensor: str
    name: str
    initial: float
    fitted: float
    error: float
    prior: float | None = None
    per_log: tuple[float, ...] = ()
    uncertainty: float | None = None

    @property
    def is_determined(self) -> bool:
        """True if there is no prior, or if ``error`` is less than the fraction :data:`DETERMINED` of ``prior``."""
        return self.prior is None or self.error < DETERMINED * self.prior


def maximise(
    parameters: Sequence[Parameter],
    likelihood: Likelihood,
    start: Mapping[str, float] | None = None,
    covariance: Array | None = None,
) -> Posterior:
    """Return the maximum a posteriori estimate of parameters, with its covariance.

    ``parameters``: P parameters with priors. ``likelihood``: returns cost and derivatives at values (P,).
    ``start``: initial values by name. The default is the mean of the prior.
    ``covariance`` (P, P): the joint covariance of the priors. None means independent priors.
    """
    mean, sigma, low, high = (
        np.array([getattr(p, name) for p in parameters], dtype=float) for name in ("mean", "sigma", "low", "high")
    )
    precision = np.asarray(np.linalg.inv(np.diag(sigma**2) if covariance is None else covariance), dtype=float)
    values = np.clip([(start or {}).get(p.name, p.mean) for p in parameters], low, high)
    share = 1.0
    for _ in range(2):

        def at(values: Array, share: float = share) -> tuple[float, Array, Array]:
            terms, away = likelihood(values), values - mean
            gradient = share * terms.scores.sum(axis=0) + precision @ away
            cost = share * terms.cost + 0.5 * float(away @ precision @ away)
            return cost, gradient, share * terms.information + precision

        values, _, _ = minimum(at, values, ITERATIONS, CONVERGED * sigma, largest=LARGEST * sigma, low=low, high=high)
        terms = likelihood(values)
        share = independent_share(terms.scores, terms.information, precision)
    inverse = np.linalg.inv(share * terms.information + precision)
    scatter = share**2 * (terms.scores.T @ terms.scores) + precision
    return Posterior(tuple(parameters), values, inverse @ scatter @ inverse, share)


def independent_share(scores: Array, information: Array, precision: Array | float = 0.0) -> float:
    """Return the exponent of a likelihood, at most 1, that corrects for correlated measurement errors.

    ``scores`` (B, P): gradients of the log-likelihood of B time intervals. ``information`` (P, P): the Fisher
    information of all intervals. ``precision`` (P, P): the inverse covariance of the prior. The exponent is the ratio
    of the information to the empirical covariance of the scores. Both are equal for independent errors (Varin, Reid and
    Firth, "An overview of composite likelihood methods", Statistica Sinica 21, 2011, section 2.2).
    """
    inverse = np.linalg.pinv(information + precision)
    ratio = np.trace(inverse @ information) / max(float(np.trace(inverse @ (scores.T @ scores))), 1e-12)
    return float(np.clip(ratio, LEAST_SHARE, 1.0))


def least_squares(whitened: Callable[[Array], Array], parameters: Sequence[Parameter], block: Integers) -> Likelihood:
    """Return a likelihood for :func:`maximise` from residuals, by numerical derivatives and the soft-L1 loss.

    ``whitened(values)``: returns residuals (M, D) in standard deviations, for parameter values (P,). ``parameters``:
    the P parameters, which determine the steps of derivatives. ``block`` (M,): the index of the time interval of each
    row of residuals, from :func:`blocks`. Errors in different intervals are independent.
    """
    steps = STEP * np.diag([p.sigma for p in parameters])

    def at(values: Array) -> LikelihoodTerms:
        residuals = whitened(values)
        moved = [(whitened(values + step) - residuals) / np.sum(step) for step in steps]
        jacobian = np.stack(moved, axis=-1)
        weight = 1.0 / np.sqrt(1.0 + (residuals / LOSS_SCALE) ** 2)
        scores = by_block(np.einsum("mdp,md->mp", jacobian, weight * residuals), block)
        cost = LOSS_SCALE**2 * float(np.sum(1.0 / weight - 1.0))
        return LikelihoodTerms(cost, scores, np.einsum("mdp,md,mdq->pq", jacobian, weight**3, jacobian))

    return at


def by_block(scores: Array, block: Integers) -> Array:
    """Return the sums (B, P) of rows of ``scores`` (M, P) by group. ``block`` (M,): the group index of each row, from
    0. Row b of the result is the sum of the rows of ``scores`` with index b."""
    out = np.zeros((int(block.max(initial=0)) + 1, scores.shape[1]))
    np.add.at(out, block, scores)
    return out


def blocks(times: Sequence[Array], length: float) -> Integers:
    """Return the index of the time interval of each measurement, in one array for all logs. ``times``: for each log,
    the times [s] of its measurements. ``length``: the length of an interval [s]. The intervals of a log are numbered
    after those of the previous log, so that no two logs share an index."""
    out: list[Integers] = []
    first = 0
    for t in times:
        out.append(((t - t.min(initial=np.inf)) // length).astype(np.int64) + first)
        first = int(out[-1].max(initial=first)) + 1
    return np.concatenate(out)


def robust_sigma(values: Array) -> Array:
    """Return the median absolute value (D,) of each column of ``values`` (M, D), scaled to the standard deviation of a
    zero-mean Gaussian. NaN is ignored."""
    return np.asarray(MAD_TO_SIGMA * np.nanmedian(np.abs(values), axis=0))


def centred(parameters: Sequence[Parameter], values: Mapping[str, float]) -> list[Parameter]:
    """Return copies of the parameters with new prior means. ``values``: the new mean of each parameter by name."""
    return [replace(p, mean=values[p.name]) for p in parameters]
