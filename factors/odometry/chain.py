"""Integration of the odometry of a run as a chain of knots in its own frame.

Between knots the robot follows a circular arc (Thrun, Burgard, Fox, "Probabilistic Robotics", 2005, eq. 5.9). Commanded velocities
act after a delay and through a first-order lag, ``v' = (u(t - delay) - v) / lag``.

A gyro replaces the rotation of the wheels, for velocities and increments; without recent gyro rows that of the wheels is used.
While the wheels report rest the robot is at rest, whatever noise and bias of the gyro.
"""

import math

import numba
import numpy as np

from factors import se2
from factors.motion import ChainState, Increment
from factors.odometry.kernels import State, carried, recalibrated, relative, relatives
from factors.odometry.model import OdometryModel, composed
from factors.se2 import Array, Integers
from factors.se2_kernels import body_to_world
from factors.se2_kernels import composed as one_composed

# columns of a row: time of its effect, its kind, and its values
_ROW = 5
_VELOCITY, _INCREMENT, _GYRO = 0.0, 1.0, 2.0  # v, w, -; twist of the whole increment; w, -, -
# columns of a knot: state at the time of a row, the velocity in the robot frame, the velocity that it converges to, whether the
# wheels are at rest, and the time of the last row of a gyro
_T, _X, _Y, _HEADING, _PATH, _TURN, _UNKNOWN, _STILL, _VX, _VY, _W, _UX, _UY, _UW, _STANDS, _GYRO_T = range(16)
_KNOT, _STATE = 16, 8

# m/s and rad/s, relative to the biases: wheels below are at rest; a gyro below agrees that the robot does not turn
_REST, _GYRO_REST = 1e-3, 0.02

# indices in the array of the model's constants: an array, because a tuple is slower to pass to compiled code
_COS, _SIN, _LAG, _HOLD, _GYRO_BIAS, _USES_GYRO = range(6, 12)  # behind scales and biases

_arc_coefficients = numba.njit(cache=True)(se2.arc_coefficients)


class OdometryChain:
    """The integrated odometry of a run, as a chain of knots in its own frame.

    Rows arrive in order of time, or late (then the knots after them are computed again). After the last row its velocity is held.
    Rows more than ``horizon`` seconds before the newest one are forgotten; adding an older row returns False.
    """

    def __init__(self, model: OdometryModel, *, use_gyro: bool = False, horizon: float = 5.0) -> None:
        self.model = model
        self._use_gyro = use_gyro
        self.horizon = horizon
        self._rows = np.zeros((256, _ROW))
        self._knots = np.zeros((256, _KNOT))
        self._count = 0
        self._forgotten = False
        m = model
        scales = (
            m.scale_distance,
            m.scale_rotation,
            m.speed_bias,
            m.heading_rate_bias,
            m.heading_drift,
            m.turn_slowdown,
        )
        direction = math.cos(m.direction), math.sin(m.direction)
        self._constants = np.array((*scales, *direction, m.lag, m.max_hold, m.gyro_bias, use_gyro), dtype=float)
        self._noise = np.array(m.noise())

    def add_velocity(self, t: float, v: float, w: float) -> bool:
        """A row with forward velocity [m/s] and turn rate [rad/s], held from ``t`` until the next row."""
        return self._insert(t + self.model.delay, _VELOCITY, v, w, 0.0)

    def add_increment(self, t: float, dx: float, dy: float, dtheta: float) -> bool:
        """A row with the motion from the previous row until ``t``, in the robot frame at the previous row. A row with an equal
        timestamp continues the previous one."""
        move, last = np.array((dx, dy, dtheta), dtype=float), self._count - 1
        while last >= 0 and self._rows[last, 0] == t and self._rows[last, 1] != _INCREMENT:
            last -= 1
        if last >= 0 and self._rows[last, 0] == t:
            self._rows[last, 2:] = se2.log(se2.compose(se2.exp(self._rows[last, 2:]), move))
            _integrate(self._rows, self._knots, last, self._count, self._constants)
            return True
        return self._insert(t, _INCREMENT, *se2.log(move).tolist())

    def add_yaw_rate(self, t: float, w: float) -> bool:
        """A row of a gyro [rad/s], held from ``t`` until the next; it replaces the rotation of the wheels."""
        return self._insert(t, _GYRO, w, 0.0, 0.0)

    def add_velocities(self, t: Array, v: Array, w: Array) -> int:
        """Add rows (N,), in order of time; returns how many were kept."""
        n, delay = self._count, self.model.delay
        if not len(t):
            return 0
        if n and t[0] + delay < self._knots[n - 1, _T]:
            return sum(map(self.add_velocity, t.tolist(), v.tolist(), w.tolist()))
        self._reserve(len(t))
        self._count = _append(self._rows, self._knots, n, t, v, w, delay, self._constants)
        self._forget()
        return len(t)

    def add_increments(self, t: Array, dx: Array, dy: Array, dtheta: Array) -> None:
        """Add rows (N,), in order of time and after all others; rows with equal timestamps are composed."""
        last, moves = composed(t, np.column_stack((dx, dy, dtheta)))
        self._extend(t[last], _INCREMENT, se2.log(moves))

    def state(self, t: float) -> ChainState:
        """The state of the chain at ``t``; before the first knot the motion is unknown and the pose constant."""
        return ChainState(*_state(self._knots, self._count, t, self._constants))

    def states(self, t: Array) -> Array:
        """The states (M, 8) at times (M,): t, x, y, heading, path, turn, unknown, still, as in :class:`ChainState`."""
        out = np.empty((len(t), _STATE))
        _states(self._knots, self._count, np.asarray(t, dtype=float), self._constants, out)
        return out

    def relative(self, start: ChainState, end: ChainState) -> Increment:
        """The motion from ``start`` to ``end``. ``start`` may be an earlier result of :meth:`state`; the motion then includes
        corrections by later rows."""
        return Increment(*relative(self._noise, tuple(start), tuple(end)))

    def travelled(self, start: ChainState, t: float) -> tuple[ChainState, Increment]:
        """The state at ``t`` and the motion from ``start`` to there: :meth:`state` and :meth:`relative` in one call."""
        known = self._knots, self._count, self._constants, self._noise
        end, delta, covariance, duration, still = _travelled(*known, tuple(start), t)
        return ChainState(*end), Increment(delta, covariance, duration, still)

    def moved(
        self, start: ChainState, t: float, pose: Array, covariance: Array, constants: Array, indices: Integers
    ) -> tuple[Array, Array, Array]:
        """A pose (3,) at ``start``, moved to ``t`` under changed ``constants`` (P,): the pose there, and its body-frame and world
        covariances, from its body-frame ``covariance`` (3, 3)."""
        known = self._knots, self._count, self._constants, self._noise
        at, body, world = _moved(*known, tuple(start), t, pose, covariance, constants, indices)
        return at, body, world

    def relatives(self, starts: Array, ends: Array, constants: Array, indices: Integers) -> tuple[Array, Array]:
        """The motions between states (N, 8), see :meth:`states`, under changed ``constants`` (P,): poses (N, 3) and covariances
        (N, 3, 3)."""
        deltas, covariances = relatives(self._noise, starts, ends, constants, indices)
        return deltas, covariances

    def _insert(self, *row: float) -> bool:
        t = row[0]
        if self._forgotten and t < self._knots[0, _T]:
            return False
        n = i = self._count
        if n == len(self._rows):
            self._reserve(1)
        if n and t < self._knots[n - 1, _T]:
            i = int(np.searchsorted(self._knots[:n, _T], t, side="right"))
            self._rows[i + 1 : n + 1] = self._rows[i:n]
        self._rows[i] = row
        self._count += 1
        _integrate(self._rows, self._knots, i, self._count, self._constants)
        if i == n:
            self._forget()
        return True

    def _extend(self, t: Array, kind: float, values: Array) -> None:
        self._reserve(len(t))
        n, end = self._count, self._count + len(t)
        self._rows[n:end, 0], self._rows[n:end, 1], self._rows[n:end, 2:] = t, kind, values
        self._count = end
        _integrate(self._rows, self._knots, n, end, self._constants)
        if len(t):
            self._forget()

    def _reserve(self, rows: int) -> None:
        capacity = len(self._rows)
        if self._count + rows > capacity:
            more = max(capacity, rows)
            self._rows = np.concatenate((self._rows, np.zeros((more, _ROW))))
            self._knots = np.concatenate((self._knots, np.zeros((more, _KNOT))))

    def _forget(self) -> None:
        # rarely, and many rows at once, because the remaining ones are moved to the front
        n = self._count
        newest = self._knots[n - 1, _T]
        if newest - self._knots[0, _T] > 2.0 * self.horizon:
            keep = int(np.searchsorted(self._knots[:n, _T], newest - self.horizon, side="right")) - 1
            for table in (self._rows, self._knots):
                table[: n - keep] = table[keep:n].copy()
            self._count = n - keep
            self._forgotten = True


@numba.njit(cache=True)
def _append(rows: Array, knots: Array, count: int, t: Array, v: Array, w: Array, delay: float, constants: Array) -> int:
    """Append rows of velocities and their knots to the ``count`` existing ones; returns the new count."""
    for i in range(len(t)):
        row = rows[count + i]
        row[0], row[1], row[2], row[3], row[4] = t[i] + delay, _VELOCITY, v[i], w[i], 0.0
    _integrate(rows, knots, count, count + len(t), constants)
    return count + len(t)


@numba.njit(cache=True)
def _integrate(rows: Array, knots: Array, begin: int, end: int, constants: Array) -> None:
    """Compute the knots of the rows from ``begin`` to ``end``, each from the knot before it."""
    scale_distance, scale_rotation, speed_bias = constants[0], constants[1], constants[2]
    heading_rate_bias, heading_drift, turn_slowdown = constants[3], constants[4], constants[5]
    c, s, lag, hold = constants[_COS], constants[_SIN], constants[_LAG], constants[_HOLD]
    gyro_bias, use_gyro = constants[_GYRO_BIAS], constants[_USES_GYRO] > 0.0
    for i in range(begin, end):
        t, kind, a, b, phi = rows[i, 0], rows[i, 1], rows[i, 2], rows[i, 3], rows[i, 4]
        knot = knots[i]
        if i == 0:
            knot[:] = 0.0
            knot[_T], knot[_GYRO_T] = t, -math.inf
        elif kind == _INCREMENT and use_gyro:
            _turn_by_gyro(rows, knots, i, constants)
        elif kind == _INCREMENT:
            previous = knots[i - 1]
            duration = t - previous[_T]
            if duration > 0.0:  # otherwise there is no time for motion
                forward, sideways, turn = a / duration - speed_bias, b / duration, phi / duration - heading_rate_bias
                stands = abs(forward) <= _REST and abs(sideways) <= _REST and abs(turn) <= _REST
                if stands:
                    forward = sideways = turn = 0.0
                previous[_STANDS] = stands
                previous[_UX] = scale_distance * (c * forward - s * sideways)
                previous[_UY] = scale_distance * (s * forward + c * sideways)
                speed = math.hypot(previous[_UX], previous[_UY])
                previous[_UW] = scale_rotation * turn + heading_drift * speed
            _move(previous, duration, 0.0, duration, knot)
            knot[_UNKNOWN] += max(0.0, duration - hold)
        else:
            previous = knots[i - 1]
            _move(previous, t - previous[_T], lag, hold, knot)
        if kind == _VELOCITY:
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
        elif kind == _GYRO:
            _take_gyro(knot, t, a - gyro_bias)


@numba.njit(cache=True)
def _take_gyro(knot: Array, t: float, turn: float) -> None:
    knot[_GYRO_T] = t
    knot[_UW] = knot[_W] = 0.0 if knot[_STANDS] and abs(turn) <= _GYRO_REST else turn


@numba.njit(cache=True)
def _turn_by_gyro(rows: Array, knots: Array, i: int, constants: Array) -> None:
    """Compute the knot of an increment in row ``i``, and again those of the gyro since the previous increment: the robot moves by
    the increment and rotates by the gyro."""
    scale_distance, scale_rotation, speed_bias = constants[0], constants[1], constants[2]
    heading_rate_bias, heading_drift = constants[3], constants[4]
    c, s, hold, gyro_bias = constants[_COS], constants[_SIN], constants[_HOLD], constants[_GYRO_BIAS]
    t, a, b, phi = rows[i, 0], rows[i, 2], rows[i, 3], rows[i, 4]
    first = i - 1
    while first >= 0 and rows[first, 1] != _INCREMENT:
        first -= 1
    told = first >= 0 and t > knots[first, _T]  # otherwise the start of the motion is unknown
    first = max(first, 0)
    duration = t - knots[first, _T]
    forward, sideways, turn, stands = 0.0, 0.0, 0.0, False
    if told:
        forward, sideways, turn = a / duration - speed_bias, b / duration, phi / duration - heading_rate_bias
        stands = abs(forward) <= _REST and abs(sideways) <= _REST and abs(turn) <= _REST
        if stands:
            forward = sideways = turn = 0.0
    ahead, aside = scale_distance * (c * forward - s * sideways), scale_distance * (s * forward + c * sideways)
    for k in range(first, i):
        knot, following = knots[k], knots[k + 1]
        if told:
            knot[_STANDS], knot[_UX], knot[_UY] = stands, ahead, aside
            if t - knot[_GYRO_T] > duration + hold:
                knot[_UW] = scale_rotation * turn + heading_drift * math.hypot(ahead, aside)
            elif stands and abs(knot[_UW]) <= _GYRO_REST:
                knot[_UW] = 0.0
        step = rows[k + 1, 0] - knot[_T]
        _move(knot, step, 0.0, step, following)
        if rows[k + 1, 1] == _GYRO:
            _take_gyro(following, rows[k + 1, 0], rows[k + 1, 2] - gyro_bias)
    knots[i, _UNKNOWN] += max(0.0, duration - hold)


@numba.njit(cache=True)
def _move(knot: Array, duration: float, lag: float, hold: float, out: Array) -> None:
    """The knot after ``duration`` seconds: the motion continues for at most ``hold`` seconds, then it is unknown."""
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
    a, b = _arc_coefficients(dtheta)
    c, s = math.cos(knot[_HEADING]), math.sin(knot[_HEADING])
    chord_x, chord_y = a * dx - b * dy, b * dx + a * dy
    out[_T] = knot[_T] + duration
    out[_X] = knot[_X] + c * chord_x - s * chord_y
    out[_Y] = knot[_Y] + s * chord_x + c * chord_y
    out[_HEADING] = knot[_HEADING] + dtheta
    out[_PATH] = knot[_PATH] + math.hypot(dx, dy)
    out[_TURN] = knot[_TURN] + abs(dtheta)
    out[_UNKNOWN] = knot[_UNKNOWN] + duration - moving
    out[_STILL] = knot[_STILL] + (moving if rests else 0.0)


@numba.njit(cache=True)
def _state(knots: Array, count: int, t: float, constants: Array) -> State:
    """t, x, y, heading, path, turn, unknown and still at ``t``, from the last knot before it."""
    if count == 0:
        return t, 0.0, 0.0, 0.0, 0.0, 0.0, t, 0.0
    i = np.searchsorted(knots[:count, _T], t, side="right") - 1
    if i < 0:
        k = knots[0]
        return t, k[_X], k[_Y], k[_HEADING], k[_PATH], k[_TURN], k[_UNKNOWN] - (k[_T] - t), k[_STILL]
    k = np.empty(_KNOT)
    _move(knots[i], t - knots[i, _T], constants[_LAG], constants[_HOLD], k)
    return t, k[_X], k[_Y], k[_HEADING], k[_PATH], k[_TURN], k[_UNKNOWN], k[_STILL]


@numba.njit(cache=True)
def _travelled(
    knots: Array, count: int, constants: Array, noise: Array, start: State, t: float
) -> tuple[State, Array, Array, float, float]:
    end = _state(knots, count, t, constants)
    delta, covariance, duration, still = relative(noise, start, end)
    return end, delta, covariance, duration, still


@numba.njit(cache=True)
def _moved(
    knots: Array,
    count: int,
    chain: Array,
    noise: Array,
    start: State,
    t: float,
    pose: Array,
    covariance: Array,
    constants: Array,
    indices: Integers,
) -> tuple[Array, Array, Array]:
    delta, spread, duration, still = relative(noise, start, _state(knots, count, t, chain))
    if len(indices):
        delta = recalibrated(delta, duration - still, constants, indices)
    at = np.array(one_composed(pose[0], pose[1], pose[2], delta[0], delta[1], delta[2]))
    body = carried(covariance, delta, spread)
    return at, body, body_to_world(at, body)


@numba.njit(cache=True)
def _states(knots: Array, count: int, times: Array, constants: Array, out: Array) -> None:
    for j in range(len(times)):
        out[j, :] = _state(knots, count, times[j], constants)
