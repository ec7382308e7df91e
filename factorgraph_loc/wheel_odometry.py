"""Wheel odometry made from a reference trajectory, for logs that have none of their own and for simulated ones."""

from __future__ import annotations

import math

import numpy as np

from factors import se2
from factors.se2 import Array

SCALE_SIGMA = 0.02  # of the distance and of the rotation, constant over a run
DRIFT_SIGMA = math.radians(1.0)  # rad/m, constant over a run
ALONG, LATERAL, HEADING = 0.01, 0.005, math.radians(1.5)  # m, m, rad per sqrt(m)


def wheel_odometry(increments: Array, rng: np.random.Generator) -> Array:
    """What wheels report of true ``increments`` (N, 3) of motion (dx, dy [m], dtheta [rad], each in the robot's frame before it).

    Both scales are wrong by 2 %, the heading drifts by 1 degree/m (constant over the run, standard deviations), and it walks:
    0.01 m along, 0.005 m across and 1.5 degrees per sqrt(m). Nothing is added where the robot stands or turns on the spot.
    Draws, in this order: scale of the distance, drift, scale of the rotation, 2 N normals (along and across by turns), N normals.
    """
    increments = np.asarray(increments, dtype=float).reshape(-1, 3)
    scale = rng.normal(0.0, SCALE_SIGMA)
    drift = rng.normal(0.0, DRIFT_SIGMA)
    turn_scale = rng.normal(0.0, SCALE_SIGMA)
    slip = rng.standard_normal((len(increments), 2))
    turn = rng.standard_normal(len(increments))
    distance = np.hypot(increments[:, 0], increments[:, 1])
    root = np.sqrt(distance)
    out = np.empty_like(increments)
    out[:, 0] = (1.0 + scale) * increments[:, 0] + ALONG * root * slip[:, 0]
    out[:, 1] = (1.0 + scale) * increments[:, 1] + LATERAL * root * slip[:, 1]
    out[:, 2] = se2.wrap((1.0 + turn_scale) * increments[:, 2] + drift * distance + HEADING * root * turn)
    return out
