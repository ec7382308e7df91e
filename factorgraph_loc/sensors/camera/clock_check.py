"""Detects a time offset of the camera.

If images are taken later than their timestamps say, then a robot that turns faster than at the previous image appears to have
turned farther than the odometry says: the innovation is the time offset multiplied by the change of the turn rate. The offset is
the slope of a regression line. Noise of the odometry appears in both variables with opposite signs, so its contribution is
subtracted from the moments (errors in variables: Fuller, "Measurement Error Models", 1987, section 1.2). If the reported rates
vary less than that noise, wheel slip is the cause, and the rates are noise-free.
"""

from __future__ import annotations

import math

from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.measurement import Motion

TIME = 0.1  # s over which a turn rate is averaged
LONGEST = 2.0  # s between images
FEWEST = 40  # images
SIGNIFICANT, LARGE = 5.0, 0.03  # standard deviations, and s: lower limits of a reported offset
CLEAR = 0.3  # minimum share of the variance of the rate changes that is not noise
SLIPS = 1.5  # ratio of noise to that variance above which the noise is not in the reported rates


class ClockCheck:
    """Reports a time offset once, as an event; see the module."""

    def __init__(self, motion: Motion, diagnostics: Diagnostics) -> None:
        self._motion, self._diagnostics = motion, diagnostics
        self._last: tuple[float, float] | None = None  # time and turn rate
        self._count = 0
        self._xx = self._xy = self._yy = self._noise = 0.0

    def add(self, t: float, turned: float) -> None:
        """Add an image; ``turned`` [rad]: innovation of the heading, left is positive."""
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
