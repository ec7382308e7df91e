"""Likelihoods of RFID reads and misses, signal strength and phase as factors on a pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from factors.compressed import compressed
from factors.rfid.detection import RfidLikelihood, Score, TagReadCounts
from factors.rfid.phase import PhaseLikelihood, PhaseReads, PhaseScore
from factors.rfid.strength import RssiLikelihood, RssiReads, RssiScore
from factors.se2 import Array

ROWS = 4  # of the residual
TagScore = Score | RssiScore | PhaseScore


@dataclass(frozen=True, eq=False)
class RfidFactor:
    """An RFID likelihood as a factor on one pose (3,), in compressed Fisher form: four residuals with the value, the gradient and
    the expected curvature of the likelihood. ``seen``: read counts for :class:`RfidLikelihood`, reads for the other two."""

    likelihood: RfidLikelihood | RssiLikelihood | PhaseLikelihood
    seen: TagReadCounts | RssiReads | PhaseReads

    @property
    def is_phase(self) -> bool:
        """Whether it is a phase likelihood, which has many local optima, centimetres apart."""
        return isinstance(self.likelihood, PhaseLikelihood)

    def with_odds(self, odds: Array) -> RfidFactor:
        """The factor with other log-odds (T,) that each tag is dead; for read counts only."""
        return replace(self, seen=replace(self.seen, odds=odds)) if isinstance(self.seen, TagReadCounts) else self

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

    def log_likelihood(self, poses: Array) -> Array:
        """The tempered log-likelihood (N,) of poses (N, 3)."""
        match self.likelihood, self.seen:
            case RfidLikelihood() as detection, TagReadCounts() as looks:
                return detection.log_likelihood(poses, looks)
            case RssiLikelihood() as strength, RssiReads() as reads:
                return strength.log_likelihood(poses, reads)
            case PhaseLikelihood() as phase, PhaseReads() as reads:
                return phase.log_likelihood(poses, reads)
        raise TypeError(f"{type(self.likelihood).__name__} is not a likelihood of {type(self.seen).__name__}")

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Residual (4,) and its Jacobian (4, 3)."""
        score = self.score(values[0])
        residual, jacobian = compressed(float(score.nll[0]), score.gradient[0], score.information[0])
        return residual, [jacobian]

    def cost(self, values: Sequence[Array]) -> float:
        """The tempered negative log-likelihood."""
        return float(self.score(values[0]).nll[0])
