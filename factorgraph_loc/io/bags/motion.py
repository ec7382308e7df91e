"""Reads the motion of the robot from a bag: poses or velocities of odometry, turn rates of an IMU, or the motion of wheels.

Wheels are joints of one message, or each of two wheels has a topic.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import checks
from factorgraph_loc.files.models import nearest
from factorgraph_loc.files.row_rules import RowRules
from factorgraph_loc.io import motions
from factorgraph_loc.io.bags.file import Bag, Stamped
from factorgraph_loc.io.bags.poses import POSES, PoseTopic, StaticFrames, poses_of_topic
from factorgraph_loc.io.bags.topics import LIST, TF, Listeners, RowTopic, TopicRows, check_path
from factorgraph_loc.model.planar import NEGLIGIBLE, Turned, about_z, are_null, null_poses
from factorgraph_loc.sensors.odometry.jumps import without_jumps
from factorgraph_loc.sensors.odometry.measurement import YawRateStream
from factorgraph_loc.sensors.tables import Reading
from factorgraph_loc.text import Notice, notice, quoted
from factors.se2 import Array, Integers

JOINTS = "sensor_msgs/msg/JointState"
MAX_OFFSET = 0.5  # maximum time between the messages of a pair of wheels, as a fraction of the median message interval
ODOMETRY = "nav_msgs/msg/Odometry"
TWISTS = {  # path of the twist in a message, by message type
    "geometry_msgs/msg/Twist": "",
    "geometry_msgs/msg/TwistStamped": "twist.",
}
IMU = "sensor_msgs/msg/Imu"
Motion = Callable[[list[Notice]], tuple[Integers, Array]]
"""A function that computes the motion after the bag is read. It returns timestamps (N,) [ns], and velocities (N, 2) or
increments (N, 3 or 4). It appends warnings to its argument."""


class WheelSettings(motions.WheelSizes):
    """The joints and the sizes of two or four wheels. The ``radius`` and ``track`` in [odometry.wheels] of the rig have
    precedence over these settings."""

    left: str
    """name of the left wheel's joint; if each wheel has a topic, the field with the wheel's value"""
    right: str
    """name of the right wheel's joint; if each wheel has a topic, the field with the wheel's value"""
    rear_left: str | None = None
    """name of the rear left wheel's joint, if there are four wheels"""
    rear_right: str | None = None
    """name of the rear right wheel's joint, if there are four wheels"""
    right_topic: str | None = None
    """topic of the right wheel, if each wheel has a topic"""
    unit: Literal["rad", "m"] | Annotated[float, Field(gt=0.0)] = "rad"
    """unit of the wheels' values: rad for angles, m for distances, or a number, the radians per encoder count"""

    @property
    def joints(self) -> tuple[str, ...]:
        """The names of the joints of two, three or four wheels: left, right, rear left, rear right."""
        return tuple(name for name in (self.left, self.right, self.rear_left, self.rear_right) if name is not None)


class JointRows:
    """Collects the angles or angular velocities of W wheels from a ``topic`` with JointState messages.

    ``wheels``: the names of the joints. ``column``: the field of the message to read, ``position`` or ``velocity``.
    ``rules``: whether invalid rows are skipped, and rows sorted by time.
    """

    def __init__(self, bag: Bag, topic: str, wheels: WheelSettings, column: str, rules: RowRules) -> None:
        self._wheels, self._column = wheels, column
        self.rows = TopicRows(f"{bag.path} {topic}", len(wheels.joints), rules=rules)
        self._seen: set[str] = set()

    def add(self, item: Stamped, t_ns: int) -> None:
        names, values = item.message.name, getattr(item.message, self._column)
        self._seen.update(names)
        if len(values) != len(names):
            if self._wheels.left in names:
                raise InputError(
                    f"{self.rows.source}:{item.row}: has {len(values)} numbers of {self._column} for {len(names)} joints, "
                    "expected one for each; odometry.use selects position (pose) or velocity (twist)"
                )
            return
        if set(self._wheels.joints) <= set(names):  # a topic may have messages of other joints too
            self.rows.append(item, t_ns, [values[names.index(joint)] for joint in self._wheels.joints])

    def pairs(self, warnings: list[Notice]) -> tuple[Integers, Array]:
        """Return timestamps (N,) [ns] and the angles or angular velocities (N, W) of W wheels, in order of time.

        Skipped rows add a warning to ``warnings``. Raises InputError if no message has all joints.
        """
        joints = self._wheels.joints
        if not len(self.rows):
            wrong = next((joint for joint in joints if joint not in self._seen), self._wheels.left)
            raise InputError(
                f"{self.rows.source}: has no message with all joints of the wheels: check {quoted(wrong)}"
                f"{nearest(wrong, sorted(self._seen))}"
            )
        return self.rows.in_order(joints, warnings)


def paired(lefts: TopicRows, rights: TopicRows, warnings: list[Notice]) -> tuple[Integers, Array]:
    """Return the timestamps (N,) [ns] and values (N, 2) of two wheels, left and right, from messages paired by time.

    Each message of the left wheel (``lefts``) is paired with the message of the right wheel (``rights``) nearest in
    time. The timestamp is the later of the two. Pairs are skipped if their times differ by more than :data:`MAX_OFFSET`
    times the median period. Then a warning is appended to ``warnings``. Raises InputError if no pair remains.
    """
    l_ns, left = lefts.in_order(("wheel",), warnings)
    r_ns, right = rights.in_order(("wheel",), warnings)
    later = np.clip(np.searchsorted(r_ns, l_ns), 0, len(r_ns) - 1)
    earlier = np.maximum(later - 1, 0)
    near = np.where(np.abs(r_ns[earlier] - l_ns) <= np.abs(r_ns[later] - l_ns), earlier, later)
    usual = float(np.median(np.diff(l_ns))) if len(l_ns) > 1 else 0.0
    keep = np.flatnonzero(np.abs(r_ns[near] - l_ns) <= MAX_OFFSET * usual)
    t_ns = np.maximum(l_ns, r_ns[near])[keep]
    if not len(t_ns):
        raise InputError(f"{lefts.source} and {rights.source}: no messages of the two wheels are near in time")
    if lost := len(l_ns) - len(keep):
        sentence = "{source}: {messages} messages are skipped: no message of the right wheel is near in time"
        warnings.append(notice("unpaired_wheels", sentence, lefts.source, lost))
    is_last = np.append(np.diff(t_ns) > 0, True)  # of equal timestamps
    return t_ns[is_last], np.hstack((left[keep], right[near[keep]]))[is_last]


class OdometryTopic(PoseTopic):
    """The settings of the topic that gives the odometry: odometry messages, poses, velocities, tf, or wheel joints."""

    use: Literal["pose", "twist"] = "pose"
    """part of odometry messages to use: pose gives the motion between messages, twist the velocity; for wheels,
    pose means their angles and twist their angular rates"""
    wheels: WheelSettings | None = None
    """joints and sizes of the wheels, if topic has joint states, or is the topic of the left wheel of two"""


class ImuTopic(RowTopic, Turned):
    """The settings of a topic of an IMU. Only the turn rate about the robot's z axis is used."""

    frame: str | None = None
    """frame of the IMU in tf_static, which gives its orientation; if tf_static lacks it, use axes and mounting instead"""


class YawRates:
    """Collects the angular velocities from an IMU topic, and computes the yaw rate of the robot from them."""

    def __init__(self, bag: Bag, options: ImuTopic, frames: StaticFrames) -> None:
        topic = bag.topic(options.topic, IMU)
        if options.frame is not None and options.is_given():
            raise InputError(
                f"{bag.path} {topic.name}: frame is given, so tf_static gives the axes: remove axes and mounting"
            )
        self._options, self._frames = options, frames
        paths = [f"angular_velocity.{axis}" for axis in "xyz"]
        self._rows = TopicRows(f"{bag.path} {options.topic}", 3, paths, options)
        self.add = self._rows.add

    def stream(self, reading: Reading) -> YawRateStream:
        """Return the times [s] and the turn rates about the robot's z axis [rad/s].

        IMU axes perpendicular to this axis have no influence, and their rates may be NaN. ``reading``: has the absolute
        time of t = 0 in the stream, and a list that receives warnings.
        """
        turned = self._options.turned()
        if self._options.frame is not None:
            turned = self._frames.known(self._rows.source, self._options.frame)[:3, :3]
        needed = np.flatnonzero(np.abs(turned[2]) > NEGLIGIBLE)
        names = [f"turn rate about {axis}" for axis in "xyz"]
        values = self._rows.values
        keep = self._rows.kept([checks.not_finite(names, values)[i] for i in needed.tolist()], reading.warnings)
        w = about_z(self._rows.source, self._rows.rows[keep], values[keep], turned)
        stream = YawRateStream(checks.seconds(self._rows.t_ns[keep], reading.t0_ns), w)
        return without_jumps(stream, self._rows.rules, reading.warnings)


def odometry(listeners: Listeners, options: OdometryTopic, static: StaticFrames) -> Motion:
    """Register a collector of messages for the odometry topic, and return a function that computes odometry from them.

    Call the function after the bag is read, with a list that receives warnings. It returns timestamps (N,) [ns] and
    either velocities (N, 2) or increments (N, 3 or 4). ``listeners``: the collectors of the bag. ``options``: the
    settings of the topic. ``static``: the static transforms of the bag. Raises InputError if the options do not fit the
    message type.
    """
    bag, source = listeners.bag, f"{listeners.bag.path} {options.topic}"
    known = () if options.wheels else sorted({*POSES, *TWISTS, JOINTS, *TF})
    kind = bag.topic(options.topic, *known).type
    if kind not in TF and (options.parent is not None or options.child is not None):
        raise InputError(
            f"{source}: odometry.parent or odometry.child is given, but the type is {kind}, not tf: remove it"
        )
    poses = kind in TF or (kind in POSES and not (kind == ODOMETRY and options.use == "twist"))
    if options.is_given() and not poses:
        raise InputError(f"{source}: axes or mounting is given, but the odometry is not read as poses: remove it")
    if kind == JOINTS and options.wheels is None:
        raise InputError(f"{source}: odometry.wheels is missing: give left, right, radius and track in it")
    if options.wheels is not None and kind not in TF:
        if kind != JOINTS and options.wheels.right_topic is None:
            raise InputError(f"{source}: odometry.wheels.right_topic is missing, which {kind} needs: it has no joints")
        return _of_wheels(listeners, options, options.wheels)
    if poses:
        return _of_poses(listeners, options, static)
    twist = TWISTS.get(kind, "twist.twist.")
    paths = [f"{twist}linear.x", f"{twist}angular.z"]
    if kind == ODOMETRY:
        paths += [
            *(f"pose.pose.orientation.{axis}" for axis in "xyzw"),
            *(f"{part}.covariance[0]" for part in ("pose", "twist")),
        ]
    return partial(_velocities, listeners.listen(options, TopicRows(source, len(paths), paths, options)))


def _velocities(rows: TopicRows, warnings: list[Notice]) -> tuple[Integers, Array]:
    """Return the timestamps (N,) [ns] and the velocities (N, 2): forward [m/s] and turn rate [rad/s].

    ``rows``: rows of two velocities, and optionally a quaternion and the variances of x and y. A zero quaternion or a
    huge variance means that the device had lost its pose. The timestamps and increments (M, 4) of
    :func:`motions.bridge_losses` are then returned instead, and a warning is appended to ``warnings``."""
    values = rows.values
    null = np.zeros(len(rows), dtype=bool)
    if values.shape[1] > 2:
        # null quaternions before the first valid one are no sign of a lost pose: the program may not measure rotations
        has_rotations = np.logical_or.accumulate(values[:, 2:6].any(axis=1))
        null = are_null(values[:, 2:6], values[:, 6:]) & has_rotations
    known = np.flatnonzero(~null)
    keep = rows.kept(checks.not_finite(("v", "w"), values[known, :2]), warnings, known)
    t_ns, velocities = rows.t_ns[keep], values[keep, :2]
    if not null.any():
        return t_ns, velocities
    warnings.append(null_poses(rows.source, int(rows.rows[null.argmax()]), int(np.count_nonzero(null))))
    return motions.bridge_losses(t_ns, motions.integrate_velocities(t_ns, velocities), np.sort(rows.t_ns[null]))


def _of_poses(listeners: Listeners, options: OdometryTopic, static: StaticFrames) -> Motion:
    """Register a collector of poses or tf at ``listeners``. Return a function that computes odometry from them.

    ``options``: the topic. ``static``: the static transforms of the bag. Call the function with a list that receives
    warnings. It returns timestamps (N,) [ns] and increments (N, 3 or 4).
    """
    made = poses_of_topic(listeners, options, static)

    def motion(warnings: list[Notice]) -> tuple[Integers, Array]:
        path = made(warnings)
        t_ns = path.stamps()
        moves = motions.between_poses(path.name, t_ns, path.on_floor(warnings, options), warnings, path.lost_ns)
        return motions.bridge_losses(t_ns, moves, path.lost_ns)

    return motion


def _of_wheels(listeners: Listeners, options: OdometryTopic, wheels: WheelSettings) -> Motion:
    """Register collectors of ``wheels`` at ``listeners``. Return a function that computes odometry from the wheels.

    Call the function with a list that receives warnings. It returns timestamps (N,) [ns] and velocities (N, 2) or
    increments (N, 3)."""
    bag = listeners.bag
    if (wheels.base is not None or len(wheels.joints) == 3) and len(wheels.joints) != 4:
        raise InputError(
            f"{bag.path} {options.topic}: odometry.wheels names {len(wheels.joints)} joints, expected rear_left and rear_right too"
        )
    if wheels.right_topic is not None and len(wheels.joints) > 2:
        raise InputError(
            f"{bag.path} {options.topic}: odometry.wheels.right_topic is for two wheels: remove rear_left and rear_right"
        )
    are_speeds = options.use == "twist"
    rows: Motion
    if wheels.right_topic is None:
        collector = JointRows(bag, options.topic, wheels, "velocity" if are_speeds else "position", options)
        rows = listeners.listen(options, collector).pairs
    else:
        of_right = options.model_copy(update={"topic": wheels.right_topic})
        left = listeners.listen(options, _wheel(bag, options.topic, wheels.left, options))
        rows = partial(paired, left, listeners.listen(of_right, _wheel(bag, wheels.right_topic, wheels.right, options)))

    def motion(warnings: list[Notice]) -> tuple[Integers, Array]:
        source = f"{bag.path} {options.topic}"
        size = wheels.metres(source, "odometry.wheels", turns=wheels.unit != "m")
        if isinstance(wheels.unit, float):
            size *= wheels.unit
        t_ns, numbers = rows(warnings)
        if are_speeds:
            return t_ns, motions.motion_of_wheel_speeds(source, t_ns, size * numbers, wheels, warnings)
        scales = np.full(numbers.shape[1], size)
        moves = motions.motion_of_wheel_distances(source, t_ns, size * numbers, scales, wheels, warnings)
        return t_ns, motions.with_start_row(moves)

    return motion


def _wheel(bag: Bag, topic: str, path: str, rules: RowRules) -> TopicRows:
    """Return a collector of the values of one wheel. ``path``: the field of the messages that has the value."""
    source = f"{bag.path} {topic}"
    known = bag.topic(topic)
    check_path(bag.store(topic), known, path, f"{bag.path}: topic {topic}: wheel")
    if LIST in path:
        raise InputError(f"{source}: odometry.wheels has the list {quoted(path)}, expected a field with one number")
    return TopicRows(source, 1, (path,), rules)
