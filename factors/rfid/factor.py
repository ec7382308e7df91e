"""Likelihoods of RFID reads and misses, signal strength and phase as factors on a pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from factors.compressed import compressed
from factors.rfid import kernels
from factors.rfid.detection import RfidLikelihood, Score, TagReadCounts
from factors.rfid.phase import PhaseLikelihood, PhaseReads, PhaseScore
from factors.rfid.strength import RssiLikelihood, RssiReads, RssiScore
from factors.se2 import Array

ROWS = 4  # of the residual
TagScore = Score | RssiScore | PhaseScore


@dataclass(frozen=True, eq=False)
class RfidFactor:
    """A likelihood of what was read, on the one pose (3,) that looks or reads are placed around, in compressed Fisher form:
    whatever their number there are four residuals, whose squares have the value, the gradient and the expected curvature of the
    likelihood. ``seen``: looks for a :class:`RfidLikelihood`, reads for the other two.

    ``estimated`` (P,): places, among the parameters of the detection models (:mod:`factors.rfid.kernels`), of those that are a
    second variable (P,) of looks; there are P residuals more then.
    """

    likelihood: RfidLikelihood | RssiLikelihood | PhaseLikelihood
    seen: TagReadCounts | RssiReads | PhaseReads
    estimated: tuple[int, ...] = ()

    @property
    def rows(self) -> int:
        """How many residuals there are."""
        return ROWS + len(self.estimated)

    @property
    def work(self) -> int:
        """How many reads and misses are looked at to tell the likelihood of one pose, about."""
        if isinstance(self.likelihood, RfidLikelihood) and isinstance(self.seen, TagReadCounts):
            return self.likelihood.work(self.seen)
        return len(self.seen.antennas)

    @property
    def is_phase(self) -> bool:
        """Whether it is a phase likelihood, which has many local optima, centimetres apart."""
        return isinstance(self.likelihood, PhaseLikelihood)

    def fixed(self, values: Array) -> RfidFactor:
        """The same on the pose alone, with the ``values`` (P,) of what is estimated."""
        if not isinstance(self.likelihood, RfidLikelihood):
            return self
        return replace(self, likelihood=self.likelihood.adjusted(self._parameters(values)), estimated=())

    def _parameters(self, values: Array) -> Array:
        """All parameters (..., 2 M) of the detection models for ``values`` (..., P) of those that are estimated."""
        assert isinstance(self.likelihood, RfidLikelihood)
        out = np.zeros((*values.shape[:-1], len(self.likelihood.parameters)))
        out[..., list(self.estimated)] = values
        return out

    def joint_score(self, values: Sequence[Array]) -> TagScore:
        """Of one pose (3,) and what is estimated (P,): gradient (1, 3 + P) and information (1, 3 + P, 3 + P) by both."""
        if not self.estimated:
            return self.score(values[0])
        assert isinstance(self.likelihood, RfidLikelihood)
        assert isinstance(self.seen, TagReadCounts)
        return self.likelihood.joint_score(values[0], self._parameters(values[1]), self.seen, self.estimated)

    def score(self, pose: Array) -> TagScore:
        """The score of one pose (3,); every field has a leading axis of length 1."""
        match self.likelihood, self.seen:
            case RfidLikelihood() as detection, TagReadCounts() as looks:
                return detection.score(pose, looks)
            case RssiLikelihood() as strength, RssiReads() as reads:
                return strength.score(pose, reads)
            case PhaseLikelihood() as phase, PhaseReads() as reads:
                return phase.score(pose, reads)
        raise TypeError(f"{type(self.likelihood).__name__} is not a likelihood of {type(self.seen).__name__}")

    def log_likelihood(self, poses: Array, values: Array | None = None) -> Array:
        """The tempered log-likelihood (N,) of poses (N, 3), with ``values`` (N, P) of what is estimated at each."""
        match self.likelihood, self.seen:
            case RfidLikelihood() as detection, TagReadCounts() as looks:
                return detection.log_likelihood(poses, looks, None if values is None else self._parameters(values))
            case RssiLikelihood() as strength, RssiReads() as reads:
                return strength.log_likelihood(poses, reads)
            case PhaseLikelihood() as phase, PhaseReads() as reads:
                return phase.log_likelihood(poses, reads)
        raise TypeError(f"{type(self.likelihood).__name__} is not a likelihood of {type(self.seen).__name__}")

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Residual (4 + P,) and its Jacobians (4 + P, 3) by the pose and, of P > 0, (4 + P, P)."""
        score = self.joint_score(values)
        residual, jacobian = compressed(float(score.nll[0]), score.gradient[0], score.information[0])
        return residual, [jacobian[:, :3], jacobian[:, 3:]] if self.estimated else [jacobian]

    def cost(self, values: Sequence[Array]) -> float:
        """The tempered negative log-likelihood."""
        return float((self.fixed(values[1]) if self.estimated else self).score(values[0]).nll[0])


@dataclass(frozen=True, eq=False)
class RfidTagFactor:
    """The likelihood of read counts of tag number ``tag`` of ``likelihood``, as a factor on the pose (3,) and the tag's position
    (2,) in the world, in compressed Fisher form (:mod:`factors.compressed`): whatever the number of reads there are six
    residuals.

    Height and facing of the tag are those in ``likelihood``; its position there is not used.
    """

    likelihood: RfidLikelihood
    tag: int
    looks: TagReadCounts

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
        tags, looks, alpha = self.likelihood.tags, self.looks, self.likelihood.model.tempering
        point = np.array([(values[1][0], values[1][1], tags.points[self.tag, 2])])
        hits = np.ascontiguousarray(looks.hits[:, self.tag : self.tag + 1])
        arrays = point, tags.normals[self.tag : self.tag + 1], looks.offsets, looks.antennas, looks.rounds, hits
        nll, slope, curve = kernels.by_tag(self.likelihood.packed, np.asarray(values[0], dtype=float), *arrays)
        return float(alpha * nll[0]), alpha * slope[0], alpha * curve[0]
