"""What RFID antennas read and did not read, as a factor on a pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factors.compressed import compressed
from factors.rfid_likelihood import Looks, RfidLikelihood
from factors.se2 import Array

ROWS = 4  # of the residual


@dataclass(frozen=True, eq=False)
class RfidFactor:
    """The likelihood of looks at tags, on the one pose (3,) that they are placed around, in compressed Fisher form: whatever their
    number there are four residuals, whose squares have the value, the gradient and the expected curvature of the likelihood."""

    likelihood: RfidLikelihood
    looks: Looks

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Residual (4,) and its Jacobian (4, 3)."""
        score = self.likelihood.score(values[0], self.looks)
        residual, jacobian = compressed(float(score.nll[0]), score.gradient[0], score.information[0])
        return residual, [jacobian]

    def cost(self, values: Sequence[Array]) -> float:
        """The tempered negative log-likelihood."""
        return float(self.likelihood.score(values[0], self.looks).nll[0])
