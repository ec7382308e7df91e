"""Maximum a posteriori estimates of the parameters that several logs share.

The cost is the negative log-likelihood of all logs, plus that of Gaussian priors. All parameters take each damped Gauss-Newton step
together. Parameters with nearly the same effect, such as two kinds of drift, may be correlated.

Measurements are correlated within a block of time. The likelihood is weighted by their share of independent information
(Pauli, Racugno, Ventura, "Bayesian composite marginal likelihoods", Statistica Sinica 21, 2011), and the covariance is that of the
scores of the blocks (Liang and Zeger, "Longitudinal data analysis using generalized linear models", 1986). Residuals have the
soft-L1 loss (Charbonnier et al., "Two deterministic half-quadratic regularization algorithms for computed imaging", 1994).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from factors.least_squares import minimum
from factors.se2 import Array, Integers

LOSS_SCALE = 2.0  # standard deviations at which the loss changes from quadratic to linear
MAD_TO_SIGMA = 1.4826  # of a Gaussian
ITERATIONS, CONVERGED, LARGEST = 30, 3e-3, 2.0  # steps in standard deviations of the prior
STEP = 1e-4  # of numerical derivatives, in the same
LEAST_SHARE = 1e-3
DETERMINED = 0.7  # of the prior's standard deviation; above it the logs hardly determine a parameter
CORRELATED = 0.8  # correlation of two parameters that is reported


@dataclass(frozen=True)
class Parameter:
    """A parameter with a Gaussian prior, ``mean`` and ``sigma``, and bounds."""

    name: str
    mean: float
    sigma: float
    low: float = -np.inf
    high: float = np.inf


class LikelihoodTerms(NamedTuple):
    """Negative log-likelihood ``cost``; its gradient in each block of time, ``scores`` (B, P), and the ``information`` (P, P)."""

    cost: float
    scores: Array
    information: Array


Likelihood = Callable[[Array], LikelihoodTerms]


@dataclass(frozen=True)
class Posterior:
    """``values`` (P,) of maximal posterior density, their ``covariance`` (P, P), and the ``share`` of independent measurements."""

    parameters: tuple[Parameter, ...]
    values: Array
    covariance: Array
    share: float

    @property
    def errors(self) -> Array:
        """Standard deviations (P,)."""
        return np.sqrt(np.diag(self.covariance))

    def as_dict(self) -> dict[str, float]:
        return {p.name: float(v) for p, v in zip(self.parameters, self.values, strict=True)}

    def correlations(self) -> list[tuple[str, str, float]]:
        """The pairs of parameters with a correlation above :data:`CORRELATED`."""
        matrix = self.covariance / np.outer(self.errors, self.errors)
        rows, columns = np.nonzero(np.abs(np.triu(matrix, 1)) > CORRELATED)
        names = [p.name for p in self.parameters]
        return [(names[i], names[k], float(matrix[i, k])) for i, k in zip(rows, columns, strict=True)]


@dataclass(frozen=True)
class FittedConstant:
    """The result for one constant: its ``initial`` and ``fitted`` values, with its standard ``error``.

    ``prior``: standard deviation of its prior, None without one. ``per_log``: values of each log alone. ``uncertainty``: standard
    deviation between logs, None if unknown.
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
        """Whether the logs say much more than was known before."""
        return self.prior is None or self.error < DETERMINED * self.prior


def maximise(
    parameters: Sequence[Parameter],
    likelihood: Likelihood,
    start: Mapping[str, float] | None = None,
    covariance: Array | None = None,
) -> Posterior:
    """The maximum of the posterior density of ``parameters`` (P,), from ``start`` or the means of the priors.

    ``covariance`` (P, P) of the priors; without it they are independent.
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
    """The weight, at most 1, at which a likelihood is as certain as its scores in B blocks of time (B, P) scatter.

    Without correlations the scores scatter as the ``information`` (P, P) says: Varin, Reid and Firth, "An overview of composite
    likelihood methods", Statistica Sinica 21, 2011, section 2.2. ``precision``: of the prior.
    """
    inverse = np.linalg.pinv(information + precision)
    ratio = np.trace(inverse @ information) / max(float(np.trace(inverse @ (scores.T @ scores))), 1e-12)
    return float(np.clip(ratio, LEAST_SHARE, 1.0))


def least_squares(whitened: Callable[[Array], Array], parameters: Sequence[Parameter], block: Integers) -> Likelihood:
    """The likelihood of residuals ``whitened(values)`` (M, D) in standard deviations, with numerical derivatives and soft-L1 loss.

    ``block`` (M,): the block of time of each row.
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
    """Sums (B, P) of the rows of ``scores`` (M, P) with the same ``block`` (M,)."""
    out = np.zeros((int(block.max(initial=0)) + 1, scores.shape[1]))
    np.add.at(out, block, scores)
    return out


def blocks(times: Sequence[Array], length: float) -> Integers:
    """Number the blocks of ``length`` seconds of several logs consecutively, and return the block of each time."""
    out: list[Integers] = []
    first = 0
    for t in times:
        out.append(((t - t.min(initial=np.inf)) // length).astype(np.int64) + first)
        first = int(out[-1].max(initial=first)) + 1
    return np.concatenate(out)


def robust_sigma(values: Array) -> Array:
    """Return the robust standard deviation (D,) about zero of the columns of ``values`` (M, D)."""
    return np.asarray(MAD_TO_SIGMA * np.nanmedian(np.abs(values), axis=0))


def centred(parameters: Sequence[Parameter], values: Mapping[str, float]) -> list[Parameter]:
    """The parameters with priors about ``values``."""
    return [replace(p, mean=values[p.name]) for p in parameters]
