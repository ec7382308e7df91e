"""Compiled integration of odometry.

A row is one odometry or gyro measurement. A knot is the integrated state at the time of a row, with the velocity after
it. Each row has one knot, with the same index.
"""

import math

import numpy as np

from factors.compiled import compiled
from factors.se2 import Array, arc_coefficients

ROW = 6  # the number of columns of a row: time, kind, and four values
# Kinds of rows. The values are (v, w, 0, 0) of a velocity, the twist of an increment and its time of unknown motion,
# and (w, 0, 0, 0) of a gyro.
VELOCITY, INCREMENT, GYRO = 0.0, 1.0, 2.0
# Columns of a knot: the integrated state (8), the velocity in the robot frame (3), the target velocity that it converges to (3),
# whether the wheels are at rest, and the time of the last gyro row.
T, X, Y, HEADING, PATH, TURN, UNKNOWN, STILL, _VX, _VY, _W, _UX, _UY, _UW, _STANDS, _GYRO_T = range(16)
KNOT, STATE = 16, 8

# Wheels below the first limit [m/s, rad/s], and a gyro below the second [rad/s], are at rest. Biases are subtracted first.
_REST, _GYRO_REST = 1e-3, 0.02

# Indices in the array of the model's constants. The first six are scales, biases and other constants, in the order of `integrate`.
# The constants are an array because a tuple is slower to pass to compiled code.
_COS, _SIN, LAG, HOLD, _GYRO_BIAS, _USES_GYRO, SLIPPING = range(6, 13)


@compiled
def copy(row: Array, to: Array) -> None:
    """Copy the elements of the vector ``row`` (N,) into ``to``."""
    for j in range(len(row)):
        to[j] = row[j]


@compiled
def without_old(rows: Array, knots: Array, count: int, horizon: float) -> int:
    """Delete the odometry measurements (``rows``) that are more than ``horizon`` seconds older than the newest, and the
    integrated states ``knots`` at their times. ``count``: the number of rows. Returns the new number.

    Nothing is deleted before the oldest row is two horizons old, so that deletions are rare.
    """
    newest = knots[count - 1, T]
    if newest - knots[0, T] <= 2.0 * horizon:
        return count
    keep = np.searchsorted(knots[:count, T], newest - horizon, side="right") - 1
    for i in range(count - keep):
        copy(rows[keep + i], rows[i])
        copy(knots[keep + i], knots[i])
    return int(count - keep)


@compiled
def append(
    rows: Array,
    knots: Array,
    count: int,
    t: Array,
    v: Array,
    w: Array,
    delay: float,
    constants: Array,
    horizon: float,
) -> int:
    """Append velocities to the ``count`` existing rows, write their states into ``knots``, and delete old rows.

    ``t``, ``v``, ``w`` (N,): times [s], forward velocities [m/s] and turn rates [rad/s]. ``delay`` [s]: is added to the
    times. ``constants``: the model as an array. ``horizon`` [s]: the age beyond which rows may be deleted. Returns the
    new count. If the first new row is older than the last existing row, returns -1 and changes nothing.
    """
    if count and t[0] + delay < knots[count - 1, T]:
        return -1
    for i in range(len(t)):
        row = rows[count + i]
        row[0], row[1], row[2], row[3], row[4], row[5] = t[i] + delay, VELOCITY, v[i], w[i], 0.0, 0.0
    integrate(rows, knots, count, count + len(t), constants)
    return without_old(rows, knots, count + len(t), horizon)


@compiled
def insert(
    rows: Array,
    knots: Array,
    count: int,
    t: float,
    kind: float,
    a: float,
    b: float,
    c: float,
    unknown: float,
    constants: Array,
    horizon: float,
) -> int:
    """Insert a row at time ``t`` among the ``count`` existing ``rows``, in order of time and after rows of equal time.

    ``kind``: :data:`VELOCITY`, :data:`INCREMENT` or :data:`GYRO`. ``a``, ``b``, ``c``: its values, which are (v, w, 0),
    the logarithm of the motion, or (w, 0, 0). ``unknown`` [s]: the time of unknown motion in an increment. The
    integrated states ``knots`` are updated with the model ``constants``. If the new row is the newest, rows more than
    ``horizon`` [s] older are deleted. Returns the new count.
    """
    i = count
    if count and t < knots[count - 1, T]:
        i = int(np.searchsorted(knots[:count, T], t, side="right"))
        for k in range(count, i, -1):
            copy(rows[k - 1], rows[k])
    rows[i, 0], rows[i, 1], rows[i, 2], rows[i, 3], rows[i, 4], rows[i, 5] = t, kind, a, b, c, unknown
    integrate(rows, knots, i, count + 1, constants)
    return without_old(rows, knots, count + 1, horizon) if i == count else count + 1


@compiled
def integrate(rows: Array, knots: Array, begin: int, end: int, constants: Array) -> None:
    """Integrate the odometry rows from index ``begin`` up to, but not including, ``end``. Writes the state at each row
    into ``knots``. ``constants``: the model as an array."""
    scale_distance, scale_rotation, speed_bias = constants[0], constants[1], constants[2]
    heading_rate_bias, heading_drift, turn_slowdown = constants[3], constants[4], constants[5]
    c, s, lag, hold = constants[_COS], constants[_SIN], constants[LAG], constants[HOLD]
    gyro_bias, use_gyro, slipping = constants[_GYRO_BIAS], constants[_USES_GYRO] > 0.0, constants[SLIPPING]
    for i in range(begin, end):
        t, kind, a, b, phi = rows[i, 0], rows[i, 1], rows[i, 2], rows[i, 3], rows[i, 4]
        knot = knots[i]
        if i == 0:
            knot[:] = 0.0
            knot[T], knot[_GYRO_T] = t, -math.inf
        elif kind == INCREMENT and use_gyro:
            _turn_by_gyro(rows, knots, i, constants)
        elif kind == INCREMENT:
            previous = knots[i - 1]
            duration = t - previous[T]
            if duration > 0.0:  # rows with equal times have no motion between them
                forward, sideways, turn = a / duration - speed_bias, b / duration, phi / duration - heading_rate_bias
                stands = abs(forward) <= _REST and abs(sideways) <= _REST and abs(turn) <= _REST
                if stands:
                    forward = sideways = turn = 0.0
                previous[_STANDS] = stands
                previous[_UX] = scale_distance * (c * forward - s * sideways)
                previous[_UY] = scale_distance * (s * forward + c * sideways)
                speed = math.hypot(previous[_UX], previous[_UY])
                previous[_UW] = scale_rotation * turn + heading_drift * speed
            move(previous, duration, 0.0, duration, slipping, knot)
            knot[UNKNOWN] += max(0.0, duration - hold, min(rows[i, 5], duration))
        else:
            previous = knots[i - 1]
            move(previous, t - previous[T], lag, hold, slipping, knot)
        if kind == VELOCITY:
            stands = abs(a - speed_bias) <= _REST and abs(b - heading_rate_bias) <= _REST
            knot[_STANDS] = stands
            speed = 0.0 if stands else scale_distance * (a - speed_bias)
            turn = 0.0 if stands else scale_rotation * (b - heading_rate_bias)
            speed = math.copysign(max(0.0, abs(speed) - turn_slowdown * abs(turn)), speed)
            knot[_UX], knot[_UY] = speed * c, speed * s
            if not use_gyro or t - knot[_GYRO_T] > hold:
                knot[_UW] = turn + heading_drift * abs(speed)
            elif stands and abs(knot[_UW]) <= _GYRO_REST:
                knot[_UW] = knot[_W] = 0.0
        elif kind == GYRO:
            _take_gyro(knot, t, a - gyro_bias)


@compiled
def _take_gyro(knot: Array, t: float, turn: float) -> None:
    """Set the turn rate in ``knot``, the integrated state at time ``t``, to the rate ``turn`` that a gyro measures. If
    both wheels and gyro are at rest, the rate is set to zero."""
    knot[_GYRO_T] = t
    knot[_UW] = knot[_W] = 0.0 if knot[_STANDS] and abs(turn) <= _GYRO_REST else turn


@compiled
def _turn_by_gyro(rows: Array, knots: Array, i: int, constants: Array) -> None:
    """Integrate the increment in row ``i``, with the translation of the increment and the rotation of the gyro.

    This also recomputes the states (``knots``) at the gyro rows since the previous increment, because the translation
    in that time is known only now.
    """
    scale_distance, scale_rotation, speed_bias = constants[0], constants[1], constants[2]
    heading_rate_bias, heading_drift = constants[3], constants[4]
    c, s, hold, gyro_bias = constants[_COS], constants[_SIN], constants[HOLD], constants[_GYRO_BIAS]
    t, a, b, phi = rows[i, 0], rows[i, 2], rows[i, 3], rows[i, 4]
    first = i - 1
    while first >= 0 and rows[first, 1] != INCREMENT:
        first -= 1
    known = first >= 0 and t > knots[first, T]  # False if the start time of the increment is unknown
    first = max(first, 0)
    duration = t - knots[first, T]
    forward, sideways, turn, stands = 0.0, 0.0, 0.0, False
    if known:
        forward, sideways, turn = a / duration - speed_bias, b / duration, phi / duration - heading_rate_bias
        stands = abs(forward) <= _REST and abs(sideways) <= _REST and abs(turn) <= _REST
        if stands:
            forward = sideways = turn = 0.0
    ahead, aside = scale_distance * (c * forward - s * sideways), scale_distance * (s * forward + c * sideways)
    for k in range(first, i):
        knot, following = knots[k], knots[k + 1]
        if known:
            knot[_STANDS], knot[_UX], knot[_UY] = stands, ahead, aside
            if t - knot[_GYRO_T] > duration + hold:
                knot[_UW] = scale_rotation * turn + heading_drift * math.hypot(ahead, aside)
            elif stands and abs(knot[_UW]) <= _GYRO_REST:
                knot[_UW] = 0.0
        step = rows[k + 1, 0] - knot[T]
        move(knot, step, 0.0, step, constants[SLIPPING], following)
        if rows[k + 1, 1] == GYRO:
            _take_gyro(following, rows[k + 1, 0], rows[k + 1, 2] - gyro_bias)
    knots[i, UNKNOWN] += max(0.0, duration - hold, min(rows[i, 5], duration))


@compiled
def move(knot: Array, duration: float, lag: float, hold: float, slipping: float, out: Array) -> None:
    """Write the odometry state ``duration`` [s] after the state ``knot`` into ``out``. Both are arrays (16,): the
    fields of :class:`~factors.motion.ChainState`, velocity (3), target velocity (3), and two internal values.

    The velocity converges to the target velocity with the time constant ``lag`` [s], for at most ``hold`` [s]. After
    that the pose is constant and the time is added to the field ``unknown`` of ``out``. If ``slipping`` is 1, the whole
    duration is added to this field.
    """
    ux, uy, uw = knot[_UX], knot[_UY], knot[_UW]
    moving = min(duration, hold)
    rests = knot[_STANDS] and uw == 0.0
    if lag > 0.0:
        rests = rests and max(abs(knot[_VX]), abs(knot[_VY]), abs(knot[_W])) <= _REST
        decay = math.exp(-moving / lag)
        settling = lag * (1.0 - decay)
        behind_x, behind_y, behind_w = knot[_VX] - ux, knot[_VY] - uy, knot[_W] - uw
        dx, dy = ux * moving + behind_x * settling, uy * moving + behind_y * settling
        dtheta = uw * moving + behind_w * settling
        out[_VX], out[_VY], out[_W] = ux + behind_x * decay, uy + behind_y * decay, uw + behind_w * decay
    else:
        dx, dy, dtheta = ux * moving, uy * moving, uw * moving
        out[_VX], out[_VY], out[_W] = ux, uy, uw
    if duration > hold:
        out[_VX] = out[_VY] = out[_W] = 0.0
    out[_UX], out[_UY], out[_UW], out[_STANDS], out[_GYRO_T] = ux, uy, uw, knot[_STANDS], knot[_GYRO_T]
    a, b = arc_coefficients(dtheta)
    c, s = math.cos(knot[HEADING]), math.sin(knot[HEADING])
    chord_x, chord_y = a * dx - b * dy, b * dx + a * dy
    out[T] = knot[T] + duration
    out[X] = knot[X] + c * chord_x - s * chord_y
    out[Y] = knot[Y] + s * chord_x + c * chord_y
    out[HEADING] = knot[HEADING] + dtheta
    out[PATH] = knot[PATH] + math.hypot(dx, dy)
    out[TURN] = knot[TURN] + abs(dtheta)
    out[UNKNOWN] = knot[UNKNOWN] + duration - (1.0 - slipping) * moving
    out[STILL] = knot[STILL] + (moving if rests else 0.0)
