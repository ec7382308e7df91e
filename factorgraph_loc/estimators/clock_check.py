"""Whether a camera's images were taken when their stamps say.

A robot that turns faster than at the image before is seen to have turned farther than the odometry says, if images are taken later
than they are stamped: the estimate before was corrected by what was seen then, so that the innovation is the offset of time
multiplied by the change of the turn rate. A line through both tells the offset.
"""

from __future__ import annotations

import math

from factorgraph_loc.estimators.base import Diagnostics
from factorgraph_loc.estimators.motion import Motion

TIME = 0.1  # s over which a turn rate is taken
LONGEST = 2.0  # s between images
FEWEST = 40  # images
SIGNIFICANT, LARGE = 5.0, 0.03  # standard deviations, and s: of an offset that is told


class ClockCheck:
    """Tells by an event, once, if images are off; see the module."""

    def __init__(self, motion: Motion, diagnostics: Diagnostics) -> None:
        self._motion, self._diagnostics = motion, diagnostics
        self._last: tuple[float, float] | None = None  # time and turn rate
        self._count = 0
        self._xx = self._xy = self._yy = 0.0

    def add(self, t: float, turned: float) -> None:
        """Take an image that shows the robot ``turned`` farther to the left [rad] than was predicted."""
        rate = (self._motion.state(t).heading - self._motion.state(t - TIME).heading) / TIME
        last, self._last = self._last, (t, rate)
        if last is None or not 0.0 < t - last[0] < LONGEST or self._count < 0:
            return
        change = rate - last[1]
        self._count += 1
        self._xx, self._xy, self._yy = self._xx + change**2, self._xy + change * turned, self._yy + turned**2
        if self._count < FEWEST or self._xx == 0.0:
            return
        offset = self._xy / self._xx
        sigma = math.sqrt(max(self._yy - offset * self._xy, 0.0) / (self._count * self._xx))
        if abs(offset) > max(SIGNIFICANT * sigma, LARGE):
            self._count = -1
            late = "later" if offset > 0.0 else "earlier"
            what = f"camera: images seem to be taken {abs(offset):.2f} s {late} than they are stamped (time_offset)"
            self._diagnostics.events.append((t, what))
