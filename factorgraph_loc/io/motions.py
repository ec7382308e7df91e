"""Computes the motion between odometry poses, or from encoder counts or speeds of wheels.

Odometry may be reset during a log. The sizes of wheels come from the manifest or the rig.
"""

from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import checks
from factorgraph_loc.files.models import FileModel, InUnit
from factorgraph_loc.files.row_rules import RowRules
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.odometry.jumps import without_jumps
from factorgraph_loc.sensors.odometry.measurement import IncrementStream, VelocityStream
from factorgraph_loc.sensors.odometry.settings import DifferentialDrive, OdometrySettings
from factorgraph_loc.text import Notice, notice
from factors import se2
from factors.se2 import Array, Integers

# a jump is a motion with a rate above FASTER times the largest previous rate, which is at least SPEED or TURN
SPEED, TURN, FASTER = 1.0, 2.0, 3.0  # m/s, rad/s, dimensionless
RESET_DISTANCE = 0.05  # m: maximum distance from the origin after a reset of the odometry
ZERO = 1e-6  # m and rad: magnitude below which a value is zero
NO_STAMPS = np.zeros(0, dtype=np.int64)
HOLD_TIME = 1.0  # s for which the previous motion is continued across a reset
COUNTERS = (2**8, 2**16, 2**32)  # numbers of counts after which encoders wrap to 0
TURNS = ("left_angle", "left_rate")  # columns with angles or angular rates of wheels, which need a radius
WHEELS = ("left", "left_speed", *TURNS)
UNEVEN = 0.1  # ratio of sideways to total motion of wheels above which a warning asks whether they are mecanum wheels


class WheelSizes(FileModel):
    """The sizes of a drive with two or four wheels. Sizes in the rig ([odometry.wheels]) have precedence over these settings."""

    track: Annotated[float, Field(gt=0.0, le=20.0), InUnit("m")] | None = None
    """distance between the left and the right wheels"""
    radius: Annotated[float, Field(gt=0.0, le=5.0), InUnit("m")] | None = None
    """radius of the wheels, needed if their angles or angular rates are given"""
    base: Annotated[float, Field(gt=0.0, le=20.0), InUnit("m")] | None = None
    """distance between the axles of four mecanum wheels; without it, four wheels are ordinary wheels"""

    def has_sizes(self) -> bool:
        """True if any size is given."""
        return any(size is not None for size in (self.track, self.radius, self.base))

    def metres(self, source: object, what: str, *, turns: bool) -> float:
        """Return the distance on the ground per unit of a wheel's value: the radius for angles [rad], 1 for distances.

        ``turns``: True if the values are angles or angular rates. ``source``, ``what``: the file and the setting, for
        errors. Raises InputError if a needed size is missing.
        """
        if self.track is None or (turns and self.radius is None):
            lacking = "track" if self.track is None else "radius"
            raise InputError(f"{source}: {what} needs {lacking} [m]: set it here or in [odometry.wheels] of the rig")
        return self.radius if turns and self.radius else 1.0

    def twists(self, source: object, wheels: Array, warnings: list[Notice]) -> Array:
        """Return the motion (N, 3) of the robot in N time steps: forward [m], to the left [m], and rotation [rad].

        ``wheels`` (N, 2 or 4): the distances [m] that the left, right, rear left and rear right wheels roll. If they
        are speeds [m/s], the result is in m/s and rad/s. If they may be mecanum wheels, a warning about ``source`` is
        appended to ``warnings``. Formulas: Taheri, Qiao, Ghaeminezhad, "Kinematic model of a four mecanum wheeled
        mobile robot".
        """
        assert self.track is not None
        left, right, rear_left, rear_right = (wheels if wheels.shape[1] == 4 else np.hstack((wheels, wheels))).T
        ahead, aside = (left + right + rear_left + rear_right) / 4.0, (right - left + rear_left - rear_right) / 4.0
        turn = (right - left + rear_right - rear_left) / (2.0 * (self.track + (self.base or 0.0)))
        uneven = np.abs(aside).sum() / max(float(np.abs(wheels).mean(axis=1).sum()), ZERO)
        if self.base is None and uneven > UNEVEN:
            sentence = (
                "{source}: front and rear wheels differ by {share:.0%}: set base [m], the distance between the axles, if "
                "these are mecanum wheels"
            )
            warnings.append(notice("uneven_wheels", sentence, source, 2.0 * uneven))
        return np.column_stack((ahead, aside if self.base else np.zeros(len(ahead)), turn))


def wheels_of(left: str, count: int) -> tuple[str, ...]:
    """Return the names of the columns of ``count`` wheels (two or four). ``left``: the column of the (front) left wheel."""
    pair = (left, left.replace("left", "right"))
    return pair if count == 2 else (*pair, *(f"rear_{name}" for name in pair))


def between_poses(
    source: object, t_ns: Integers, poses: Array, warnings: list[Notice], lost_ns: Integers = NO_STAMPS
) -> Array:
    """Return the motions (N - 1, 3) from each odometry pose to the next one: x, y [m] and heading [rad].

    A motion is in the body frame of the pose that it begins at. ``poses`` (N, 3): x, y, heading. ``t_ns`` (N,): their
    timestamps. If the odometry is reset to the origin, the motion across the reset is unknown. The returned motion then
    continues the velocity before the reset, and a warning about ``source`` is appended to ``warnings``. ``lost_ns``:
    timestamps at which the device had no pose.
    """
    moves = se2.between(poses[:-1], poses[1:])
    durations = _durations(t_ns)
    speeds, turns = np.hypot(moves[:, 0], moves[:, 1]) / durations, np.abs(moves[:, 2]) / durations
    fastest = _largest_before(speeds, SPEED)
    home = np.hypot(poses[1:, 0], poses[1:, 1]) <= RESET_DISTANCE + fastest * durations
    jumps = (speeds > FASTER * fastest) | (turns > FASTER * _largest_before(turns, TURN))
    zeros = np.all(np.abs(poses[1:]) < ZERO, axis=1) & (speeds * durations > RESET_DISTANCE)
    zeros &= (durations > HOLD_TIME) | (np.diff(np.searchsorted(np.sort(lost_ns), t_ns)) > 0)
    anew = np.flatnonzero((home & jumps) | zeros)
    moves[anew] = se2.exp(_continued(source, t_ns, se2.log(moves), anew, warnings)[anew])
    return moves


def bridge_losses(t_ns: Integers, moves: Array, lost_ns: Integers) -> tuple[Integers, Array]:
    """Return timestamps (M,) [ns] and increments (M, 4) of odometry from a device that sometimes loses its pose.

    ``moves`` (N - 1, 3): motions x, y [m], heading [rad] between valid poses at the timestamps ``t_ns`` (N,).
    ``lost_ns``: timestamps without a pose. An increment is the motion since the previous timestamp, and the part [s] of
    that time without a pose. Without a pose, the last velocity is assumed for at most :data:`HOLD_TIME`, then no
    motion. The increment at the next valid pose corrects the sum. If no pose is lost, ``t_ns`` and increments (N, 3)
    are returned.
    """
    lost = np.setdiff1d(lost_ns[lost_ns > t_ns[0]], t_ns)
    if not len(lost):
        return t_ns, with_start_row(moves)
    every = np.union1d(t_ns, lost)
    at, durations = np.searchsorted(every, t_ns), np.append(0.0, np.diff(every) / 1e9)
    out, velocity = np.zeros((len(every), 4)), np.zeros(3)
    for i, (first, last) in enumerate(pairwise([*at.tolist(), len(every)])):
        elapsed = np.cumsum(durations[first + 1 : last])
        poses = se2.exp(np.vstack((np.zeros(3), np.minimum(elapsed, HOLD_TIME)[:, None] * velocity)))
        out[first + 1 : last, :3] = se2.between(poses[:-1], poses[1:])
        if last < len(every):
            out[last, :3] = se2.between(poses[-1], moves[i])
            velocity = se2.log(moves[i]) / max(float(durations[first + 1 : last + 1].sum()), 1e-3)
        if last > first + 1:
            out[first + 1 : last + 1, 3] = durations[first + 1 : last + 1]
    return every, out


def integrate_velocities(t_ns: Integers, velocities: Array) -> Array:
    """Return the motions (N - 1, 3) of a robot between N timestamps: x, y [m] and heading [rad].

    A motion is in the body frame at its beginning. ``velocities`` (N, 2): forward [m/s] and turn rate [rad/s], constant
    until the next of the timestamps ``t_ns`` (N,), for at most :data:`HOLD_TIME`. After that the robot stands still.
    """
    twists = np.column_stack((velocities[:-1, 0], np.zeros(len(velocities) - 1), velocities[:-1, 1]))
    return np.asarray(se2.exp(twists * np.minimum(np.diff(t_ns) / 1e9, HOLD_TIME)[:, None]))


def with_start_row(moves: Array) -> Array:
    """Return ``moves`` (N - 1, 3) with a row of zeros in front (N, 3), the motion at the first timestamp."""
    return np.vstack((np.zeros((1, 3)), moves))


def wheel_motions(source: object, t_ns: Integers, distances: Array, scales: Array, warnings: list[Notice]) -> Array:
    """Return the distances (N - 1, W) [m] that W wheels roll between N timestamps ``t_ns`` [ns].

    ``distances`` (N, W): the total distances [m] by the encoders. ``scales`` (W,): metres per encoder count, to correct
    encoders that wrap. If the encoders are reset to zero, the distance across the reset continues the speed before it.
    Then a warning about the file ``source`` is appended to ``warnings``.
    """
    steps = np.stack([wheel_steps(distances[:, i], float(scale)) for i, scale in enumerate(scales)], axis=-1)
    durations = _durations(t_ns)
    speeds = np.abs(steps).max(axis=1, initial=0.0) / durations
    fastest = _largest_before(speeds, SPEED)
    home = np.abs(distances[1:]).max(axis=1, initial=0.0) <= RESET_DISTANCE + fastest * durations
    anew = np.flatnonzero(home & (speeds > FASTER * fastest))
    return _continued(source, t_ns, steps, anew, warnings)


def motion_of_wheel_distances(
    source: object, t_ns: Integers, distances: Array, scales: Array, sizes: WheelSizes, warnings: list[Notice]
) -> Array:
    """Return the motions (N - 1, 3) of a robot between N timestamps: x, y [m] and heading [rad].

    A motion is in the body frame at its beginning. ``distances`` (N, W): total distances [m] of W = 2 or 4 wheels
    (left, right, rear left, rear right) at ``t_ns`` (N,). ``scales`` (W,): metres per encoder count, to correct
    encoders that wrap. ``sizes``: the sizes of the drive. Warnings about the file ``source`` are appended to
    ``warnings``.
    """
    return se2.exp(sizes.twists(source, wheel_motions(source, t_ns, distances, scales, warnings), warnings))


def motion_of_wheel_speeds(
    source: object, t_ns: Integers, speeds: Array, sizes: WheelSizes, warnings: list[Notice]
) -> Array:
    """Return velocities (N, 2) of a robot from the speeds of its wheels: forward [m/s] and turn rate [rad/s].

    For mecanum wheels, return increments (N, 3) instead: x, y [m] and heading [rad] since the previous timestamp.
    ``speeds`` (N, 2 or 4) [m/s]: left, right, rear left, rear right, each constant until the next of the timestamps
    ``t_ns`` (N,). ``sizes``: the sizes of the drive. Warnings about ``source`` are appended to ``warnings``.
    """
    twists = sizes.twists(source, speeds, warnings)
    if sizes.base is None:
        return twists[:, [0, 2]]
    return with_start_row(se2.exp(twists[:-1] * (np.diff(t_ns) / 1e9)[:, None]))


def odometry_stream(
    t_ns: Integers, values: Array, t0_ns: int, rules: RowRules, warnings: list[Notice]
) -> IncrementStream | VelocityStream:
    """Return odometry from ``values``: velocities (N, 2), or increments (N, 3 or 4) since the previous timestamp.

    ``t_ns`` (N,): timestamps. ``t0_ns``: timestamp of t = 0. If the ``rules`` skip invalid rows, implausibly fast
    motions are skipped too, and a warning is appended to ``warnings``.
    """
    t, columns = checks.seconds(t_ns, t0_ns), np.ascontiguousarray(values.T)
    stream = VelocityStream(t, *columns) if len(columns) == 2 else IncrementStream(t, *columns)
    return without_jumps(stream, rules, warnings)


def wheel_steps(distances: Array, scale: float) -> Array:
    """Return the differences (N - 1,) of successive distances (N,) of a wheel. ``scale``: distance per encoder count.

    A difference is corrected if the encoder wraps to 0. Limitation: each must be less than half of the encoder's range.
    """
    steps: Array = np.diff(distances)
    ticks = distances / scale
    if not np.allclose(ticks, np.rint(ticks), atol=1e-3):
        return steps
    size = next((size for size in COUNTERS if ticks.min() >= -(size // 2) and ticks.max() < size), None)
    # the counter has no known range, or it never wraps
    if size is None or np.abs(steps).max(initial=0.0) <= 0.5 * size * abs(scale):
        return steps
    whole = size * scale
    return np.asarray(steps - whole * np.rint(steps / whole))


def _durations(t_ns: Integers) -> Array:
    """Return the durations (N - 1,) [s] between N timestamps. Each is at least a millisecond, because timestamps may repeat."""
    return np.asarray(np.maximum(np.diff(t_ns), 1_000_000) / 1e9)


def _largest_before(rates: Array, least: float) -> Array:
    """Return, for each of ``rates`` (N,), the maximum of the rates before it, but at least ``least``. Jumps are
    ignored: rates above :data:`FASTER` times the maximum before them."""
    out, most = np.empty(len(rates)), least
    for i, rate in enumerate(rates.tolist()):
        out[i] = most
        if most < rate <= FASTER * most:
            most = rate
    return out


def _continued(source: object, t_ns: Integers, steps: Array, resets: Integers, warnings: list[Notice]) -> Array:
    """Return the ``steps`` (N - 1, D) between N timestamps ``t_ns``. Steps at the indices ``resets`` are unknown.

    Each is replaced by the previous step, scaled to its own duration, or to :data:`HOLD_TIME` if that is shorter. If
    there are resets, a warning that names the file ``source`` is appended to ``warnings``."""
    durations = _durations(t_ns)
    for i in resets.tolist():
        previous = steps[i - 1] / durations[i - 1] if i else np.zeros(steps.shape[1])
        steps[i] = previous * min(float(durations[i]), HOLD_TIME)
    if len(resets):
        at = (int(t_ns[resets[0] + 1]) - int(t_ns[0])) / 1e9
        times = "" if len(resets) == 1 else " {resets} times, first"
        reset = f"{{source}}: the odometry is reset{times} {{t:.1f}} s after its start: the previous motion is continued there"
        warnings.append(Notice("odometry_reset", reset, {"source": str(source), "resets": len(resets), "t": at}))
    return steps


def with_wheels_of(rig: Rig | None, options: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the ``options`` of a reader, with the wheel radius and track of ``rig`` instead of those in the options.

    Returns ``options`` unchanged if they do not describe wheels, or if ``rig`` is None or has no wheels.
    """
    drive = None if rig is None else rig.of(OdometrySettings).wheels
    odometry = options.get("odometry")
    if drive is None or not isinstance(odometry, Mapping):
        return options
    known = drive.model_dump(exclude_none=True)
    if isinstance(wheels := odometry.get("wheels"), Mapping):
        return {**options, "odometry": {**odometry, "wheels": {**wheels, **known}}}
    if isinstance(columns := odometry.get("columns"), Mapping) and columns.keys() & set(WHEELS):
        return {**options, "odometry": {**odometry, **known}}
    return options


def with_wheels_in(rig: Rig, options: Mapping[str, Any]) -> Rig:
    """Return ``rig``. If it has no wheels, it gets the wheel radius and track in the ``options`` of the reader."""
    odometry = options.get("odometry")
    settings = rig.of(OdometrySettings)
    if settings.wheels is not None or not isinstance(odometry, Mapping):
        return rig
    sizes = odometry.get("wheels") or odometry
    if sizes.get("track") is None or sizes.get("base") is not None:
        return rig
    drive = DifferentialDrive(radius=sizes.get("radius"), track=sizes["track"])
    return rig.model_copy(update={"odometry": settings.model_copy(update={"wheels": drive})})
