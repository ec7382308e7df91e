"""The odometry of a run so far, as a chain of knots in its own frame.

Between knots the robot follows a circular arc (Thrun, Burgard, Fox, "Probabilistic Robotics", 2005, eq. 5.9).
Commanded velocities act after a delay and through a first-order lag, ``v' = (u(t - delay) - v) / lag``.
"""

import bisect
import math
from dataclasses import dataclass

import numpy as np

from factors import se2
from factors.odometry import ChainState, Increment, OdometryModel, relative_motion


@dataclass(frozen=True, slots=True)
class _Row:
    t: float  # when it takes effect
    kind: str  # velocity, increment or gyro
    values: tuple[float, ...]


class _Knot:
    """State at the time of a row, and the motion that follows until the next one."""

    __slots__ = ("heading", "path", "t", "turn", "unknown", "uw", "ux", "uy", "vx", "vy", "w", "x", "y")

    def __init__(self, t: float) -> None:
        self.t = t
        self.x = self.y = self.heading = 0.0
        self.path = self.turn = self.unknown = 0.0
        self.vx = self.vy = self.w = 0.0  # velocity in the robot's frame, now
        self.ux = self.uy = self.uw = 0.0  # the velocity that it tends to

    def state(self) -> ChainState:
        return ChainState(self.t, self.x, self.y, self.heading, self.path, self.turn, self.unknown)

    def after(self, duration: float, lag: float, hold: float) -> "_Knot":
        """The state ``duration`` seconds on: the motion goes on for at most ``hold`` of them, then it is unknown."""
        k = _Knot(self.t + duration)
        k.ux, k.uy, k.uw = self.ux, self.uy, self.uw
        moving = min(duration, hold)
        if lag > 0.0:
            decay = math.exp(-moving / lag)
            settling = lag * (1.0 - decay)
            dx = self.ux * moving + (self.vx - self.ux) * settling
            dy = self.uy * moving + (self.vy - self.uy) * settling
            dtheta = self.uw * moving + (self.w - self.uw) * settling
            k.vx = self.ux + (self.vx - self.ux) * decay
            k.vy = self.uy + (self.vy - self.uy) * decay
            k.w = self.uw + (self.w - self.uw) * decay
        else:
            k.vx, k.vy, k.w = self.ux, self.uy, self.uw
            dx, dy, dtheta = self.ux * moving, self.uy * moving, self.uw * moving
        if duration > hold:
            k.vx = k.vy = k.w = 0.0
        a, b = se2.arc_coefficients(dtheta)
        c, s = math.cos(self.heading), math.sin(self.heading)
        chord_x, chord_y = a * dx - b * dy, b * dx + a * dy
        k.x = self.x + c * chord_x - s * chord_y
        k.y = self.y + s * chord_x + c * chord_y
        k.heading = self.heading + dtheta
        k.path = self.path + math.hypot(dx, dy)
        k.turn = self.turn + abs(dtheta)
        k.unknown = self.unknown + duration - moving
        return k


class OdometryChain:
    """The odometry of a run so far, as a chain of knots in its own frame.

    Rows come in time order, or late (then the knots behind them are computed anew). Beyond the last row its velocity is held.
    What lies more than ``horizon`` seconds before the newest row is forgotten; adding a row older than that returns False.
    """

    def __init__(self, model: OdometryModel, *, use_gyro: bool = False, horizon: float = 5.0) -> None:
        self.model = model
        self._use_gyro = use_gyro
        self._horizon = horizon
        self._rows: list[_Row] = []
        self._knots: list[_Knot] = []
        self._times: list[float] = []
        self._forgotten = False

    def add_velocity(self, t: float, v: float, w: float) -> bool:
        """A row with forward velocity [m/s] and turn rate [rad/s], held from ``t`` until the next row."""
        return self._insert(_Row(t + self.model.delay, "velocity", (v, w)))

    def add_increment(self, t: float, dx: float, dy: float, dtheta: float) -> bool:
        """A row with the motion from the previous row until ``t``, in the robot's frame at the previous row."""
        return self._insert(_Row(t, "increment", (dx, dy, dtheta)))

    def add_yaw_rate(self, t: float, w: float) -> bool:
        """A gyro's row [rad/s], held from ``t`` until the next; it replaces the rotation that the wheels tell."""
        return self._insert(_Row(t, "gyro", (w,)))

    def state(self, t: float) -> ChainState:
        """The state of the chain at ``t``; before the first kept knot the robot is taken to stand, its motion unknown."""
        if not self._knots:
            return ChainState(t, 0.0, 0.0, 0.0, 0.0, 0.0, t)
        i = bisect.bisect_right(self._times, t) - 1
        if i >= 0:
            knot = self._knots[i]
            return knot.after(t - knot.t, self.model.lag, self.model.max_hold).state()
        first = self._knots[0]
        return ChainState(t, first.x, first.y, first.heading, first.path, first.turn, first.unknown - (first.t - t))

    def relative(self, start: ChainState, end: ChainState) -> Increment:
        """The motion from ``start`` to ``end``.

        ``start`` may be what was believed at its time: the difference then includes what later rows corrected.
        """
        return relative_motion(self.model, start, end)

    def _insert(self, row: _Row) -> bool:
        if self._forgotten and row.t < self._times[0]:
            return False
        i = bisect.bisect_right(self._times, row.t)
        if i < len(self._rows):
            self._rows.insert(i, row)
            self._rebuild(i)
        else:
            self._append(row)
            self._forget()
        return True

    def _rebuild(self, i: int) -> None:
        rows = self._rows[i:]
        del self._rows[i:], self._knots[i:], self._times[i:]
        for row in rows:
            self._append(row)

    def _append(self, row: _Row) -> None:
        previous = self._knots[-1] if self._knots else _Knot(row.t)
        duration = row.t - previous.t
        m = self.model
        if row.kind == "increment":
            knot = self._after_increment(previous, row)
        else:
            knot = previous.after(duration, m.lag, m.max_hold)
            if row.kind == "velocity":
                speed = m.scale_distance * (row.values[0] - m.speed_bias)
                knot.ux, knot.uy = speed * math.cos(m.direction), speed * math.sin(m.direction)
                if not self._use_gyro:
                    knot.uw = m.scale_rotation * (row.values[1] - m.heading_rate_bias)
            else:
                knot.uw = knot.w = row.values[0] - m.gyro_bias
        self._rows.append(row)
        self._knots.append(knot)
        self._times.append(knot.t)

    def _after_increment(self, previous: _Knot, row: _Row) -> _Knot:
        duration = row.t - previous.t
        if duration <= 0.0:
            return _Knot(row.t)  # the first row: when its motion began is not known
        m = self.model
        rho_x, rho_y, phi = (float(v) for v in se2.log(np.array(row.values)) / duration)
        rho_x -= m.speed_bias
        c, s = math.cos(m.direction), math.sin(m.direction)
        previous.ux = m.scale_distance * (c * rho_x - s * rho_y)
        previous.uy = m.scale_distance * (s * rho_x + c * rho_y)
        previous.uw = m.scale_rotation * (phi - m.heading_rate_bias)
        knot = previous.after(duration, 0.0, duration)
        knot.unknown += max(0.0, duration - m.max_hold)
        return knot

    def _forget(self) -> None:
        # seldom, and many at a time: removing from the front of a list costs its length
        if self._times[-1] - self._times[0] > 2.0 * self._horizon:
            keep = bisect.bisect_right(self._times, self._times[-1] - self._horizon) - 1
            del self._rows[:keep], self._knots[:keep], self._times[:keep]
            self._forgotten = True
