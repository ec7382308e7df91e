"""Constants of a sensor that an estimator learns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_loc.files.models import FileModel
from factors.se2 import Array


@dataclass(frozen=True)
class Estimated:
    """Constants of a sensor that an estimator learns, as changes from the rig's values.

    ``names`` (P,): of the constants; ``indices`` (P,): their places among all that could be; ``sigmas`` (P,): their priors'.
    """

    names: tuple[str, ...]
    indices: tuple[int, ...]
    sigmas: Array

    @staticmethod
    def of(names: Sequence[str], uncertainty: FileModel | None) -> Estimated:
        """Those of ``names`` whose uncertainty is above zero."""
        sigmas = np.array([getattr(uncertainty, name, 0.0) for name in names])
        indices = tuple(np.flatnonzero(sigmas).tolist())
        return Estimated(tuple(names[i] for i in indices), indices, sigmas[list(indices)])

    def full(self, values: Array, count: int) -> Array:
        """``values`` (..., P) among all ``count`` constants, the others zero."""
        out = np.zeros((*np.shape(values)[:-1], count))
        out[..., list(self.indices)] = values
        return out


NOTHING = Estimated((), (), np.zeros(0))
