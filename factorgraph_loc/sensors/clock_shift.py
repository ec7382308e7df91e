"""How far apart the clocks of two streams are, where they tell of the same motion: shifts of time that are tried, and the line that
says what was found."""

import numpy as np

STEP = 0.05  # s between times and between shifts that are compared
FARTHEST = 2.5  # s of shift
SHIFTS = np.arange(-round(FARTHEST / STEP), round(FARTHEST / STEP) + 1)  # in steps
LARGE = 0.15  # s: of a shift that is told
BETTER = 0.7  # what is left unexplained at a shift that is told, at most, of what is at none
FEWEST = 200  # times, and sightings, that are compared
SLOWEST = 1.0  # s between poses of a reference that tells rates


def line(name: str, shift: float, than: str, setting: str, offset: float) -> str:
    """That ``name`` is stamped ``shift`` [s] later than ``than``, and that a ``time_offset`` [s] in the rig mends it."""
    late = "later" if shift > 0.0 else "earlier"
    mends = f"{setting}.time_offset = {offset:+.2f}"
    return f"{name} is stamped about {abs(shift):.2f} s {late} than {than}: {mends} in the rig"
