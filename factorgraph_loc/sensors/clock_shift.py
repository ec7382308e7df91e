"""Time shifts tried to find the clock offset between two streams that measure the same motion, and the resulting message."""

import numpy as np

STEP = 0.05  # s between compared times and between shifts
FARTHEST = 2.5  # s; largest shift
SHIFTS = np.arange(-round(FARTHEST / STEP), round(FARTHEST / STEP) + 1)  # in steps
LARGE = 0.15  # s; smallest shift that is reported
BETTER = 0.7  # largest ratio of the residual at a reported shift to that without a shift
FEWEST = 200  # minimum number of times and sightings
SLOWEST = 1.0  # s; longest interval between reference poses that still gives rates


def line(name: str, shift: float, than: str, setting: str, offset: float) -> str:
    """The message that ``name`` is stamped ``shift`` [s] later than ``than``, with the ``time_offset`` [s] that corrects it."""
    late = "later" if shift > 0.0 else "earlier"
    mends = f"{setting}.time_offset = {offset:+.2f}"
    return f"{name} is stamped about {abs(shift):.2f} s {late} than {than}: set {mends} in the rig"
