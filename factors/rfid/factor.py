"""Likelihoods of RFID reads and misses, signal strength and phase: as factors, and the correction of a Gaussian by them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from factors import positive, se2
from factors.compiled import compiled
from factors.gaussian import inverse, product, solved
from factors.graph import compressed
from factors.odometry.kernels import FAR, ROUNDING
from factors.rfid import kernels
from factors.rfid.detection import RfidLikelihood, Score, TagReadCounts
from factors.rfid.index import Counts, MapTags
from factors.rfid.model import Packed
from factors.rfid.signals import (
    PhaseLikelihood,
    PhaseProblem,
    PhaseReads,
    RssiLikelihood,
    RssiReads,
    StrengthProblem,
    TagReads,
    phase_scores,
    strength_scores,
)
from factors.se2 import Array, Integers
from factors.update import Correction

ROWS = 4  # of the residual
CONVERGED = 0.1  # of a standard deviation: a smaller step of a correction is the last one
LARGEST_STEP = np.array((0.5, 0.5, 0.3))  # m, m, rad: the likelihood is evaluated again after each step
LARGEST_CHANGE = 0.5  # of a parameter of a detection model
ITERATIONS = 4
RIDGE = 1e-9  # added to an information matrix that may be singular
LEAST_INFORMATION = 1e-6  # minimum relevant eigenvalue of an information matrix
NO_VALUES = np.zeros(0)
NO_RESIDUAL = np.empty((0, 1))


class TagLikelihood(Protocol):
    """A likelihood of reads and misses, of strengths, or of phases, observed around a pose."""

    @property
    def model(self) -> Any:
        """Its model, with the exponent ``tempering``."""

    def score(self, poses: Array, reads: Any, /) -> Score:
        """Likelihood, gradient and information at poses (N, 3)."""

    def log_likelihood(self, poses: Array, reads: Any, /) -> Array:
        """Tempered log-likelihood (N,) at poses (N, 3), for particles."""


class TagProblem(NamedTuple):
    """Reads and misses for compiled code: models without adjustment, their ``parameters`` (Q,), and which are ``estimated``."""

    packed: Packed
    of_map: MapTags
    counts: Counts
    tempering: float
    parameters: Array
    estimated: Integers


@dataclass(frozen=True, eq=False)
class RfidFactor:
    """A likelihood of reads on the one pose (3,) that they are placed around, in compressed Fisher form: whatever their number
    there are four residuals, whose squares have the value, the gradient and the expected curvature of the likelihood. ``reads``:
    :class:`~factors.rfid.detection.TagReadCounts` for an :class:`~factors.rfid.detection.RfidLikelihood`, reads for the other two.

    ``estimated`` (P,): places of those parameters of the likelihood (:mod:`factors.rfid.parameters`) that are a second variable
    (P,) of read counts; there are P residuals more then.
    """

    likelihood: TagLikelihood
    reads: TagReadCounts | TagReads
    estimated: tuple[int, ...] = ()

    @property
    def rows(self) -> int:
        """Number of residuals."""
        return ROWS + len(self.estimated)

    @property
    def work(self) -> int:
        """About how many reads and misses are evaluated for the likelihood of one pose."""
        if isinstance(self.likelihood, RfidLikelihood) and isinstance(self.reads, TagReadCounts):
            return self.likelihood.work(self.reads)
        return len(self.reads.antennas)

    def fixed(self, values: Array) -> RfidFactor:
        """The same on the pose alone, with the ``values`` (P,) of what is estimated."""
        if not isinstance(self.likelihood, RfidLikelihood):
            return self
        return replace(self, likelihood=self.likelihood.adjusted(self._parameters(values)), estimated=())

    def _parameters(self, values: Array) -> Array:
        """All parameters (..., Q) for ``values`` (..., P) of those that are estimated."""
        assert isinstance(self.likelihood, RfidLikelihood)
        out = np.zeros((*values.shape[:-1], len(self.likelihood.parameters)))
        out[..., list(self.estimated)] = values
        return out

    def score(self, values: Sequence[Array]) -> Score:
        """Of one pose (3,) and what is estimated (P,): gradient (1, 3 + P) and information (1, 3 + P, 3 + P) by both."""
        if not self.estimated:
            return self.likelihood.score(values[0], self.reads)
        assert isinstance(self.likelihood, RfidLikelihood)
        assert isinstance(self.reads, TagReadCounts)
        return self.likelihood.joint_score(values[0], self._parameters(values[1]), self.reads, self.estimated)

    def log_likelihood(self, poses: Array, values: Array | None = None) -> Array:
        """The tempered log-likelihood (N,) of poses (N, 3), with ``values`` (N, P) of what is estimated at each."""
        if values is None:
            return self.likelihood.log_likelihood(poses, self.reads)
        assert isinstance(self.likelihood, RfidLikelihood)
        assert isinstance(self.reads, TagReadCounts)
        return self.likelihood.log_likelihood(poses, self.reads, self._parameters(values))

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Residual (4 + P,) and its Jacobians: (4 + P, 3) by the pose and, if P > 0, (4 + P, P) by the P estimated parameters."""
        score = self.score(values)
        residual, jacobian = compressed(float(score.nll[0]), score.gradient[0], score.information[0])
        return residual, [jacobian[:, :3], jacobian[:, 3:]] if self.estimated else [jacobian]

    def cost(self, values: Sequence[Array]) -> float:
        """The tempered negative log-likelihood."""
        return float((self.fixed(values[1]) if self.estimated else self).score(values[:1]).nll[0])

    def correct(
        self, pose: Array, covariance: Array, values: Array = NO_VALUES, iterations: int = ITERATIONS
    ) -> Correction:
        """The most likely pose and ``values`` (P,) of what is estimated, by Fisher scoring, under a Gaussian prior.

        ``pose`` (3,) and ``values`` have ``covariance`` (3 + P, 3 + P), in the body frame. A step that does not lower the cost is
        halved. The evidence is by Laplace's method.
        """
        pose, covariance = np.ascontiguousarray(pose, dtype=float), np.ascontiguousarray(covariance, dtype=float)
        problem = (*self._problems(), float(self.likelihood.model.tempering), pose, values)
        try:
            delta, posterior, nis, dof, *rest = _corrected(*problem, covariance, iterations)
        except np.linalg.LinAlgError:  # rounding made it singular
            delta, posterior, nis, dof, *rest = _corrected(*problem, positive.nearest(covariance), iterations)
        return Correction(delta, posterior, NO_RESIDUAL, nis, dof, *rest)

    def _problems(self) -> tuple[TagProblem | None, PhaseProblem | None, StrengthProblem | None]:
        """Likelihood and reads for compiled code: one of the three."""
        match self.likelihood, self.reads:
            case RfidLikelihood() as detection, TagReadCounts() as counts:
                estimated, alpha = np.array(self.estimated, dtype=np.int64), float(detection.model.tempering)
                known = *detection.arrays, counts.packed, alpha, detection.parameters
                return TagProblem(*known, estimated), None, None
            case PhaseLikelihood() as phase, PhaseReads() as phases:
                return None, phase.problem(phases), None
            case RssiLikelihood() as strength, RssiReads() as strengths:
                return None, None, strength.problem(strengths)
        raise TypeError(f"{type(self.likelihood).__name__} is not a likelihood of {type(self.reads).__name__}")


@dataclass(frozen=True, eq=False)
class RfidTagFactor:
    """The likelihood of read counts of tag number ``tag`` of ``likelihood``, as a factor on the pose (3,) and the tag's position
    (2,) in the world, in compressed Fisher form (:mod:`factors.compressed`): whatever the number of reads there are six
    residuals.

    Height and facing of the tag are those in ``likelihood``; its position there is not used.
    """

    likelihood: RfidLikelihood
    tag: int
    counts: TagReadCounts

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Residual (6,) and its Jacobians (6, 3) by the pose and (6, 2) by the position."""
        nll, gradient, information = self.score(values)
        residual, jacobian = compressed(nll, gradient, information)
        return residual, [jacobian[:, :3], jacobian[:, 3:]]

    def cost(self, values: Sequence[Array]) -> float:
        """The tempered negative log-likelihood."""
        return self.score(values)[0]

    def score(self, values: Sequence[Array]) -> tuple[float, Array, Array]:
        """Tempered negative log-likelihood, its gradient (5,) and Fisher information (5, 5) by the body-frame perturbation of the
        pose and the position in the world."""
        tags, counts, alpha = self.likelihood.tags, self.counts, self.likelihood.model.tempering
        point = np.array([(values[1][0], values[1][1], tags.points[self.tag, 2])])
        hits = np.ascontiguousarray(counts.hits[:, self.tag : self.tag + 1])
        arrays = point, tags.normals[self.tag : self.tag + 1], counts.offsets, counts.antennas, counts.rounds, hits
        nll, slope, curve = kernels.by_tag(self.likelihood.packed, np.asarray(values[0], dtype=float), *arrays)
        return float(alpha * nll[0]), alpha * slope[0], alpha * curve[0]


@compiled
def _score(
    tags: Any, phase: Any, strength: Any, pose: Array, values: Array
) -> tuple[float, Array, Array, float, float]:
    """Of one pose (3,) and ``values`` (P,), by the one problem that is not None: tempered negative log-likelihood, its gradient
    (3 + P,) and information (3 + P, 3 + P), and its mean and variance, which is 0 where they are not computed."""
    if tags is not None:
        parameters = tags.parameters.copy()
        for i in range(len(values)):
            parameters[tags.estimated[i]] = values[i]
        return kernels.score(tags.packed, tags.of_map, tags.counts, tags.tempering, pose, parameters, tags.estimated)
    if phase is not None:
        nll, gradient, information = phase_scores(phase, pose.copy().reshape(1, 3), True)
        return nll[0], gradient[0], information[0], nll[0], 0.0
    if strength is not None:
        nll, gradient, information = strength_scores(strength, pose.copy().reshape(1, 3), True)
        return nll[0], gradient[0], information[0], nll[0], 0.0
    raise ValueError("expected one problem")


@compiled
def _corrected(
    tags: Any,
    phase: Any,
    strength: Any,
    tempering: float,
    pose: Array,
    values: Array,
    covariance: Array,
    iterations: int,
) -> tuple[Array, Array, float, int, float, float, float]:
    """Step (3 + P,), covariance, normalised innovation squared with degrees of freedom, excess of the prior negative log-likelihood
    and its variance, and log-evidence: see :meth:`RfidFactor.correct`."""
    size = len(covariance)
    nll, gradient, information, expected, variance = _score(tags, phase, strength, pose, values)
    prior_information = inverse(covariance)
    nis, dof = _innovation(gradient, information, covariance, tempering)
    excess, cost, best, changed, moved = nll - expected, nll, pose, values, np.zeros(size)
    for _ in range(iterations):
        step = _scoring_step(prior_information, information, gradient, moved)
        small = True
        for i in range(size):
            small = small and abs(step[i]) < CONVERGED * math.sqrt(covariance[i, i])
        if small:
            moved = _difference(pose, values, se2.moved(best, step), changed + step[3:])
            break
        lower = False
        for _ in range(4):
            tried, tried_values = se2.moved(best, step), changed + step[3:]
            nll, new_gradient, curve, _, _ = _score(tags, phase, strength, tried, tried_values)
            error, tried_cost = _difference(pose, values, tried, tried_values), nll
            for i in range(size):
                for j in range(size):
                    tried_cost += 0.5 * error[i] * prior_information[i, j] * error[j]
            lower = tried_cost <= cost
            if lower:
                best, changed, cost, moved = tried, tried_values, tried_cost, error
                gradient, information = new_gradient, curve
                break
            for i in range(size):
                step[i] /= 2.0
        if not lower:
            break
    posterior, log_ratio = _posterior(prior_information, information)
    return moved, posterior, nis, dof, excess, variance, 0.5 * log_ratio - cost


@compiled
def _difference(pose: Array, values: Array, target: Array, other_values: Array) -> Array:
    """The step (3 + P,) from one pose and its values to another."""
    out = np.empty(3 + len(values))
    out[0], out[1], out[2] = se2.twist_to(pose, target)
    for i in range(len(values)):
        out[3 + i] = other_values[i] - values[i]
    return out


@compiled
def _scoring_step(prior_information: Array, information: Array, gradient: Array, moved: Array) -> Array:
    """The step (D,) of Fisher scoring from where the state has ``moved`` (D,) to, shortened to the largest allowed."""
    size, both, pull = len(gradient), prior_information.copy(), np.empty((len(gradient), 1))
    for i in range(size):
        pull[i, 0] = -gradient[i]
        for j in range(size):
            both[i, j] += information[i, j]
            pull[i, 0] -= prior_information[i, j] * moved[j]
    solution, _ = solved(both, pull)
    step, share = np.empty(size), 1.0
    for i in range(size):
        largest = LARGEST_STEP[i] if i < 3 else LARGEST_CHANGE
        share = min(share, largest / max(abs(solution[i, 0]), 1e-12))
    for i in range(size):
        step[i] = share * solution[i, 0]
    return step


@compiled
def _posterior(prior_information: Array, information: Array) -> tuple[Array, float]:
    """Covariance (D, D) after an update, and the log of its determinant's ratio to that before."""
    size, both = len(information), prior_information.copy()
    for i in range(size):
        for j in range(size):
            both[i, j] += information[i, j]
    posterior, log_determinant = solved(both, np.eye(size))
    return posterior, solved(prior_information, np.empty((size, 0)))[1] - log_determinant


@compiled
def _innovation(gradient: Array, information: Array, covariance: Array, tempering: float) -> tuple[float, int]:
    """Normalised square of a score, and its degrees of freedom."""
    size, predicted, pull = (
        len(gradient),
        product(product(information, covariance), information),
        np.empty((len(gradient), 1)),
    )
    for i in range(size):
        pull[i, 0] = gradient[i]
        predicted[i, i] += RIDGE
        for j in range(size):
            predicted[i, j] += tempering * information[i, j]
    if covariance[0, 0] + covariance[1, 1] > FAR:
        # of one direction so much more than of the others that these would be lost
        units = np.empty(size)
        for i in range(size):
            units[i] = math.sqrt(predicted[i, i])
        for i in range(size):
            pull[i, 0] /= units[i]
            for j in range(size):
                predicted[i, j] /= units[i] * units[j]
            predicted[i, i] += ROUNDING
    scaled, nis = solved(predicted, pull)[0], 0.0
    for i in range(size):
        nis += pull[i, 0] * scaled[i, 0]
    return nis, _rank(information) if nis > 0.0 else 0


@compiled(error_model="numpy")
def _rank(information: Array) -> int:
    """The number of eigenvalues above :data:`LEAST_INFORMATION`: that of positive pivots of the matrix less this times the identity
    (Sylvester's law of inertia)."""
    size, left, count = len(information), information.copy(), 0
    for k in range(size):
        left[k, k] -= LEAST_INFORMATION
    for k in range(size):
        count += left[k, k] > 0.0
        for i in range(k + 1, size):
            share = left[i, k] / left[k, k]
            for j in range(k + 1, size):
                left[i, j] -= share * left[k, j]
    return count
