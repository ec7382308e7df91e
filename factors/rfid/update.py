"""Gaussian update of a pose by RFID likelihoods."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from factors import positive, se2, se2_kernels
from factors.compiled import compiled
from factors.odometry.kernels import FAR, ROUNDING
from factors.rfid import kernels as rfid_kernels
from factors.rfid.counts import TagReadCounts
from factors.rfid.detection import RfidLikelihood, Score
from factors.rfid.factor import RfidFactor
from factors.rfid.model import Packed
from factors.se2 import Array, Integers
from factors.small_kernels import inverse, product, solved

_Tags = tuple[Array, Array]  # points and normals
_Seen = tuple[Array, Integers, Integers, Integers, Array, Array]  # offsets, antennas, rounds, hits, odds and elsewhere
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
    if factor.estimated or not isinstance(likelihood, RfidLikelihood) or not isinstance(looks, TagReadCounts):
        return scored_update(factor, pose, values, covariance, iterations)
    farthest = iterations * float(np.hypot(*LARGEST_STEP[:2]))
    near = likelihood.around(pose[None], looks, likelihood.packed, farthest)
    arguments = (likelihood.packed, near.arrays[:2], near.arrays[2:], float(likelihood.model.tempering))
    try:
        found = _updated(*arguments, pose, covariance, iterations)
    except np.linalg.LinAlgError:  # rounding made it singular
        found = _updated(*arguments, pose, positive.nearest(covariance), iterations)
    at, posterior, nis, dof, excess, variance, evidence = found
    nll, expected, spread = likelihood.model.tempering * np.array(near.unlisted)
    return TagUpdate(at, posterior, nis, dof, excess + nll - expected, variance + spread, evidence - nll, values)


def scored_update(factor: RfidFactor, pose: Array, values: Array, covariance: Array, iterations: int) -> TagUpdate:
    """:func:`updated` by a factor of any kind."""
    prior_information: Array = positive.inverse(covariance)
    sigmas = np.sqrt(np.diag(covariance))
    largest = np.concatenate((LARGEST_STEP, np.full(len(values), LARGEST_CHANGE)))
    first = factor.joint_score([pose, values])
    # tempering stands for what successive scans have in common: a score alone scatters as if there were no tempering
    tempering = factor.likelihood.model.tempering
    nis, dof = _innovation(first.gradient[0], np.ascontiguousarray(first.information[0]), covariance, tempering)
    surprise = variance = 0.0
    if isinstance(first, Score):
        surprise, variance = float(first.nll[0] - first.expected[0]), float(first.variance[0])
    here, cost = first, float(first.nll[0])
    best, changed, moved = pose, values, np.zeros(len(covariance))
    for _ in range(iterations):
        information = np.ascontiguousarray(here.information[0])
        step = _scoring_step(prior_information, information, here.gradient[0], moved, largest)
        if np.all(np.abs(step) < CONVERGED * sigmas):
            best, changed = se2.compose(best, se2.exp(step[:3])), changed + step[3:]
            break
        for _ in range(4):
            tried, tried_values = se2.compose(best, se2.exp(step[:3])), changed + step[3:]
            there = factor.joint_score([tried, tried_values])
            error = np.concatenate((se2.log(se2.between(pose, tried)), tried_values - values))
            tried_cost = float(there.nll[0]) + 0.5 * float(error @ prior_information @ error)
            if tried_cost <= cost:
                break
            step = step / 2.0
        else:
            break
        best, changed, cost, moved, here = tried, tried_values, tried_cost, error, there
    posterior, log_ratio = _posterior(prior_information, np.ascontiguousarray(here.information[0]))
    return TagUpdate(best, posterior, nis, dof, surprise, variance, 0.5 * log_ratio - cost, changed)


@compiled
def _updated(
    packed: Packed, tags: _Tags, seen: _Seen, tempering: float, pose: Array, covariance: Array, iterations: int
) -> tuple[Array, Array, float, int, float, float, float]:
    """:func:`scored_update` by one factor of read counts."""
    here = _score(packed, tags, seen, tempering, pose)
    prior_information = inverse(covariance)
    nis, dof = _innovation(here.gradient[0], here.information[0], covariance, tempering)
    surprise, variance, cost = here.nll[0] - here.expected[0], here.variance[0], here.nll[0]
    best, moved, largest = pose.copy(), np.zeros(3), LARGEST_STEP.copy()  # as a constant is another type
    for _ in range(iterations):
        step = _scoring_step(prior_information, here.information[0], here.gradient[0], moved, largest)
        small = True
        for i in range(3):
            small = small and abs(step[i]) < CONVERGED * math.sqrt(covariance[i, i])
        if small:
            best = _stepped(best, step)
            break
        lower = False
        for _ in range(4):
            tried = _stepped(best, step)
            there, error = _score(packed, tags, seen, tempering, tried), _apart(pose, tried)
            tried_cost = there.nll[0]
            for i in range(3):
                for j in range(3):
                    tried_cost += 0.5 * error[i] * prior_information[i, j] * error[j]
            lower = tried_cost <= cost
            if lower:
                best, cost, moved, here = tried, tried_cost, error, there
                break
            for i in range(3):
                step[i] /= 2.0
        if not lower:
            break
    posterior, log_ratio = _posterior(prior_information, here.information[0])
    return best, posterior, nis, dof, surprise, variance, 0.5 * log_ratio - cost


@compiled
def _score(packed: Packed, tags: _Tags, seen: _Seen, tempering: float, pose: Array) -> Score:
    """The score of one pose (3,), see :meth:`~factors.rfid.detection.RfidLikelihood.score`."""
    points, normals = tags
    offsets, antennas, rounds, hits, odds, elsewhere = seen
    nll, gradient, information = np.empty(1), np.empty((1, 3)), np.empty((1, 3, 3))
    told = np.empty(1), np.empty(1)
    at = pose.copy().reshape(1, 3)
    rfid_kernels.score(
        packed,
        at,
        points,
        normals,
        offsets,
        antennas,
        rounds,
        hits,
        odds,
        elsewhere,
        tempering,
        nll,
        gradient,
        information,
        *told,
    )
    return Score(nll, gradient, information, *told)


@compiled
def _stepped(pose: Array, step: Array) -> Array:
    x, y, turned = se2_kernels.exp(step[0], step[1], step[2])
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return np.array((pose[0] + c * x - s * y, pose[1] + s * x + c * y, se2_kernels.wrapped(pose[2] + turned)))


@compiled
def _apart(pose: Array, other: Array) -> Array:
    """The twist from one pose to another."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    dx, dy = other[0] - pose[0], other[1] - pose[1]
    return np.array(se2_kernels.log(c * dx + s * dy, c * dy - s * dx, other[2] - pose[2]))


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
