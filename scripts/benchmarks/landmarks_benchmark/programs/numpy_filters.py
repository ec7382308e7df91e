"""Localization by an extended Kalman filter and by a particle filter in plain numpy."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from landmarks_benchmark.programs.plain import MOTION, SIGHTING, Found, Motion, Problem, turned, wrapped

GATE = 9.21  # 99 % of chi-square with two degrees of freedom; for larger innovations the noise is increased
PARTICLES, SEED, ROBUST = 5000, 0, 4.0


def ekf(problem: Problem) -> Found:
    """Run an extended Kalman filter of the pose. The rows of odometry between two stamps are composed to one motion."""
    motion, found = Motion(problem.growth), Found()
    x, p = problem.pose.copy(), problem.covariance.copy()
    for kind, t, what in problem.events():
        if kind == MOTION:
            motion.add(*what)
            continue
        started = time.process_time()
        x, p = _moved(x, p, motion)
        if kind == SIGHTING:
            for row in what:
                x, p = _corrected(x, p, row)
            found.updates.append(time.process_time() - started)
        else:
            found.t.append(t)
            found.poses.append(x.copy())
    return found


def _moved(x: Any, p: Any, motion: Motion) -> tuple[Any, Any]:
    dx, dy, dh, q = motion.take()
    c, s = math.cos(x[2]), math.sin(x[2])
    ex, ey = c * dx - s * dy, s * dx + c * dy
    f = np.array(((1.0, 0.0, -ey), (0.0, 1.0, ex), (0.0, 0.0, 1.0)))
    to = np.array((x[0] + ex, x[1] + ey, wrapped(x[2] + dh)))
    return to, f @ p @ f.T + turned(q, -to[2])


def _corrected(x: Any, p: Any, row: Any) -> tuple[Any, Any]:
    lx, ly, distance, bearing, s_distance, s_bearing = row
    dx, dy = lx - x[0], ly - x[1]
    d2 = dx * dx + dy * dy
    d = math.sqrt(d2)
    h = np.array(((-dx / d, -dy / d, 0.0), (dy / d2, -dx / d2, -1.0)))
    off = np.array((distance - d, wrapped(bearing - math.atan2(dy, dx) + x[2])))
    r = np.diag((s_distance**2, s_bearing**2))
    s = h @ p @ h.T + r
    nis = float(off @ np.linalg.solve(s, off))
    if nis > GATE:
        r = r * (nis / GATE) ** 2
        s = h @ p @ h.T + r
    gain = np.linalg.solve(s, h @ p).T
    kept = np.eye(3) - gain @ h
    to = x + gain @ off
    to[2] = wrapped(to[2])
    return to, kept @ p @ kept.T + gain @ r @ gain.T


def particles(problem: Problem) -> Found:
    """Run a bootstrap particle filter with a Geman-McClure loss. It resamples if the effective number of particles is below one
    half."""
    rng, motion, found = np.random.default_rng(SEED), Motion(problem.growth), Found()
    x = rng.multivariate_normal(problem.pose, problem.covariance, PARTICLES).T
    log_weights = np.zeros(PARTICLES)
    for kind, t, what in problem.events():
        if kind == MOTION:
            motion.add(*what)
            continue
        started = time.process_time()
        x = _spread(x, motion, rng)
        if kind == SIGHTING:
            for row in what:
                log_weights += _log_likelihood(x, row)
            log_weights -= log_weights.max()
            weights = np.exp(log_weights)
            weights /= weights.sum()
            if 1.0 / np.sum(weights**2) < PARTICLES / 2.0:
                at = (rng.random() + np.arange(PARTICLES)) / PARTICLES
                x = x[:, np.minimum(np.searchsorted(np.cumsum(weights), at), PARTICLES - 1)]
                log_weights = np.zeros(PARTICLES)
            found.updates.append(time.process_time() - started)
        else:
            weights = np.exp(log_weights)
            weights /= weights.sum()
            heading = math.atan2(float(np.sin(x[2]) @ weights), float(np.cos(x[2]) @ weights))
            found.t.append(t)
            found.poses.append((float(x[0] @ weights), float(x[1] @ weights), heading))
    return found


def _spread(x: Any, motion: Motion, rng: np.random.Generator) -> Any:
    dx, dy, dh, q = motion.take()
    noise = np.linalg.cholesky(q) @ rng.standard_normal((3, x.shape[1]))
    c, s = math.cos(dh), math.sin(dh)
    ex, ey, eh = dx + c * noise[0] - s * noise[1], dy + s * noise[0] + c * noise[1], dh + noise[2]
    c, s = np.cos(x[2]), np.sin(x[2])
    return np.array((x[0] + c * ex - s * ey, x[1] + s * ex + c * ey, x[2] + eh))


def _log_likelihood(x: Any, row: Any) -> Any:
    lx, ly, distance, bearing, s_distance, s_bearing = row
    dx, dy = lx - x[0], ly - x[1]
    squared = ((np.hypot(dx, dy) - distance) / s_distance) ** 2
    squared += (wrapped(np.arctan2(dy, dx) - x[2] - bearing) / s_bearing) ** 2
    return -0.5 * squared / (1.0 + squared / ROBUST**2)
