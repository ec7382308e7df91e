"""The extended Kalman filter of navlie on SE(2). Usage: python -m speed_benchmark.programs.navlie_ekf PROBLEM composed

Its states and its model of motion as far as they go; noise that grows with the way, range and bearing are models of one's own.
"""

from __future__ import annotations

import math
import time
from typing import Any

import navlie as nav
import numpy as np
from navlie.lib.models import BodyFrameVelocity
from navlie.lib.states import SE2State, VectorInput
from pymlg import SE2

from speed_benchmark.programs.plain import MOTION, SIGHTING, Found, Motion, Problem, command, turned, wrapped

ORDER = np.ix_((2, 0, 1), (2, 0, 1))  # heading first


class Move(VectorInput):
    """A motion as an input over some time, with a covariance of its own."""

    q: Any = None


class Composed(BodyFrameVelocity):
    def __init__(self) -> None:
        """Without a noise that is the same for all."""

    def covariance(self, x: Any, u: Move, dt: float) -> Any:
        return u.q


class RangeBearing(nav.MeasurementModel):
    def __init__(self, row: tuple[float, ...]) -> None:
        self.place, (_, _, s_distance, s_bearing) = np.array(row[:2]), row[2:]
        self.r = np.diag((s_distance**2, s_bearing**2))

    def evaluate(self, x: Any) -> Any:
        p = x.value[:2, :2].T @ (self.place - x.value[:2, 2])
        return np.array((math.hypot(p[0], p[1]), math.atan2(p[1], p[0])))

    def jacobian(self, x: Any) -> Any:
        p = x.value[:2, :2].T @ (self.place - x.value[:2, 2])
        d2 = p[0] ** 2 + p[1] ** 2
        d = math.sqrt(d2)
        by_place = np.array(((p[0] / d, p[1] / d), (-p[1] / d2, p[0] / d2)))
        return by_place @ np.array(((p[1], -1.0, 0.0), (-p[0], 0.0, -1.0)))

    def covariance(self, x: Any) -> Any:
        return self.r


class Sighting(nav.Measurement):
    def minus(self, expected: Any) -> Any:
        off = (self.value - expected).ravel()
        off[1] = wrapped(off[1])
        return off.reshape(-1, 1)


def composed(problem: Problem) -> Found:
    motion, found = Motion(problem.growth), Found()
    x = SE2State(SE2.from_components(problem.pose[2], problem.pose[:2]), stamp=problem.start)
    now = nav.StateWithCovariance(x, turned(problem.covariance, problem.pose[2])[ORDER])
    kalman = nav.ExtendedKalmanFilter(Composed(), reject_outliers=True)

    def move(now: Any, t: float) -> Any:
        dx, dy, dh, q = motion.take()
        dt = t - now.state.stamp
        if dt <= 0.0:
            return now
        u = Move(SE2.Log(SE2.from_components(dh, np.array((dx, dy)))).ravel() / dt, stamp=t)
        u.q = q[ORDER]
        return kalman.predict(now, u, dt)

    for kind, t, what in problem.events():
        if kind == MOTION:
            motion.add(*what)
            continue
        started = time.process_time()
        now = move(now, t)
        if kind == SIGHTING:
            for row in what:
                now = kalman.correct(now, Sighting(np.array(row[2:4]), None, RangeBearing(row)), None)
            found.updates.append(time.process_time() - started)
        else:
            pose = now.state.value
            found.t.append(t)
            found.poses.append((pose[0, 2], pose[1, 2], math.atan2(pose[1, 0], pose[0, 0])))
    return found


if __name__ == "__main__":
    command({"composed": composed})
