"""Factors of RFID measurements (reads and misses, signal strength, phase), and the correction of a Gaussian by them."""

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

ROWS = 4  # number of residuals of a factor on a pose
CONVERGED = 0.1  # a correction ends when a step is smaller than this fraction of the standard deviations
LARGEST_STEP = np.array((0.5, 0.5, 0.3))  # m, m, rad: largest step of a pose before the likelihood is evaluated again
LARGEST_CHANGE = 0.5  # largest step of a parameter of a detection model
ITERATIONS = 4  # maximum number of steps of a correction
RIDGE = 1e-9  # is added to the diagonal of an information matrix that may be singular
LEAST_INFORMATION = 1e-6  # smaller eigenvalues of an information matrix do not count as degrees of freedom
NO_VALUES = np.zeros(0)  # values of the estimated parameters if there are none
NO_RESIDUAL = np.empty((0, 1))  # residuals of a correction by a likelihood


class TagLikelihood(Protocol):
    """The interface of a likelihood of read counts, signal strengths or phases as a function of the robot's pose."""

    @property
    def model(self) -> Any:
        """The measurement model, with an attribute ``tempering``, the exponent of the likelihood."""

    def score(self, poses: Array, reads: Any, /) -> Score:
        """Return the tempered likelihood of ``reads`` (counts, strengths, phases) at poses (N, 3), with derivatives."""

    def log_likelihood(self, poses: Array, reads: Any, /) -> Array:
        """Return the tempered log-likelihood (N,) of ``reads`` at poses (N, 3), without derivatives, for particles."""


class TagProblem(NamedTuple):
    """The likelihood of RFID read counts, as a tuple for compiled code. ``packed``: detection models with all
    parameters zero. ``of_map``: the tags of the map. ``counts``: numbers of reads and of inventory rounds.
    ``tempering``: exponent of the likelihood. ``parameters`` (Q,): calibration of the models. ``estimated`` (P,):
    indices of the estimated parameters."""

    packed: Packed
    of_map: MapTags
    counts: Counts
    tempering: float
    parameters: Array
    estimated: Integers


@dataclass(frozen=True, eq=False)
class RfidFactor:
    """RFID measurements as a factor on the robot's pose, and optionally on parameters of the read model.

    ``likelihood``: a likelihood of read counts, signal strengths or phases.
    ``reads``: :class:`~factors.rfid.detection.TagReadCounts` for an :class:`~factors.rfid.detection.RfidLikelihood`,
    otherwise :class:`~factors.rfid.signals.RssiReads` or :class:`~factors.rfid.signals.PhaseReads`.
    ``estimated`` (P,): indices of the estimated parameters (:mod:`factors.rfid.parameters`). Only for read counts.

    Methods with sequences ``values`` take a list of the pose (3,) and, if P > 0, the parameters (P,). For any number of
    reads there are 4 + P residuals. Half the sum of their squares has the value, the gradient and the Fisher
    information of the negative log-likelihood (:func:`factors.graph.compressed`).
    """

    likelihood: TagLikelihood
    reads: TagReadCounts | TagReads
    estimated: tuple[int, ...] = ()

    @property
    def rows(self) -> int:
        """The number of residuals: 4 plus the number of estimated parameters."""
        return ROWS + len(self.estimated)

    @property
    def work(self) -> int:
        """An estimate of the computing time at one pose. The unit is the evaluation of one read or missed read."""
        if isinstance(self.likelihood, RfidLikelihood) and isinstance(self.reads, TagReadCounts):
            return self.likelihood.work(self.reads)
        return len(self.reads.antennas)

    def fixed(self, values: Array) -> RfidFactor:
        """Return the factor on the pose only, with the estimated parameters fixed at ``values`` (P,)."""
        if not isinstance(self.likelihood, RfidLikelihood):
            return self
        return replace(self, likelihood=self.likelihood.adjusted(self._parameters(values)), estimated=())

    def _parameters(self, values: Array) -> Array:
        """Return all parameters (..., Q): ``values`` (..., P) of the estimated parameters, and zeros for the others."""
        assert isinstance(self.likelihood, RfidLikelihood)
        out = np.zeros((*values.shape[:-1], len(self.likelihood.parameters)))
        out[..., list(self.estimated)] = values
        return out

    def score(self, values: Sequence[Array]) -> Score:
        """Return the tempered negative log-likelihood with its gradient (1, 3 + P) and Fisher information (1, 3 + P, 3
        + P). ``values``: one pose (3,) and, if P > 0, the estimated parameters (P,)."""
        if not self.estimated:
            return self.likelihood.score(values[0], self.reads)
        assert isinstance(self.likelihood, RfidLikelihood)
        assert isinstance(self.reads, TagReadCounts)
        return self.likelihood.joint_score(values[0], self._parameters(values[1]), self.reads, self.estimated)

    def log_likelihood(self, poses: Array, values: Array | None = None) -> Array:
        """Return the tempered log-likelihood (N,) of poses (N, 3). ``values`` (N, P): the estimated parameters of each
        pose. None means the parameters of the likelihood."""
        if values is None:
            return self.likelihood.log_likelihood(poses, self.reads)
        assert isinstance(self.likelihood, RfidLikelihood)
        assert isinstance(self.reads, TagReadCounts)
        return self.likelihood.log_likelihood(poses, self.reads, self._parameters(values))

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Return the residual (4 + P,) and a list of its Jacobians, by the pose (4 + P, 3) and by the estimated
        parameters (4 + P, P). ``values``: the pose (3,) and the parameters (P,). If P is 0, the latter are left out."""
        score = self.score(values)
        residual, jacobian = compressed(float(score.nll[0]), score.gradient[0], score.information[0])
        return residual, [jacobian[:, :3], jacobian[:, 3:]] if self.estimated else [jacobian]

    def cost(self, values: Sequence[Array]) -> float:
        """Return the tempered negative log-likelihood. ``values``: the pose (3,) and, if P > 0, the parameters (P,)."""
        return float((self.fixed(values[1]) if self.estimated else self).score(values[:1]).nll[0])

    def correct(
        self, pose: Array, covariance: Array, values: Array = NO_VALUES, iterations: int = ITERATIONS
    ) -> Correction:
        """Correct a Gaussian estimate of the pose and the estimated parameters, by Fisher scoring.

        ``pose`` (3,), ``values`` (P,): the prediction. ``covariance`` (3 + P, 3 + P): its covariance, with a body-frame
        perturbation of the pose. ``iterations``: maximum number of steps. A step that does not reduce the cost is
        halved. Returns the correction, with ``evidence`` by Laplace's method.
        """
        pose, covariance = np.ascontiguousarray(pose, dtype=float), np.ascontiguousarray(covariance, dtype=float)
        problem = (*self._problems(), float(self.likelihood.model.tempering), pose, values)
        try:
            delta, posterior, nis, dof, *rest = _corrected(*problem, covariance, iterations)
        except np.linalg.LinAlgError:  # the covariance is singular because of rounding
            delta, posterior, nis, dof, *rest = _corrected(*problem, positive.nearest(covariance), iterations)
        return Correction(delta, posterior, NO_RESIDUAL, nis, dof, *rest)

    def _problems(self) -> tuple[TagProblem | None, PhaseProblem | None, StrengthProblem | None]:
        """Return the likelihood and reads for compiled code: read counts, phases and strengths, two of them None."""
        match self.likelihood, self.reads:
            case RfidLikelihood() as detection, TagReadCounts() as counts:
                estimated, alpha = np.array(self.estimated, dtype=np.int64), float(detection.model.tempering)
                known = *detection.arrays, counts.packed, alpha, detection.parameters
                return TagProblem(*known, estimated), None, None
            case PhaseLikelihood() as phase, PhaseReads() as phases:
                return None, phase.problem(phases), None
            case RssiLikelihood() as strength, RssiReads() as strengths:
                return None, None, strength.problem(strengths)
        raise TypeError(f"a {type(self.likelihood).__name__} does not accept {type(self.reads).__name__} as reads")


@dataclass(frozen=True, eq=False)
class RfidTagFactor:
    """The read counts of one RFID tag as a factor on the robot's pose and on the tag's position.

    ``likelihood``: has the tag in its map. The tag's height and facing are those of the map. Its position is estimated.
    ``tag``: the index of the tag in the map. ``counts``: reads that list all tags of the map.

    The methods take ``values``, a list of the pose (3,) and the tag's position (2,) in the world. For any number of
    reads there are six residuals, see :func:`factors.graph.compressed`.
    """

    likelihood: RfidLikelihood
    tag: int
    counts: TagReadCounts

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Return the residual (6,), and its Jacobians by ``values``: the pose (6, 3) and the tag's position (6, 2)."""
        nll, gradient, information = self.score(values)
        residual, jacobian = compressed(nll, gradient, information)
        return residual, [jacobian[:, :3], jacobian[:, 3:]]

    def cost(self, values: Sequence[Array]) -> float:
        """Return the tempered negative log-likelihood. ``values``: the pose (3,) and the tag's position (2,)."""
        return self.score(values)[0]

    def score(self, values: Sequence[Array]) -> tuple[float, Array, Array]:
        """Return the tempered negative log-likelihood, its gradient (5,) and its Fisher information (5, 5). Derivatives
        are by ``values``: the body-frame perturbation of the pose (3) and the position of the tag in the world (2)."""
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
    """Evaluate the likelihood of one pose (3,) and parameters ``values`` (P,). ``tags``, ``phase``, ``strength``: from
    :meth:`RfidFactor._problems`, two of them None. Returns the tempered negative log-likelihood, its gradient (3 + P,)
    and information (3 + P, 3 + P), and its mean and variance as in :class:`~factors.rfid.detection.Score`."""
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
    raise ValueError("read counts, phases and strengths are all None, expected one of them")


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
    """Return the seven results of :meth:`RfidFactor.correct`, computed in compiled code. They are the correction (3 +
    P,), the covariance after it, the normalised innovation squared and its degrees of freedom, the negative
    log-likelihood of the prediction minus its mean, its variance, and the log-evidence. ``tags`` to ``strength``: see
    :func:`_score`."""
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
    """Return the step (3 + P,) from ``pose`` (3,) and ``values`` (P,) to ``target`` (3,) and ``other_values`` (P,). Its
    first three components are the twist from ``pose`` to ``target``."""
    out = np.empty(3 + len(values))
    out[0], out[1], out[2] = se2.twist_to(pose, target)
    for i in range(len(values)):
        out[3 + i] = other_values[i] - values[i]
    return out


@compiled
def _scoring_step(prior_information: Array, information: Array, gradient: Array, moved: Array) -> Array:
    """Return one step (D,) of Fisher scoring, shortened to the largest allowed step. ``prior_information`` (D, D): the
    inverse covariance of the prediction. ``information`` (D, D), ``gradient`` (D,): of the negative log-likelihood.
    ``moved`` (D,): the sum of all steps so far."""
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
    """Return the covariance (D, D) after ``information`` is added to that of the prior, and its change of log
    determinant."""
    size, both = len(information), prior_information.copy()
    for i in range(size):
        for j in range(size):
            both[i, j] += information[i, j]
    posterior, log_determinant = solved(both, np.eye(size))
    return posterior, solved(prior_information, np.empty((size, 0)))[1] - log_determinant


@compiled
def _innovation(gradient: Array, information: Array, covariance: Array, tempering: float) -> tuple[float, int]:
    """Return the normalised innovation squared of a likelihood and its degrees of freedom. ``gradient`` (D,),
    ``information`` (D, D): tempered by ``tempering``, at the prediction with ``covariance`` (D, D)."""
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
        # scale all components to unit variance, because rounding would delete small variances next to very large ones
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
    """Return the number of eigenvalues above :data:`LEAST_INFORMATION`, by positive pivots (Sylvester's law)."""
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
