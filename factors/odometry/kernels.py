"""Compiled kernels of the odometry: relative motion for each measurement, and its change with the constants."""

import math

import numpy as np

from factors.compiled import compiled
from factors.se2 import (
    Array,
    Integers,
    arc_coefficients,
    exp_scalars,
    log_scalars,
    right_jacobian,
    wrap_scalar,
)

# Minimum variance of positions relative to the largest one. A pose known only to a hundred metres is not known better than to a
# tenth of a millimetre in any direction; otherwise its covariance would be numerically singular.
ROUNDING, FAR = 1e-12, 1e4  # m^2

# s: variance of the share of its way that a robot goes while its wheels slip, uniform over a width of one, times the second for
# which the share is the same
SHARE_VARIANCE = 1.0 / 12.0
SHORTEST = 1e-6  # s: a duration that is not zero

NO_CONSTANTS = np.zeros((3, 0))  # the derivative of an increment by no constants

# direction of travel; variances per distance, rotation and time of longitudinal, lateral and heading error; variances per time
# without odometry of position and heading; minimum variances, and minimum variances per time
Noise = tuple[float, ...]
State = tuple[float, ...]  # of a chain: t, x, y, heading, path, turn, unknown, still


@compiled
def relative(noise: Array, start: State, end: State) -> tuple[Array, Array, float, float]:
    """See :func:`factors.odometry.model.relative_motion`: pose (3,), covariance (3, 3), duration and time at rest, for two states
    of a chain (t, x, y, heading, path, turn, unknown, still)."""
    c, s, dx, dy = math.cos(start[3]), math.sin(start[3]), end[1] - start[1], end[2] - start[2]
    x, y, turned = c * dx + s * dy, c * dy - s * dx, wrap_scalar(end[3] - start[3])
    distance, rotation, duration = abs(end[4] - start[4]), abs(end[5] - start[5]), abs(end[0] - start[0])
    unknown, still = max(0.0, end[6] - start[6]), min(duration, abs(end[7] - start[7]))
    # time-dependent noise grows in motion only; the total is at least the minimum noise
    moving, least_position, least_heading = duration - still, noise[14] * duration, noise[15] * duration
    along = max(noise[1] * distance + noise[2] * rotation + noise[3] * moving, least_position) + noise[10] * unknown
    lateral = max(noise[4] * distance + noise[5] * rotation + noise[6] * moving, least_position) + noise[10] * unknown
    heading = max(noise[7] * distance + noise[8] * rotation + noise[9] * moving, least_heading) + noise[11] * unknown
    if unknown > 0.0:  # the robot went an unknown share of what its speed was
        along += unknown * SHARE_VARIANCE * (distance / max(duration, SHORTEST)) ** 2
    # the start seen from the end, rotated by 90 degrees: displacement of the end by a heading change at the start
    c, s = math.cos(turned), math.sin(turned)
    nx, ny = s * x - c * y, c * x + s * y
    # the mean heading during the motion differs from the final one by half the rotation
    ahead, aside = math.cos(noise[0] - turned / 2.0), math.sin(noise[0] - turned / 2.0)
    covariance = np.empty((3, 3))
    covariance[0, 0] = ahead**2 * along + aside**2 * lateral + heading * nx * nx / 3.0 + noise[12]
    covariance[1, 1] = aside**2 * along + ahead**2 * lateral + heading * ny * ny / 3.0 + noise[12]
    covariance[2, 2] = heading + noise[13]
    _widen(covariance)
    covariance[0, 1] = covariance[1, 0] = ahead * aside * (along - lateral) + heading * nx * ny / 3.0
    covariance[0, 2] = covariance[2, 0] = heading * nx / 2.0
    covariance[1, 2] = covariance[2, 1] = heading * ny / 2.0
    return np.array((x, y, turned)), covariance, duration, still


@compiled
def relatives(noise: Array, starts: Array, ends: Array, constants: Array, indices: Integers) -> tuple[Array, Array]:
    """:func:`relative` for states (N, 8): poses (N, 3), :func:`recalibrated` by ``constants`` (P,), and covariances (N, 3, 3)."""
    count = len(starts)
    deltas, covariances = np.empty((count, 3)), np.empty((count, 3, 3))
    for k in range(count):
        a, b = starts[k], ends[k]
        start, end = (a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7]), (b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7])
        delta, covariance, duration, still = relative(noise, start, end)
        if len(indices):
            delta = recalibrated(delta, duration - still, constants, indices)
        for i in range(3):
            deltas[k, i] = delta[i]
            for j in range(3):
                covariances[k, i, j] = covariance[i, j]
    return deltas, covariances


@compiled
def carried(covariance: Array, delta: Array, noise: Array) -> Array:
    """The body-frame covariance (3, 3) of a pose after the motion ``delta`` (3,) with covariance ``noise``."""
    c, s = math.cos(delta[2]), math.sin(delta[2])
    x, y = s * delta[0] - c * delta[1], c * delta[0] + s * delta[1]
    # the adjoint of the inverse of the motion
    adjoint = ((c, s, x), (-s, c, y), (0.0, 0.0, 1.0))
    out = np.empty((3, 3))
    for i in range(3):
        p = adjoint[i]
        a = p[0] * covariance[0, 0] + p[1] * covariance[1, 0] + p[2] * covariance[2, 0]
        b = p[0] * covariance[0, 1] + p[1] * covariance[1, 1] + p[2] * covariance[2, 1]
        d = p[0] * covariance[0, 2] + p[1] * covariance[1, 2] + p[2] * covariance[2, 2]
        for j in range(3):
            q = adjoint[j]
            out[i, j] = a * q[0] + b * q[1] + d * q[2] + noise[i, j]
    _widen(out)
    return out


@compiled
def predicted(
    delta: Array,
    noise: Array,
    moving: float,
    pose: Array,
    covariance: Array,
    constants: Array,
    indices: Integers,
    first: int,
    at: Array,
    transition: Array,
    out: Array,
) -> None:
    """Predict a motion by ``delta`` (3,) with covariance ``noise`` (3, 3) and time ``moving``, under changed ``constants`` (P,) at
    the places ``indices`` (P,), with columns in the error state from ``first`` on. Writes the pose ``at`` (3,), the first rows
    ``transition`` (3, S), whose other rows are those of the identity, and the covariance ``out`` (S, S)."""
    size, count = len(covariance), len(constants)
    columns = np.arange(3 + count)  # where the transition is not zero
    for j in range(3 * size):
        transition[j // size, j % size] = 0.0
    x, y, turned = delta[0], delta[1], delta[2]
    if count:
        changed_delta, by_changes = recalibrate(
            np.array(log_scalars(x, y, turned)), moving, all_changes(constants, indices)
        )
        x, y, turned = changed_delta[0], changed_delta[1], changed_delta[2]
        for i in range(3):
            for j in range(count):
                transition[i, first + j], columns[3 + j] = by_changes[i, indices[j]], first + j
    # the adjoint of the inverse of the motion
    c, s = math.cos(turned), math.sin(turned)
    transition[0, 0], transition[0, 1], transition[0, 2] = c, s, s * x - c * y
    transition[1, 0], transition[1, 1], transition[1, 2] = -s, c, c * x + s * y
    transition[2, 2] = 1.0
    moved = np.zeros((3, size))
    for i in range(3):
        for k in columns:
            for j in range(size):
                moved[i, j] += transition[i, k] * covariance[k, j]
    for i in range(size):
        for j in range(3, size):
            out[i, j] = out[j, i] = moved[i, j] if i < 3 else covariance[i, j]
    for i in range(3):
        for j in range(3):
            out[i, j] = noise[i, j]
            for k in columns:
                out[i, j] += moved[i, k] * transition[j, k]
    c, s = math.cos(pose[2]), math.sin(pose[2])
    at[0], at[1], at[2] = pose[0] + c * x - s * y, pose[1] + s * x + c * y, wrap_scalar(pose[2] + turned)


@compiled(inline="always")
def _widen(covariance: Array) -> None:
    """Keep a covariance (3, 3) invertible: see :data:`FAR`."""
    variance = covariance[0, 0] + covariance[1, 1]
    if variance > FAR:
        covariance[0, 0] += ROUNDING * variance
        covariance[1, 1] += ROUNDING * variance


@compiled
def recalibrated(delta: Array, moving: float, constants: Array, indices: Integers) -> Array:
    """The increment ``delta`` (3,) as :func:`recalibrate` corrects it for ``constants`` (P,) with ``indices`` (P,) among all."""
    changes = all_changes(constants, indices)
    x, y, phi = log_scalars(delta[0], delta[1], delta[2])
    turn = phi + changes[1] * phi - changes[2] * moving + changes[3] * math.hypot(x, y)
    return np.array(exp_scalars(x + changes[0] * x, y + changes[0] * y, turn))


@compiled
def recalibrate(twist: Array, moving: float, changes: Array) -> tuple[Array, Array]:
    """An increment with corrected constants, as one arc, which is exact at constant curvature; and its Jacobian (3, 4).

    ``twist`` (3,): log of the increment; ``moving`` [s]: its time in motion. ``changes`` (4,): relative changes of the scales of
    distance and rotation, additional heading-rate bias [rad/s] in motion, additional heading drift [rad/m].
    """
    x, y, phi = twist[0], twist[1], twist[2]
    distance = math.hypot(x, y)
    cx, cy = x + changes[0] * x, y + changes[0] * y
    turn = phi + changes[1] * phi - changes[2] * moving + changes[3] * distance
    p, q = arc_coefficients(turn)
    jacobian = right_jacobian(np.array((cx, cy, turn)))
    by_changes = np.zeros((3, 4))
    for i in range(3):
        by_changes[i, 0] = jacobian[i, 0] * x + jacobian[i, 1] * y
        by_changes[i, 1], by_changes[i, 2] = jacobian[i, 2] * phi, -jacobian[i, 2] * moving
        by_changes[i, 3] = jacobian[i, 2] * distance
    return np.array((p * cx - q * cy, q * cx + p * cy, wrap_scalar(turn))), by_changes


@compiled
def changed(twist: Array, moving: float, constants: Array, indices: Integers) -> tuple[Array, Array]:
    """:func:`recalibrate` for corrections ``constants`` (P,) with ``indices`` (P,) among all constants; the Jacobian is (3, P)."""
    delta, by_changes = recalibrate(twist, moving, all_changes(constants, indices))
    out = np.empty((3, len(indices)))
    for i in range(3):
        for j in range(len(indices)):
            out[i, j] = by_changes[i, indices[j]]
    return delta, out


@compiled
def all_changes(constants: Array, indices: Integers) -> Array:
    """The changes (4,) of all constants: ``constants`` (P,) at the places ``indices`` (P,), else zero."""
    changes = np.zeros(4)
    for i in range(len(indices)):
        changes[indices[i]] = constants[i]
    return changes
