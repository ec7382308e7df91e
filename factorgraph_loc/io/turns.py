"""Compares the turns of a robot in two tables of one drive, to find their clock offset and the ratio of their units."""

from dataclasses import dataclass

import numpy as np
from scipy.signal import correlate

from factors.se2 import Array

STEP = 0.05  # s between the times at which turns are compared
WINDOW = 1.0  # s over which a turn is measured
ALIKE = 0.9  # minimum correlation of the turns in two tables of one drive
DISTINCT = 2.0  # minimum ratio of 1 - correlation at other offsets to 1 - correlation at the best offset
NEAR = 5.0  # s: minimum difference of another offset from the best offset
LONGEST = 86400.0  # s: maximum duration of a table; a longer duration shows that its clock was set meanwhile
OVERLAP = 0.9  # minimum fraction of the shorter table that must overlap the other table


@dataclass(frozen=True)
class Turns:
    """The heading of a robot over time, from one table. ``t`` (N,): times [s]. ``angle`` (N,): the unwrapped heading in
    any unit."""

    t: Array
    angle: Array

    def each_window(self) -> Array:
        """Return the changes of the angle (K,) in K windows of length :data:`WINDOW` that begin every :data:`STEP`."""
        grid = np.arange(self.t[0], self.t[-1], STEP)
        angle = np.interp(grid, self.t, self.angle)
        width = round(WINDOW / STEP)
        return np.asarray(angle[width:] - angle[:-width])


@dataclass(frozen=True)
class SameTurns:
    """The clock offset and the ratio of angles between two tables that recorded the same turns of a robot.

    ``offset`` [s]: the clock of the first table minus the clock of the second; None if the turns agree at several
    offsets. ``ratio``: the angle of the first table divided by the angle of the second.
    """

    offset: float | None
    ratio: float


def match(first: Turns, second: Turns) -> SameTurns | None:
    """Return the clock offset at which two tables have the same turns of the robot, and the ratio of their angles.

    Returns None if they agree at no offset, as on a straight drive, or if a table lasts longer than :data:`LONGEST`.
    """
    if not all(0.0 < turns.t[-1] - turns.t[0] < LONGEST for turns in (first, second)):
        return None
    a, b = first.each_window(), second.each_window()
    if not len(a) or not len(b):
        return None
    products = correlate(a, b)
    in_a, in_b = correlate(a**2, np.ones(len(b))), correlate(np.ones(len(a)), b**2)
    lags = np.arange(1 - len(b), len(a))
    compared = np.minimum(len(a), lags + len(b)) - np.maximum(0, lags)
    usable = (compared >= OVERLAP * min(len(a), len(b))) & (np.minimum(in_a, in_b) > 1e-9 * max(in_a.max(), in_b.max()))
    if not usable.any():
        return None
    likeness = np.where(usable, products / np.sqrt(np.where(usable, in_a * in_b, 1.0)), -1.0)
    best = int(np.argmax(likeness))
    elsewhere = likeness[np.abs(lags - lags[best]) > NEAR / STEP].max(initial=-1.0)
    if likeness[best] < ALIKE:
        return None
    is_distinct = 1.0 - elsewhere > DISTINCT * (1.0 - likeness[best])
    offset = first.t[0] - second.t[0] + STEP * float(lags[best]) if is_distinct else None
    return SameTurns(offset, float(products[best] / in_b[best]))
