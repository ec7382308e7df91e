"""The version of the scoring rule and the settings of scoring; importable without numerical libraries."""

import math
from typing import Literal

from factorgraph_loc.errors import InputError

RULE = 2  # 2: estimates are interpolated at the reference's timestamps; 1: the reference at those of the estimates
MAX_GAP = 0.5  # s between estimates across which scoring interpolates
MAX_DIFF = 0.01  # s between stamps that are taken for one
Alignment = Literal["none", "origin", "se2", "se3", "sim3"]
ALIGNMENTS: tuple[Alignment, ...] = ("none", "origin", "se2", "se3", "sim3")
Association = Literal["nearest", "interpolate"]
ASSOCIATIONS: tuple[Association, ...] = ("nearest", "interpolate")


def check_max_gap(max_gap: float) -> None:
    """InputError if ``max_gap`` is not positive."""
    if not 0.0 < max_gap < math.inf:
        raise InputError(f"max_gap is {max_gap:g}, expected a time above 0 s")
