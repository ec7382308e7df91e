"""Gaussian update of a pose by RFID likelihoods."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from factors import positive, se2
from factors.compiled import compiled
from factors.gaussian import inverse, product, solved
from factors.odometry.kernels import FAR, ROUNDING
from factors.rfid.detection import RfidLikelihood, Score, TagReadCounts
from factors.rfid.factor import RfidFactor
from factors.rfid.index import MapTags, Seen
from factors.rfid.kernels import score
from factors.rfid.model import Packed
from factors.se2 import Array, Integers

CONVERGED = 0.1  # of a standard deviation: a step of an update that is not worth another
NOTHING = np.zeros(0)
LARGEST_STEP = np.array((0.5, 0.5, 0.3))  # m, m, rad: how far a step may go before the likelihood is looked at again
LARGEST_CHANGE = 0.5  # of a parameter of a detection model
ITERATIONS = 4
NOTHING_TOLD = 1e-9  # added to an information matrix that may be singular
TELLING = 1e-6  # minimum relevant eigenvalue of an information matrix


@dataclass(frozen=True)
class TagUpdate:
    """A pose (3,) and ``values`` (P,) of the detection models after looks at tags, with their ``covariance`` (3 + P, 3 + P), in the
    body frame.

    ``nis``: normalised square of the prior score, with ``dof`` degrees of freedom; ``excess_nll`` and ``variance``: excess of the
    prior negative log-likelihood over its expected value, and its variance; ``evidence``: log-probability of the measurements, by
    Laplace's method.
    """

    pose: Array
    covariance: Array
    nis: float
    dof: int
    excess_nll: float
    variance: float
    evidence: float
    values: Array


def update(
    likelihood: RfidLikelihood, looks: TagReadCounts, pose: Array, covariance: Array, iterations: int = ITERATIONS
) -> TagUpdate:
    """The most likely pose after looks at tags; see :func:`updated`."""
    return updated(RfidFactor(likelihood, looks), pose, NOTHING, covariance, iterations)


def updated(
    factor: RfidFactor, pose: Array, values: Array, covariance: Array, iterations: int = ITERATIONS
) -> TagUpdate:
    """The most likely pose and ``values`` (P,) of what the factor estimates, by Fisher scoring, under a Gaussian prior.

    ``pose`` (3,) and ``values`` with ``covariance`` (3 + P, 3 + P), in the body frame. A step that does not lower the cost is
    halved.
    """
    pose, covariance = np.ascontiguousarray(pose, dtype=float), np.ascontiguousarray(covariance, dtype=float)
    likelihood, looks = factor.likelihood, factor.seen
    if not isinstance(likelihood, RfidLikelihood) or not isinstance(looks, TagReadCounts):
        return scored_update(factor, pose, covariance, iterations)
    estimated = np.array(factor.estimated, dtype=np.int64)
    problem = (*likelihood.arrays, looks.seen, float(likelihood.model.tempering), likelihood.parameters, estimated)
    try:
        found = _updated(*problem, pose, values, covariance, iterations)
    except np.linalg.LinAlgError:  # rounding made it singular
        found = _updated(*problem, pose, values, positive.nearest(covariance), iterations)
    return TagUpdate(*found)


def scored_update(factor: RfidFactor, pose: Array, covariance: Array, iterations: int) -> TagUpdate:
    """:func:`updated` by a factor of any kind on the pose alone."""
    prior_information: Array = positive.inverse(covariance)
    sigmas = np.sqrt(np.diag(covariance))
    first = factor.score(pose)
    # tempering stands for what successive scans have in common: a score alone scatters as if there were no tempering
    tempering = factor.likelihood.model.tempering
    nis, dof = _innovation(first.gradient[0], np.ascontiguousarray(first.information[0]), covariance, tempering)
    surprise = variance = 0.0
    if isinstance(first, Score):
        surprise, variance = float(first.nll[0] - first.expected[0]), float(first.variance[0])
    here, cost = first, float(first.nll[0])
    best, moved = pose, np.zeros(3)
    for _ in range(iterations):
        information = np.ascontiguousarray(here.information[0])
        step = _scoring_step(prior_information, information, here.gradient[0], moved, LARGEST_STEP)
        if np.all(np.abs(step) < CONVERGED * sigmas):
            best = se2.compose(best, se2.exp(step))
            break
        for _ in range(4):
            tried = se2.compose(best, se2.exp(step))
            there, error = factor.score(tried), se2.log(se2.between(pose, tried))
            tried_cost = float(there.nll[0]) + 0.5 * float(error @ prior_information @ error)
            if tried_cost <= cost:
                break
            step = step / 2.0
        else:
            break
        best, cost, moved, here = tried, tried_cost, error, there
    posterior, log_ratio = _posterior(prior_information, np.ascontiguousarray(here.information[0]))
    return TagUpdate(best, posterior, nis, dof, surprise, variance, 0.5 * log_ratio - cost, NOTHING)


@compiled
def _updated(
    packed: Packed,
    of_map: MapTags,
    seen: Seen,
    tempering: float,
    known: Array,
    estimated: Integers,
    pose: Array,
    values: Array,
    covariance: Array,
    iterations: int,
) -> tuple[Array, Array, float, int, float, float, float, Array]:
    """:func:`updated` by one factor of read counts, with parameters ``known`` (2 M,) but for those that are ``estimated`` (P,)."""
    size = 3 + len(values)
    parameters, largest = known.copy(), np.full(size, LARGEST_CHANGE)
    for i in range(3):
        largest[i] = LARGEST_STEP[i]
    _set(parameters, estimated, values)
    nll, gradient, information, expected, variance = score(packed, of_map, seen, tempering, pose, parameters, estimated)
    prior_information = inverse(covariance)
    nis, dof = _innovation(gradient, information, covariance, tempering)
    surprise, cost = nll - expected, nll
    best, changed, moved = pose.copy(), values.copy(), np.zeros(size)
    for _ in range(iterations):
        step = _scoring_step(prior_information, information, gradient, moved, largest)
        small = True
        for i in range(size):
            small = small and abs(step[i]) < CONVERGED * math.sqrt(covariance[i, i])
        if small:
            best, changed = se2.moved(best, step), _added(changed, step)
            break
        lower = False
        for _ in range(4):
            tried, tried_values, error = se2.moved(best, step), _added(changed, step), np.empty(size)
            _set(parameters, estimated, tried_values)
            nll, there, curve, _, _ = score(packed, of_map, seen, tempering, tried, parameters, estimated)
            error[0], error[1], error[2] = se2.twist_to(pose, tried)
            for i in range(3, size):
                error[i] = tried_values[i - 3] - values[i - 3]
            tried_cost = nll
            for i in range(size):
                for j in range(size):
                    tried_cost += 0.5 * error[i] * prior_information[i, j] * error[j]
            lower = tried_cost <= cost
            if lower:
                best, changed, cost, moved = tried, tried_values, tried_cost, error
                gradient, information = there, curve
                break
            for i in range(size):
                step[i] /= 2.0
        if not lower:
            break
    posterior, log_ratio = _posterior(prior_information, information)
    return best, posterior, nis, dof, surprise, variance, 0.5 * log_ratio - cost, changed


@compiled
def _set(parameters: Array, estimated: Integers, values: Array) -> None:
    for i in range(len(estimated)):
        parameters[estimated[i]] = values[i]


@compiled
def _added(values: Array, step: Array) -> Array:
    """The values after a step of pose and values."""
    out = np.empty(len(values))
    for i in range(len(values)):
        out[i] = values[i] + step[3 + i]
    return out


@compiled
def _scoring_step(prior_information: Array, information: Array, gradient: Array, moved: Array, largest: Array) -> Array:
    """The step (D,) of Fisher scoring from where the state has ``moved`` (D,) to, shortened to the ``largest`` (D,) allowed."""
    size, both, pull = len(gradient), prior_information.copy(), np.empty((len(gradient), 1))
    for i in range(size):
        pull[i, 0] = -gradient[i]
        for j in range(size):
            both[i, j] += information[i, j]
            pull[i, 0] -= prior_information[i, j] * moved[j]
    found, _ = solved(both, pull)
    step, share = np.empty(size), 1.0
    for i in range(size):
        share = min(share, largest[i] / max(abs(found[i, 0]), 1e-12))
    for i in range(size):
        step[i] = share * found[i, 0]
    return step


@compiled
def _posterior(prior_information: Array, information: Array) -> tuple[Array, float]:
    """Covariance (D, D) after an update, and the log of its determinant's ratio to that before."""
    size, both = len(information), prior_information.copy()
    for i in range(size):
        for j in range(size):
            both[i, j] += information[i, j]
    posterior, after = solved(both, np.eye(size))
    return posterior, solved(prior_information, np.empty((size, 0)))[1] - after


@compiled
def _innovation(gradient: Array, information: Array, covariance: Array, tempering: float) -> tuple[float, int]:
    """Normalised square of a score, and its degrees of freedom."""
    size, spread, pull = (
        len(gradient),
        product(product(information, covariance), information),
        np.empty((len(gradient), 1)),
    )
    for i in range(size):
        pull[i, 0] = gradient[i]
        spread[i, i] += NOTHING_TOLD
        for j in range(size):
            spread[i, j] += tempering * information[i, j]
    if covariance[0, 0] + covariance[1, 1] > FAR:
        # of one direction so much more than of the others that these would be lost
        units = np.empty(size)
        for i in range(size):
            units[i] = math.sqrt(spread[i, i])
        for i in range(size):
            pull[i, 0] /= units[i]
            for j in range(size):
                spread[i, j] /= units[i] * units[j]
            spread[i, i] += ROUNDING
    found, nis = solved(spread, pull)[0], 0.0
    for i in range(size):
        nis += pull[i, 0] * found[i, 0]
    return nis, _telling(information) if nis > 0.0 else 0


@compiled(error_model="numpy")
def _telling(information: Array) -> int:
    """The number of eigenvalues above :data:`TELLING`: that of positive pivots of the matrix less this times the identity
    (Sylvester's law of inertia)."""
    size, left, count = len(information), information.copy(), 0
    for k in range(size):
        left[k, k] -= TELLING
    for k in range(size):
        count += left[k, k] > 0.0
        for i in range(k + 1, size):
            share = left[i, k] / left[k, k]
            for j in range(k + 1, size):
                left[i, j] -= share * left[k, j]
    return count
