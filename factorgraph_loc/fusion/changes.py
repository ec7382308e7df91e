"""When a robot was carried elsewhere, and what a final trajectory tells of that.

Between the last time when it certainly was at the old place and the first when it certainly was at the new one nobody knows where
it was. There the final trajectory has no poses, so that scoring, which goes across no gap of more than :data:`MAX_GAP`, makes up
none.
"""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.model.scoring import MAX_GAP
from factors.se2 import Array

# s: the last time at the old place, -inf if it never was there, and the first at the new one
Change = tuple[float, float]
SPARE = 1e-3  # s: a gap is longer than what scoring goes across by so much


def is_known(t: Array, changes: Iterable[Change]) -> NDArray[np.bool_]:
    """At which of the times ``t`` (N,) the robot's place is told."""
    known = np.ones(len(t), dtype=bool)
    for before, after in changes:
        more = 0.5 * max(MAX_GAP + SPARE - (after - before), 0.0)
        known &= (t <= before - more) | (t >= after + more)
    return known
