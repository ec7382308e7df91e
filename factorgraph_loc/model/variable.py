"""Sensor constants that are estimated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_loc.files.models import FileModel
from factors.se2 import Array


@dataclass(frozen=True)
class Estimated:
    """The constants of a sensor that are estimated, as corrections to the rig's values.

    ``names`` (P,): their names; ``indices`` (P,): their indices among all constants; ``sigmas`` (P,): prior standard deviations.
    """

    names: tuple[str, ...]
    indices: tuple[int, ...]
    sigmas: Array

    @staticmethod
    def of(names: Sequence[str], uncertainty: FileModel | None) -> Estimated:
        """Those of ``names`` whose uncertainty is above zero."""
        return Estimated.among(names, np.array([getattr(uncertainty, name, 0.0) for name in names]))

    @staticmethod
    def among(names: Sequence[str], sigmas: Array) -> Estimated:
        """Those of ``names`` (P,) whose ``sigmas`` (P,) are above zero."""
        indices = tuple(np.flatnonzero(sigmas).tolist())
        return Estimated(tuple(names[i] for i in indices), indices, sigmas[list(indices)])

    def full(self, values: Array, count: int) -> Array:
        """``values`` (..., P) inserted among all ``count`` constants; the others are zero."""
        out = np.zeros((*np.shape(values)[:-1], count))
        out[..., list(self.indices)] = values
        return out


NOTHING = Estimated((), (), np.zeros(0))
