"""Simulates wheel odometry along a reference trajectory, for simulated logs and for recordings without odometry.

Published results with such odometry must state that it is simulated.
"""

import math

import numpy as np

from factorgraph_loc.model.scoring import TICK_GAP
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.interfaces import Ride, Simulated
from factorgraph_loc.sensors.odometry.measurement import IncrementStream
from factors import se2
from factors.se2 import Array

RATE = 10.0  # Hz
SCALE_SIGMA = 0.02  # standard deviation of the scales of distance and rotation, which are constant during a run
DRIFT_SIGMA = math.radians(1.0)  # rad/m; standard deviation of the heading drift, which is constant during a run
ALONG, LATERAL = 0.01, 0.005  # m per sqrt(m); noise along and across the track
HEADING = math.radians(1.5)  # rad per sqrt(m); noise of the heading

DESCRIPTION = (
    "simulated at 10 Hz from increments of the reference: scale errors of distance and rotation 2 %, heading drift 1 deg/m, "
    "noise per sqrt(m) 0.01 m along, 0.005 m across, 1.5 deg in heading"
)


def simulate(ride: Ride) -> Simulated:
    """Return the stream "odometry" of a simulated drive: increments of its true trajectory with errors."""
    return Simulated({"odometry": wheel_odometry(ride.truth, int(ride.rng("odometry").integers(2**32)))})


def wheel_odometry(reference: Trajectory, seed: int) -> IncrementStream:
    """Return simulated odometry along ``reference`` at 10 Hz. The first row has no motion.

    (dx, dy, dyaw) are the increments of the reference in the body frame, ds is the length of (dx, dy):

    - dx' = (1 + s) dx + 0.01 sqrt(ds) n1
    - dy' = (1 + s) dy + 0.005 sqrt(ds) n2
    - dyaw' = (1 + g) dyaw + b ds + radians(1.5) sqrt(ds) n3

    The scales s, g ~ N(0, 0.02) and the drift b ~ N(0, radians(1) per m) are constant. n1, n2, n3 ~ N(0, 1) differ
    between rows. ``default_rng(seed)`` draws s, b, g, then n1 and n2 of each row, then n3 of each row. Gaps above 60 s
    in the reference have no rows. The row after such a gap contains the whole motion during the gap.
    """
    t = _grid(reference.t)
    count = len(t) - 1
    poses = reference.at(np.minimum(t, reference.t[-1]))
    dx, dy, dyaw = se2.between(poses[:-1], poses[1:]).T
    rng = np.random.default_rng(seed)
    s, b, g = rng.normal(0.0, (SCALE_SIGMA, DRIFT_SIGMA, SCALE_SIGMA))
    n1, n2 = rng.standard_normal((count, 2)).T
    n3 = rng.standard_normal(count)
    ds = np.hypot(dx, dy)
    root = np.sqrt(ds)
    rows = np.zeros((count + 1, 3))
    rows[1:, 0] = (1.0 + s) * dx + ALONG * root * n1
    rows[1:, 1] = (1.0 + s) * dy + LATERAL * root * n2
    rows[1:, 2] = (1.0 + g) * dyaw + b * ds + HEADING * root * n3
    return IncrementStream(t, *np.ascontiguousarray(rows.T))


def _grid(stamps: Array) -> Array:
    """Return times (N,) at 10 Hz from the first to the last of ``stamps``, without times in long gaps."""
    long = np.flatnonzero(np.diff(stamps) > TICK_GAP)
    begins, ends = stamps[np.append(0, long + 1)], stamps[np.append(long, -1)]
    first = np.ceil((begins - stamps[0]) * RATE - 1e-6).astype(int)
    last = np.floor((ends - stamps[0]) * RATE + 1e-6).astype(int)
    steps = [np.arange(i, j + 1) for i, j in zip(first, last, strict=True)]
    return np.asarray(stamps[0] + np.concatenate(steps) / RATE)
