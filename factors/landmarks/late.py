"""Late ranges: a radio wave that arrives by a reflection has travelled further than the line of sight.

A range without a bearing is either direct or late. The noise of a direct range is Gaussian. A late range has an
additional excess, which is Gaussian with a positive mean. Both parts have the robust loss of Geman and McClure, so that
gross errors have little influence. The likelihood is the sum of both parts, weighted by the share of late ranges.

:class:`LateShares` learns the share and the excess of a sensor from innovations. Other hypotheses compete for the same
innovations: a larger or smaller noise, a bias of all ranges, and gross errors. All hypotheses have prior probabilities.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from factors.compiled import compiled
from factors.robust import geman_mcclure_loss, geman_mcclure_weight
from factors.se2 import Array

# Each combination of these values is a hypothesis. A further hypothesis for each of NOISES is that no range is late.
NOISES = (0.6, 1.0, 1.6)  # factors of the standard deviation of ranges
SHARES = (0.02, 0.05, 0.12, 0.25, 0.45, 1.0)  # fractions of late ranges; 1 is a bias of all ranges
MEANS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)  # m: means of the excess; their prior is proportional to the inverse
RELATIVE_SIGMAS = (0.2, 0.7)  # standard deviation of the excess divided by its mean
BIASED = 0.05  # prior probability that all ranges of a sensor without late ranges have a bias
OUTLIERS, FAR = 0.02, 10.0  # fraction of gross errors, and their standard deviation divided by that of an innovation
LARGEST = 1e4  # squares of normalised innovations are limited to this value
LEAST = 0.002  # a smaller share of late ranges is replaced by 0
EXACT = 1e-9  # a smaller variance of a predicted range, in units of the noise, is replaced by 0
LEAST_GAIN = 1e-6  # minimum relative reduction of a variance by a range
# minimum information of a range, relative to a range that is known to be direct or known to be late
LEAST_INFORMATION = 0.2


class LateRanges(NamedTuple):
    """The statistics of late ranges, which are too long because the signal was reflected. ``share``: the fraction of
    ranges that are late. ``mean``, ``sigma`` [m]: mean and standard deviation of the excess of a late range."""

    share: float = 0.0
    mean: float = 0.0
    sigma: float = 0.0


NONE = LateRanges()


@register_jitable
def mixture(
    error: float, slope: float, robust: float, share: float, mean: float, sigma: float
) -> tuple[float, float, float]:
    """Return the negative log-likelihood of a range that may be late (too long), its derivative by ``error``, and its
    Fisher information about ``error``.

    ``error``: the predicted minus the measured range in standard deviations.
    ``slope``: the inverse of the standard deviation of a range [1/m].
    ``robust``: the scale of the Geman-McClure loss. ``share``: the fraction of late ranges.
    ``mean``, ``sigma`` [m]: mean and standard deviation of the excess of a late range.

    The information is the mean information of a direct and a late range, minus the variance of the derivative (Louis,
    Journal of the Royal Statistical Society B 44(2), 1982). It has a positive minimum.
    """
    widening = 1.0 + (slope * sigma) ** 2
    beyond = error + slope * mean
    squared, squared_late = error * error, beyond * beyond / widening
    loss = geman_mcclure_loss(squared, robust)
    log_odds = math.log(share / (1.0 - share)) - 0.5 * math.log(widening)
    log_odds += loss - geman_mcclure_loss(squared_late, robust)
    late = 1.0 / (1.0 + math.exp(-log_odds))  # the probability that the range is late
    both = log_odds + math.log1p(math.exp(-log_odds)) if log_odds > 0.0 else math.log1p(math.exp(log_odds))
    weight, weight_late = geman_mcclure_weight(squared, robust), geman_mcclure_weight(squared_late, robust) / widening
    slope_direct, slope_late = weight * error, weight_late * beyond
    derivative = (1.0 - late) * slope_direct + late * slope_late
    known = (1.0 - late) * weight + late * weight_late
    information = known - late * (1.0 - late) * (slope_direct - slope_late) ** 2
    return loss - both - math.log(1.0 - share), derivative, max(information, LEAST_INFORMATION * known)


@register_jitable
def moments(
    error: float, slope: float, variance: float, robust: float, gate: float, share: float, mean: float, sigma: float
) -> tuple[float, float, float]:
    """Return a Gaussian measurement that replaces a range that may be late (too long) in a Kalman update.

    ``error``: the predicted minus the measured range in standard deviations. ``slope``: the inverse of the standard
    deviation of a range [1/m]. ``variance``: the variance of the predicted range divided by that of the noise.
    ``robust``: the scale of the Geman-McClure loss. ``gate``: the noise is increased if a normalised innovation squared
    exceeds this limit. ``share``, ``mean``, ``sigma``: the fields of :class:`LateRanges`.

    Returns three values: the error and the weight of the Gaussian measurement, and the expected normalised innovation
    squared. The posterior of a range that may be late is a mixture of two Gaussians. The Gaussian measurement leads to
    a posterior with the same mean and variance (assumed density filtering: Minka, "A family of algorithms for
    approximate Bayesian inference", 2001, 3.1).
    """
    widening = 1.0 + (slope * sigma) ** 2
    beyond = error + slope * mean
    squared, squared_late = error * error / (variance + 1.0), beyond * beyond / (variance + widening)
    log_odds = math.log(share / (1.0 - share)) - 0.5 * math.log((variance + widening) / (variance + 1.0))
    log_odds += geman_mcclure_loss(squared, robust) - geman_mcclure_loss(squared_late, robust)
    late = 1.0 / (1.0 + math.exp(-log_odds))
    weight, weight_late = max(1.0, squared / gate) ** -2, max(1.0, squared_late / gate) ** -2 / widening
    # the posterior of the predicted range, as a change of the prediction
    gain, gain_late = 1.0 / (1.0 + variance * weight), 1.0 / (1.0 + variance * weight_late)
    change, change_late = -variance * gain * weight * error, -variance * gain_late * weight_late * beyond
    changed = (1.0 - late) * change + late * change_late
    left = variance * ((1.0 - late) * gain + late * gain_late) + late * (1.0 - late) * (change - change_late) ** 2
    left = min(left, (1.0 - LEAST_GAIN) * variance)
    information = 1.0 / left - 1.0 / variance
    return -changed / (left * information), information, (1.0 - late) * squared + late * squared_late


def _grid() -> tuple[Array, Array, Array]:
    """Return three arrays (H,): the share of late ranges, and the mean and sigma of their excess, for H hypotheses."""
    shares, means, sigmas = (part.ravel() for part in np.meshgrid(SHARES, MEANS, RELATIVE_SIGMAS, indexing="ij"))
    return shares, means, sigmas * means


_SHARES, _MEANS, _SIGMAS = _grid()
_IS_LATE = _SHARES < 1.0
_PARTS = len(MEANS) * len(RELATIVE_SIGMAS)  # number of successive hypotheses with equal share


@lru_cache(maxsize=16)
def _prior(probability: float) -> Array:
    """Return the log priors (noises, 1 + H) of the hypotheses. The first column is the hypothesis that no range is
    late. ``probability``: the prior probability that the sensor has late ranges."""
    biased = BIASED * (1.0 - probability)
    excess = np.where(_IS_LATE, probability, biased) / _MEANS
    for group in (_IS_LATE, ~_IS_LATE):
        excess[group] /= np.sum(1.0 / _MEANS[group])
    row = np.concatenate(((1.0 - probability - biased,), excess)) / len(NOISES)
    return np.log(np.tile(row, (len(NOISES), 1)))


@dataclass(frozen=True, eq=False)
class LateShares:
    """A Bayesian filter that estimates how many ranges of a sensor are late (too long), and by how much. Immutable.

    ``probability``: the prior probability that the sensor has late ranges.
    ``log_weights`` (noises, 1 + H): log posterior probabilities of hypotheses. A row is a noise level of direct ranges.
    The first column means no late ranges, the others mean H distributions of late ranges. None means the prior.
    ``expected``: the statistics of late ranges, averaged over all hypotheses.
    """

    probability: float
    log_weights: Array | None = None
    expected: LateRanges = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "expected", self._expected())

    def _expected(self) -> LateRanges:
        """Return the share of late ranges, and the moments of their excess, averaged over all hypotheses."""
        if self.probability == 0.0:
            return NONE
        logs = _prior(self.probability) if self.log_weights is None else self.log_weights
        share, mean, sigma = _averaged(logs, _SHARES, _MEANS, _SIGMAS)
        return LateRanges(_rounded(share), _rounded(mean), _rounded(sigma)) if share >= LEAST else NONE

    def updated(self, errors: Array, slopes: Array, variances: Array) -> LateShares:
        """Return the Bayesian filter of late (too long) ranges after an update by K measured ranges.

        ``errors`` (K,): the predicted minus the measured ranges in standard deviations. ``slopes`` (K,): the inverse
        standard deviations of the ranges [1/m]. 0 excludes a measurement from the update, such as one with a bearing.
        ``variances`` (K,): the variances of the predicted ranges, divided by the variances of the measured ranges.
        """
        if self.probability == 0.0 or not slopes.any():
            return self
        logs = _prior(self.probability) if self.log_weights is None else self.log_weights
        return LateShares(self.probability, _learnt(logs, _SHARES, _MEANS, _SIGMAS, errors, slopes, variances))


def _rounded(value: float) -> float:
    """Return ``value`` rounded to two significant digits. Equal models can then be linearised together."""
    return float(f"{value:.2g}")


@compiled(error_model="numpy")
def _learnt(
    logs: Array, shares: Array, means: Array, sigmas: Array, errors: Array, slopes: Array, variances: Array
) -> Array:
    """Return the normalised log-probabilities (noises, 1 + H) of all hypotheses after K measured ranges.
    ``logs``: the log-probabilities before the ranges. ``shares``, ``means``, ``sigmas`` (H,): the hypotheses with late
    (too long) ranges. The other arguments are those of :meth:`LateShares.updated`."""
    out, late = logs.copy(), np.empty(_PARTS)
    for k in range(len(errors)):
        if slopes[k] == 0.0:
            continue
        for n in range(len(out)):
            noise = NOISES[n] * NOISES[n] + variances[k]
            squared = min(errors[k] * errors[k] / noise, LARGEST)
            direct = math.exp(-0.5 * squared) / math.sqrt(noise)
            floor = OUTLIERS / FAR * math.exp(-0.5 * squared / FAR**2) / math.sqrt(noise)
            for j in range(_PARTS):
                width = noise + (slopes[k] * sigmas[j]) ** 2
                beyond = errors[k] + slopes[k] * means[j]
                late[j] = math.exp(-0.5 * beyond * beyond / width) / math.sqrt(width)
            out[n, 0] += math.log((1.0 - OUTLIERS) * direct + floor)
            for j in range(len(shares)):
                both = (1.0 - shares[j]) * direct + shares[j] * late[j % _PARTS]
                out[n, 1 + j] += math.log((1.0 - OUTLIERS) * both + floor)
    largest = out.max()
    return np.asarray(out - (largest + math.log(np.exp(out - largest).sum())))


@compiled(error_model="numpy")
def _averaged(logs: Array, shares: Array, means: Array, sigmas: Array) -> tuple[float, float, float]:
    """Return the share of late (too long) ranges, and the mean and standard deviation [m] of their excess, averaged
    over all hypotheses. ``logs`` (noises, 1 + H): log-probabilities. ``shares``, ``means``, ``sigmas`` (H,): values."""
    share = first = second = 0.0
    for j in range(len(shares)):
        if shares[j] < 1.0:
            weight = 0.0
            for n in range(len(logs)):
                weight += shares[j] * math.exp(logs[n, 1 + j])
            share += weight
            first += weight * means[j]
            second += weight * (means[j] ** 2 + sigmas[j] ** 2)
    mean = first / share
    return share, mean, math.sqrt(max(second / share - mean * mean, 0.0))
