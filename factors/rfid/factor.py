"""What RFID antennas read and did not read, how strongly and with which phase, as factors on a pose."""

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
    """A likelihood of what was read, on the one pose (3,) that looks or reads are placed around, in compressed Fisher form:
    whatever their number there are four residuals, whose squares have the value, the gradient and the expected curvature of the
    likelihood. ``seen``: looks for a :class:`RfidLikelihood`, reads for the other two."""

    likelihood: RfidLikelihood | RssiLikelihood | PhaseLikelihood
    seen: TagReadCounts | RssiReads | PhaseReads

    @property
    def is_phase(self) -> bool:
        """Whether it has many optima, centimetres apart."""
        return isinstance(self.likelihood, PhaseLikelihood)

    def with_odds(self, odds: Array) -> RfidFactor:
        """The same, with other log-odds (T,) that each tag is dead; these are of looks alone."""
        return replace(self, seen=replace(self.seen, odds=odds)) if isinstance(self.seen, TagReadCounts) else self

    def score(self, pose: Array) -> TagScore:
        """Of one pose (3,); every part has a leading axis of length 1."""
        match self.likelihood, self.seen:
            case RfidLikelihood() as detection, TagReadCounts() as looks:
                return detection.score(pose, looks)
            case RssiLikelihood() as strength, RssiReads() as reads:
                return strength.score(pose, reads)
            case PhaseLikelihood() as phase, PhaseReads() as reads:
                return phase.score(pose, reads)
        raise TypeError(f"{type(self.likelihood).__name__} is no likelihood of {type(self.seen).__name__}")

    def log_likelihood(self, poses: Array) -> Array:
        """The tempered log-likelihood (N,) of poses (N, 3)."""
        match self.likelihood, self.seen:
            case RfidLikelihood() as detection, TagReadCounts() as looks:
                return detection.log_likelihood(poses, looks)
            case RssiLikelihood() as strength, RssiReads() as reads:
                return strength.log_likelihood(poses, reads)
            case PhaseLikelihood() as phase, PhaseReads() as reads:
                return phase.log_likelihood(poses, reads)
        raise TypeError(f"{type(self.likelihood).__name__} is no likelihood of {type(self.seen).__name__}")

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Residual (4,) and its Jacobian (4, 3)."""
        score = self.score(values[0])
        residual, jacobian = compressed(float(score.nll[0]), score.gradient[0], score.information[0])
        return residual, [jacobian]

    def cost(self, values: Sequence[Array]) -> float:
        """The tempered negative log-likelihood."""
        return float(self.score(values[0]).nll[0])
