"""Compiled functions for odometry: the relative motion between two measurements, its covariance, and its change with
the odometry's constants."""

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

# If the variance of the position exceeds FAR [m^2], the fraction ROUNDING of it is added, so that the covariance is invertible.
ROUNDING, FAR = 1e-12, 1e4

# While the wheels slip, the robot moves a fraction of the reported distance, which is uniform in [0, 1] and independent
# in each second. The variance of this fraction is 1/12.
SHARE_VARIANCE = 1.0 / 12.0
SHORTEST = 1e-6  # s; minimum of a duration, against division by zero

NO_CONSTANTS = np.zeros((3, 0))  # the derivative of an increment if no constants are estimated

# The elements of a noise model are, in this order:
# - the direction of travel [rad];
# - nine variances: of the longitudinal, lateral and heading error, each per distance, per rotation and per time;
# - the variances per time of position and heading without odometry;
# - the variances of position and heading added to each increment, and their minimum variances per time.
Noise = tuple[float, ...]
State = tuple[float, ...]  # a state of the integrated odometry: t, x, y, heading, path, turn, unknown, still


@compiled
def relative(noise: Array, start: State, end: State) -> tuple[Array, Array, float, float]:
    """Return the motion between the states ``start`` and ``end`` of the integrated odometry, see
    :func:`factors.odometry.model.relative_motion`.

    ``noise``: the noise of the odometry, a :data:`Noise` as an array. The results are the relative pose (3,), its
    covariance (3, 3), the duration [s], and the time at rest [s].
    """
    c, s, dx, dy = math.cos(start[3]), math.sin(start[3]), end[1] - start[1], end[2] - start[2]
    x, y, turned = c * dx + s * dy, c * dy - s * dx, wrap_scalar(end[3] - start[3])
    distance, rotation, duration = abs(end[4] - start[4]), abs(end[5] - start[5]), abs(end[0] - start[0])
    unknown, still = max(0.0, end[6] - start[6]), min(duration, abs(end[7] - start[7]))
    # noise grows with time only while the robot moves; the total is at least the minimum noise
    moving, least_position, least_heading = duration - still, noise[14] * duration, noise[15] * duration
    along = max(noise[1] * distance + noise[2] * rotation + noise[3] * moving, least_position) + noise[10] * unknown
    lateral = max(noise[4] * distance + noise[5] * rotation + noise[6] * moving, least_position) + noise[10] * unknown
    heading = max(noise[7] * distance + noise[8] * rotation + noise[9] * moving, least_heading) + noise[11] * unknown
    if unknown > 0.0:  # the robot moved an unknown fraction of the reported way
        along += unknown * SHARE_VARIANCE * (distance / max(duration, SHORTEST)) ** 2
    # (nx, ny): displacement of the end, in the frame of the end, per change of the heading at the start
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
    """Return N motions from odometry states ``starts`` to ``ends`` (N, 8), poses (N, 3) and covariances (N, 3, 3).

    ``noise``: the noise of the odometry, a :data:`Noise` as an array. ``constants`` (P,), ``indices`` (P,): the motions
    are corrected by these changes of odometry constants, see :func:`recalibrated`.
    """
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
    """Propagate the body-frame ``covariance`` (3, 3) of a pose over the motion ``delta`` (3,) with the covariance
    ``noise`` (3, 3). Returns the body-frame covariance (3, 3) of the pose after the motion."""
    c, s = math.cos(delta[2]), math.sin(delta[2])
    x, y = s * delta[0] - c * delta[1], c * delta[0] + s * delta[1]
    # the adjoint of the inverse motion
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
    """Predict a Gaussian error state (S,) of a pose and further components over one motion.

    ``delta`` (3,), ``noise`` (3, 3): the motion and its covariance. ``moving`` [s]: the time in motion. ``pose`` (3,),
    ``covariance`` (S, S): the pose and the covariance of the error state before the motion. ``constants`` (P,),
    ``indices`` (P,): corrections of the estimated odometry constants, and their indices among all constants. ``first``:
    the index of the first of these constants in the error state.
    ``at`` (3,): output, the predicted pose.
    ``transition`` (3, S): output, the first three rows of the transition matrix. The remaining rows are rows of an
    identity matrix. ``out`` (S, S): output, the predicted covariance.
    """
    size, count = len(covariance), len(constants)
    columns = np.arange(3 + count)  # the columns of the transition that are not zero
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
    # the adjoint of the inverse motion
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
    """Increase the variances of the position in a covariance (3, 3) very slightly if they exceed :data:`FAR`. Rounding
    then does not make it singular."""
    variance = covariance[0, 0] + covariance[1, 1]
    if variance > FAR:
        covariance[0, 0] += ROUNDING * variance
        covariance[1, 1] += ROUNDING * variance


@compiled
def recalibrated(delta: Array, moving: float, constants: Array, indices: Integers) -> Array:
    """Return the increment ``delta`` (3,) corrected for changed constants, as :func:`recalibrate` does, without
    derivatives. ``moving`` [s]: the time in motion.

    ``constants`` (P,), ``indices`` (P,): corrections of the estimated constants, and their indices among all constants.
    """
    changes = all_changes(constants, indices)
    x, y, phi = log_scalars(delta[0], delta[1], delta[2])
    turn = phi + changes[1] * phi - changes[2] * moving + changes[3] * math.hypot(x, y)
    return np.array(exp_scalars(x + changes[0] * x, y + changes[0] * y, turn))


@compiled
def recalibrate(twist: Array, moving: float, changes: Array) -> tuple[Array, Array]:
    """Correct an increment for changed odometry constants. The increment is assumed to be an arc of a circle.

    ``twist`` (3,): the logarithm of the increment. ``moving`` [s]: its time in motion.
    ``changes`` (4,): the relative changes of the scales of distance and rotation, the change of the heading-rate bias
    [rad/s], and the change of the heading drift [rad/m].

    Returns the corrected increment (3,) and its Jacobian (3, 4) by ``changes``.
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
    """Correct an increment as :func:`recalibrate` does, for P of the four constants.

    ``twist`` (3,): the logarithm of the increment. ``moving`` [s]: the time in motion. ``constants`` (P,), ``indices``
    (P,): corrections of the estimated constants, and their indices among all constants. Returns the corrected increment
    (3,) and its Jacobian (3, P) by ``constants``.
    """
    delta, by_changes = recalibrate(twist, moving, all_changes(constants, indices))
    out = np.empty((3, len(indices)))
    for i in range(3):
        for j in range(len(indices)):
            out[i, j] = by_changes[i, indices[j]]
    return delta, out


@compiled
def all_changes(constants: Array, indices: Integers) -> Array:
    """Return the changes (4,) of all odometry constants: ``constants`` (P,) at ``indices`` (P,), otherwise zero."""
    changes = np.zeros(4)
    for i in range(len(indices)):
        changes[indices[i]] = constants[i]
    return changes
