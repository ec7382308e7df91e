"""Integration of a run's odometry in a frame of its own. The result is a chain of knots, one for each odometry
measurement. A knot is the integrated state at the time of the measurement.

Between knots the robot follows a circular arc (Thrun, Burgard, Fox, "Probabilistic Robotics", 2005, eq. 5.9). Commanded
velocities act after a delay and through a first-order lag, ``v' = (u(t - delay) - v) / lag``.

The rotation measured by a gyro replaces that of the wheels. If there is no recent gyro measurement, the rotation of the
wheels is used. The robot is at rest if the wheels report rest and the gyro reports a small rate, so that gyro noise and
bias do not turn a resting robot.
"""

import math
from collections.abc import Sequence

import numpy as np

from factors import se2
from factors.compiled import compiled
from factors.motion import ChainState, Increment
from factors.odometry.chain_kernels import (
    GYRO,
    HEADING,
    HOLD,
    INCREMENT,
    KNOT,
    LAG,
    PATH,
    ROW,
    SLIPPING,
    STATE,
    STILL,
    TURN,
    UNKNOWN,
    VELOCITY,
    T,
    X,
    Y,
    append,
    copy,
    insert,
    integrate,
    move,
    without_old,
)
from factors.odometry.factor import OdometryFactor, ScaleFreeOdometryFactor
from factors.odometry.kernels import State, carried, predicted, recalibrated, relative, relatives
from factors.odometry.model import OdometryModel, composed
from factors.se2 import Array, Integers, body_to_world_one, compose_scalars

TWIST_TIME = 0.1  # s; a velocity is the mean over this time


class OdometryChain:
    """The integrated odometry of a run. Add odometry measurements (rows), then ask for states and motions at any time.

    A row may be older than rows added before it. The integrated states at newer rows are then computed again. After the
    newest row, the robot is assumed to continue with its velocity.

    ``model``: the odometry's constants and noise.
    ``use_gyro``: True if gyro rows replace the rotation of the wheels.
    ``horizon`` [s]: rows that are this much older than the newest row may be deleted. New rows before the oldest
    remaining row are rejected.
    ``estimated``: indices in :data:`~factors.odometry.model.PARAMETERS` of the P constants that the estimator
    estimates. Methods with an argument ``constants`` (P,) correct the motion by these corrections of the constants.
    """

    def __init__(
        self, model: OdometryModel, *, use_gyro: bool = False, horizon: float = 5.0, estimated: Sequence[int] = ()
    ) -> None:
        self.model = model
        self._estimated = tuple(estimated)
        self._indices = np.array(estimated, dtype=np.int64)
        self._use_gyro = use_gyro
        self.horizon = horizon
        self._rows = np.zeros((256, ROW))
        self._knots = np.zeros((256, KNOT))
        self._count = 0
        self.begin = -math.inf  # s; the time of the first knot after older rows were deleted
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
        self._constants = np.array((*scales, *direction, m.lag, m.max_hold, m.gyro_bias, use_gyro, False), dtype=float)
        self._noise = np.array(m.noise())

    def add_velocity(self, t: float, v: float, w: float) -> bool:
        """Add an odometry measurement of forward speed ``v`` [m/s] and turn rate ``w`` [rad/s], valid from ``t`` until
        the next measurement. Returns False, and ignores it, if the measurements of that time were deleted."""
        return self._insert(t + self.model.delay, VELOCITY, v, w, 0.0, 0.0)

    def add_increment(self, t: float, dx: float, dy: float, dtheta: float, unknown: float = 0.0) -> bool:
        """Add the motion (dx, dy, dtheta) from the previous measurement until ``t``, in the robot frame at its start.

        ``unknown`` [s]: how long the motion is unknown in this time. A motion with the same ``t`` as an existing one is
        composed with it. Returns False, and ignores it, if the measurements of that time were deleted.
        """
        move, last = np.array((dx, dy, dtheta), dtype=float), self._count - 1
        while last >= 0 and self._rows[last, 0] == t and self._rows[last, 1] != INCREMENT:
            last -= 1
        if last >= 0 and self._rows[last, 0] == t:
            self._rows[last, 2:5] = se2.log(se2.compose(se2.exp(self._rows[last, 2:5]), move))
            self._rows[last, 5] += unknown
            integrate(self._rows, self._knots, last, self._count, self._constants)
            return True
        x, y, turned = se2.log(move).tolist()
        return self._insert(t, INCREMENT, x, y, turned, unknown)

    def add_yaw_rate(self, t: float, w: float) -> bool:
        """Add a gyro measurement of the turn rate ``w`` [rad/s], valid from ``t`` until the next gyro measurement. It
        replaces the wheels' rotation. Returns False, and ignores it, if the measurements of that time were deleted."""
        return self._insert(t, GYRO, w, 0.0, 0.0, 0.0)

    def add_velocities(self, t: Array, v: Array, w: Array) -> int:
        """Add N forward speeds ``v`` and turn rates ``w`` from the times ``t`` on, all (N,) and in order of time.
        Returns the number of added ones. The others are too old, see :meth:`add_velocity`."""
        if not len(t):
            return 0
        self._reserve(len(t))
        n = self._count
        count = append(self._rows, self._knots, n, t, v, w, self.model.delay, self._constants, self.horizon)
        if count < 0:
            return sum(map(self.add_velocity, t.tolist(), v.tolist(), w.tolist()))
        self._now_has(count, forgets=count < n + len(t))
        return len(t)

    def add_increments(self, t: Array, dx: Array, dy: Array, dtheta: Array, unknown: Array | None = None) -> None:
        """Add N motions (``dx``, ``dy``, ``dtheta``) as :meth:`add_increment` does, each since the previous
        measurement. All arrays are (N,), in order of time ``t`` and after all existing measurements. Motions with equal
        times are composed."""
        last, moves = composed(t, np.column_stack((dx, dy, dtheta)))
        if not len(last):
            return
        self._reserve(len(last))
        n, end = self._count, self._count + len(last)
        self._rows[n:end, 0], self._rows[n:end, 1], self._rows[n:end, 2:5] = t[last], INCREMENT, se2.log(moves)
        lost = np.zeros(len(t)) if unknown is None else unknown
        self._rows[n:end, 5] = np.bincount(np.searchsorted(t[last], t), weights=lost, minlength=len(last))
        integrate(self._rows, self._knots, n, end, self._constants)
        count = without_old(self._rows, self._knots, end, self.horizon)
        self._now_has(count, forgets=count < end)

    def state(self, t: float) -> ChainState:
        """Return the integrated state at time ``t`` [s]. Before the first measurement the pose is constant, and all
        time is added to the field ``unknown``. Raises ValueError if the odometry of that time is deleted."""
        if t < self.begin:
            raise ValueError(f"the odometry at {t:.3f} s was deleted, and is available only from {self.begin:.3f} s on")
        return ChainState(*state_at(self._knots, self._count, t, self._constants))

    def states(self, t: Array) -> Array:
        """Return the integrated states (M, 8) at times ``t`` (M,) [s]. The columns are the fields of ChainState."""
        out = np.empty((len(t), STATE))
        states_at(self._knots, self._count, np.asarray(t, dtype=float), self._constants, out)
        return out

    def begin_slip(self, since: float) -> None:
        """Report that the wheels slip since ``since`` [s]. The motion is unknown from then until :meth:`end_slip`.

        Limitation: a measurement added afterwards that is not the newest makes the time of unknown motion inexact.
        """
        if not self._constants[SLIPPING] and self._count:
            self._knots[self._count - 1, UNKNOWN] += max(0.0, self._knots[self._count - 1, T] - since)
            self._constants[SLIPPING] = 1.0

    def end_slip(self) -> None:
        """Report that the wheels no longer slip."""
        self._constants[SLIPPING] = 0.0

    @property
    def is_slipping(self) -> bool:
        """True between :meth:`begin_slip` and :meth:`end_slip`."""
        return bool(self._constants[SLIPPING])

    def relative(self, start: ChainState, end: ChainState) -> Increment:
        """Return the motion from ``start`` to ``end``, two results of :meth:`state`. Limitation: the motion is wrong if
        a measurement older than ``start`` was added between the two calls of :meth:`state`."""
        return Increment(*relative(self._noise, tuple(start), tuple(end)))

    def travelled(self, start: ChainState, t: float) -> tuple[ChainState, Increment]:
        """Return the integrated state at ``t`` [s], and the motion from ``start`` to this state. This is :meth:`state`
        and :meth:`relative` in one call."""
        known = self._knots, self._count, self._constants, self._noise
        end, delta, covariance, duration, still = travelled(*known, tuple(start), t)
        return ChainState(*end), Increment(delta, covariance, duration, still)

    def twist(self, t: float) -> Array:
        """Return the robot's mean velocity (3,) in the last :data:`TWIST_TIME` seconds before ``t``, in the robot frame
        [m/s, m/s, rad/s]. Raises ValueError if the odometry of that time is deleted."""
        if t - TWIST_TIME < self.begin:
            needed = f"the velocity at {t:.3f} s needs odometry from {t - TWIST_TIME:.3f} s on"
            raise ValueError(f"{needed}, but the odometry before {self.begin:.3f} s was deleted")
        return np.array(twist_at(self._knots, self._count, self._constants, t))

    def predictions(
        self,
        start: ChainState,
        times: Sequence[float],
        pose: Array,
        covariance: Array,
        constants: Array,
        first: int,
    ) -> tuple[Array, Array, Array, Array, Array, Array]:
        """Predict a Gaussian error state (S,) from the odometry state ``start`` to each of K ``times`` [s] in turn.

        ``pose`` (3,), ``covariance`` (S, S): the estimate at ``start``. The first three components of the error state
        are the pose. ``constants`` (P,): corrections of the estimated odometry constants. ``first``: the index of the
        first of these constants in the error state.

        Returns six arrays: the odometry states (K, 8), see :class:`ChainState`; the predicted poses (K, 3); the first
        three rows (K, 3, S) of the transition matrix from the previous time, whose remaining rows equal an identity
        matrix; the covariances (K, 3, 3) of the motion since the previous time; the predicted covariances (K, S, S);
        the covariances (K, 3, 3) of (x, y, heading) in the world frame.
        """
        count, size = len(times), len(covariance)
        # compiled code writes into existing arrays, because returning an array takes longer than computing it
        states, poses, covariances = np.empty((count, STATE)), np.empty((count, 3)), np.empty((count, size, size))
        transitions, noises, worlds = np.empty((count, 3, size)), np.empty((count, 3, 3)), np.empty((count, 3, 3))
        out = states, poses, transitions, noises, covariances, worlds
        at, constant = (tuple(start), np.array(times), pose, covariance), (constants, self._indices)
        predictions(self._knots, self._count, self._constants, self._noise, *at, *constant, first, *out)
        return out

    def moved(
        self, start: ChainState, times: Sequence[float], pose: Array, covariance: Array, constants: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Predict a pose (3,) with body-frame ``covariance`` (3, 3) from the odometry state ``start`` to K ``times``.

        ``constants`` (P,): corrections of the estimated odometry constants. Returns four arrays: the odometry states
        (K, 8), see :class:`ChainState`; the poses (K, 3); their body-frame covariances (K, 3, 3); their covariances (K,
        3, 3) of (x, y, heading) in the world frame.
        """
        count = len(times)
        states, poses = np.empty((count, STATE)), np.empty((count, 3))
        bodies, worlds = np.empty((count, 3, 3)), np.empty((count, 3, 3))
        contiguous = np.ascontiguousarray(covariance)  # numba would compile the function again for another memory order
        at, constant = (tuple(start), np.array(times), pose, contiguous), (constants, self._indices)
        out = states, poses, bodies, worlds
        moved_to(self._knots, self._count, self._constants, self._noise, *at, *constant, *out)
        return out

    def relatives(self, starts: Array, ends: Array, constants: Array) -> tuple[Array, Array]:
        """Return the N motions from ``starts`` to ``ends``, states (N, 8) each from :meth:`states`, as relative poses
        (N, 3) and covariances (N, 3, 3). ``constants`` (P,): corrections of the estimated odometry constants."""
        deltas, covariances = relatives(self._noise, starts, ends, constants, self._indices)
        return deltas, covariances

    def factor(self, increment: Increment, *, scale_known: bool) -> OdometryFactor:
        """Return a factor of the motion ``increment`` on two poses and on the estimated odometry constants.
        ``scale_known``: True if measurements other than odometry determine the scale of the map."""
        kind = OdometryFactor if scale_known else ScaleFreeOdometryFactor
        return kind(increment, self._estimated)

    def exact_factor(self, increment: Increment) -> OdometryFactor:
        """Return a factor of the motion ``increment`` on two poses only, with the odometry constants of the model."""
        return OdometryFactor(increment)

    def _insert(self, t: float, kind: float, a: float, b: float, c: float, unknown: float) -> bool:
        if t < self.begin:
            return False
        self._reserve(1)
        count = insert(self._rows, self._knots, self._count, t, kind, a, b, c, unknown, self._constants, self.horizon)
        self._now_has(count, forgets=count <= self._count)
        return True

    def _reserve(self, rows: int) -> None:
        capacity = len(self._rows)
        if self._count + rows > capacity:
            more = max(capacity, rows)
            self._rows = np.concatenate((self._rows, np.zeros((more, ROW))))
            self._knots = np.concatenate((self._knots, np.zeros((more, KNOT))))

    def _now_has(self, count: int, *, forgets: bool) -> None:
        """Set the number of stored rows to ``count``. ``forgets``: True if old rows were deleted."""
        self._count = count
        if forgets:
            self.begin = float(self._knots[0, T])


@compiled
def state_at(knots: Array, count: int, t: float, constants: Array) -> State:
    """Return the integrated state at time ``t``, with the fields of :class:`~factors.motion.ChainState`. ``knots``: the
    states at ``count`` odometry rows. ``constants``: the constants of the odometry model as an array."""
    if count == 0:
        return t, 0.0, 0.0, 0.0, 0.0, 0.0, t, 0.0
    i = np.searchsorted(knots[:count, T], t, side="right") - 1
    if i < 0:
        k = knots[0]
        return t, k[X], k[Y], k[HEADING], k[PATH], k[TURN], k[UNKNOWN] - (k[T] - t), k[STILL]
    k = np.empty(KNOT)
    move(knots[i], t - knots[i, T], constants[LAG], constants[HOLD], constants[SLIPPING], k)
    return t, k[X], k[Y], k[HEADING], k[PATH], k[TURN], k[UNKNOWN], k[STILL]


@compiled
def twist_at(knots: Array, count: int, constants: Array, t: float) -> tuple[float, float, float]:
    """Return the robot's mean velocity before ``t``, see :meth:`OdometryChain.twist`. ``knots``: the states at
    ``count`` odometry rows. ``constants``: the constants of the odometry model as an array."""
    a, b = state_at(knots, count, t - TWIST_TIME, constants), state_at(knots, count, t, constants)
    moved = se2.between_scalars(a[1], a[2], a[3], b[1], b[2], b[3])
    x, y, turned = se2.log_scalars(moved[0], moved[1], moved[2])
    return x / TWIST_TIME, y / TWIST_TIME, turned / TWIST_TIME


@compiled
def travelled(
    knots: Array, count: int, constants: Array, noise: Array, start: State, t: float
) -> tuple[State, Array, Array, float, float]:
    end = state_at(knots, count, t, constants)
    delta, covariance, duration, still = relative(noise, start, end)
    return end, delta, covariance, duration, still


@compiled
def predictions(
    knots: Array,
    count: int,
    chain: Array,
    noise: Array,
    start: State,
    times: Array,
    pose: Array,
    covariance: Array,
    constants: Array,
    indices: Integers,
    first: int,
    states: Array,
    poses: Array,
    transitions: Array,
    noises: Array,
    covariances: Array,
    worlds: Array,
) -> None:
    for k in range(len(times)):
        end = state_at(knots, count, times[k], chain)
        delta, delta_noise, duration, still = relative(noise, start, end)
        for i in range(3):
            copy(delta_noise[i], noises[k, i])
        moving, at, body = duration - still, poses[k], covariances[k]
        predicted(delta, delta_noise, moving, pose, covariance, constants, indices, first, at, transitions[k], body)
        world = body_to_world_one(at, body)
        for i in range(3):
            copy(world[i], worlds[k, i])
        put_state(end, states[k])
        start, pose, covariance = end, at, body


@compiled
def moved_to(
    knots: Array,
    count: int,
    chain: Array,
    noise: Array,
    start: State,
    times: Array,
    pose: Array,
    covariance: Array,
    constants: Array,
    indices: Integers,
    states: Array,
    poses: Array,
    bodies: Array,
    worlds: Array,
) -> None:
    for k in range(len(times)):
        end = state_at(knots, count, times[k], chain)
        delta, delta_noise, duration, still = relative(noise, start, end)
        if len(indices):
            delta = recalibrated(delta, duration - still, constants, indices)
        at = poses[k]
        at[0], at[1], at[2] = compose_scalars(pose[0], pose[1], pose[2], delta[0], delta[1], delta[2])
        body = carried(covariance, delta, delta_noise)
        world = body_to_world_one(at, body)
        for i in range(3):
            copy(body[i], bodies[k, i])
            copy(world[i], worlds[k, i])
        put_state(end, states[k])


@compiled
def put_state(state: State, row: Array) -> None:
    """Write ``state``, the fields of a :class:`~factors.motion.ChainState`, into the array ``row`` (8,)."""
    row[0], row[1], row[2], row[3] = state[0], state[1], state[2], state[3]
    row[4], row[5], row[6], row[7] = state[4], state[5], state[6], state[7]


@compiled
def states_at(knots: Array, count: int, times: Array, constants: Array, out: Array) -> None:
    for j in range(len(times)):
        put_state(state_at(knots, count, times[j], constants), out[j])
