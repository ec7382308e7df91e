"""The rule by which runs are scored, and its one setting; light enough for what only plans runs."""

import math

from factorgraph_loc.errors import InputError

RULE = 2  # estimates are taken at the reference's stamps; by rule 1 the reference was taken at those of the estimates
MAX_GAP = 0.5  # s between estimates that are interpolated


def check_max_gap(max_gap: float) -> None:
    """InputError if that is no time between estimates."""
    if not 0.0 < max_gap < math.inf:
        raise InputError(f"max_gap is {max_gap:g}, expected a time above 0 s")
