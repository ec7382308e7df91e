"""Localization by the extended Kalman filter of the package filterpy."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from landmarks_benchmark.programs.plain import MOTION, SIGHTING, Found, Motion, Problem, turned, wrapped

GATE = 9.21  # 99 % of chi-square with two degrees of freedom; for larger innovations the noise is increased


class Ekf(ExtendedKalmanFilter):
    """A Kalman filter whose state is the pose (3,)."""

    def move(self, dx: float, dy: float, dh: float, q: Any) -> None:
        x, y, h = self.x
        c, s = math.cos(h), math.sin(h)
        ex, ey = c * dx - s * dy, s * dx + c * dy
        self.F = np.array(((1.0, 0.0, -ey), (0.0, 1.0, ex), (0.0, 0.0, 1.0)))
        self.Q = turned(q, -(h + dh))
        self._to = np.array((x + ex, y + ey, wrapped(h + dh)))
        self.predict()

    def predict_x(self, u: object = 0) -> None:
        self.x = self._to


def seen(x: Any, lx: float, ly: float) -> Any:
    dx, dy = lx - x[0], ly - x[1]
    return np.array((math.hypot(dx, dy), wrapped(math.atan2(dy, dx) - x[2])))


def jacobian(x: Any, lx: float, ly: float) -> Any:
    dx, dy = lx - x[0], ly - x[1]
    d2 = dx * dx + dy * dy
    d = math.sqrt(d2)
    return np.array(((-dx / d, -dy / d, 0.0), (dy / d2, -dx / d2, -1.0)))


def residual(a: Any, b: Any) -> Any:
    off = a - b
    off[1] = wrapped(off[1])
    return off


def composed(problem: Problem) -> Found:
    """Run the filter, with a prediction to each measurement of landmarks and each tick."""
    return _run(problem, each_row=False)


def rows(problem: Problem) -> Found:
    """Run the filter, with a prediction for each row of odometry."""
    return _run(problem, each_row=True)


def _run(problem: Problem, *, each_row: bool) -> Found:
    motion, found = Motion(problem.growth), Found()
    f = Ekf(3, 2)
    f.x, f.P = problem.pose.copy(), problem.covariance.copy()
    for kind, t, what in problem.events():
        if kind == MOTION:
            motion.add(*what)
            if each_row:
                f.move(*motion.take())
            continue
        started = time.process_time()
        f.move(*motion.take())
        if kind == SIGHTING:
            for lx, ly, distance, bearing, s_distance, s_bearing in what:
                z, r = np.array((distance, bearing)), np.diag((s_distance**2, s_bearing**2))
                h, off = jacobian(f.x, lx, ly), residual(z, seen(f.x, lx, ly))
                nis = float(off @ np.linalg.solve(h @ f.P @ h.T + r, off))
                if nis > GATE:
                    r = r * (nis / GATE) ** 2
                f.update(z, jacobian, seen, R=r, args=(lx, ly), hx_args=(lx, ly), residual=residual)
                f.x[2] = wrapped(f.x[2])
            found.updates.append(time.process_time() - started)
        else:
            found.t.append(t)
            found.poses.append(f.x.copy())
    return found
