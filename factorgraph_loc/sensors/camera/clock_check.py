"""Whether a camera's images were taken when their stamps say.

A robot that turns faster than at the image before is seen to have turned farther than the odometry says, if images are taken later
than they are stamped: the estimate before was corrected by what was seen then, so that the innovation is the offset of time
multiplied by the change of the turn rate. A line through both tells the offset. Noise in what the odometry reports is in both, with
opposite signs: what it adds to their moments is taken off (errors in variables: Fuller, "Measurement Error Models", 1987,
section 1.2). Where the reported rates vary less than that noise, it is the robot that slips, and they have none.
"""

from __future__ import annotations

import math

from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.motion import Motion

TIME = 0.1  # s over which a turn rate is taken
LONGEST = 2.0  # s between images
FEWEST = 40  # images
SIGNIFICANT, LARGE = 5.0, 0.03  # standard deviations, and s: of an offset that is told
CLEAR = 0.3  # share of the changes' square, at least, that is no noise
SLIPS = 1.5  # of noise to the changes' square: beyond it the noise is not in what is reported


class ClockCheck:
    """Tells by an event, once, if images are off; see the module."""

    def __init__(self, motion: Motion, diagnostics: Diagnostics) -> None:
        self._motion, self._diagnostics = motion, diagnostics
        self._last: tuple[float, float] | None = None  # time and turn rate
        self._count = 0
        self._xx = self._xy = self._yy = self._noise = 0.0

    def add(self, t: float, turned: float) -> None:
        """Take an image that shows the robot ``turned`` farther to the left [rad] than was predicted."""
        moved = self._motion.relative(self._motion.state(t - TIME), self._motion.state(t))
        rate, noise = float(moved.delta[2]) / TIME, float(moved.covariance[2, 2])
        last, self._last = self._last, (t, rate)
        if last is None or not 0.0 < t - last[0] < LONGEST or self._count < 0:
            return
        change = rate - last[1]
        self._count += 1
        self._noise += 2.0 * noise / TIME**2
        self._xx, self._xy, self._yy = self._xx + change**2, self._xy + change * turned, self._yy + turned**2
        slips = self._noise > SLIPS * self._xx
        clear = self._xx if slips else self._xx - self._noise
        if self._count < FEWEST or clear <= CLEAR * self._xx:
            return
        offset = (self._xy if slips else self._xy + 0.5 * TIME * self._noise) / clear
        sigma = math.sqrt(max(self._yy - offset * self._xy, 0.0) / self._count * self._xx) / clear
        if abs(offset) > max(SIGNIFICANT * sigma, LARGE):
            self._count = -1
            late = "later" if offset > 0.0 else "earlier"
            what = f"camera: images seem to be taken {abs(offset):.2f} s {late} than they are stamped (time_offset)"
            self._diagnostics.events.append((t, what))
