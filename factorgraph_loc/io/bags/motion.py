"""Motion of the robot in a bag: poses or velocities of odometry, the gyro of an IMU, or the wheels of a differential drive, each a
topic, or joints of one message.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import checks
from factorgraph_loc.files.models import FileModel, InUnit, nearest
from factorgraph_loc.io import motions
from factorgraph_loc.io.bags.fields import TF, Clock, Fields, Stamper, as_number
from factorgraph_loc.io.bags.file import Bag, Stamped, TopicRows
from factorgraph_loc.io.bags.frames import FrameReference, StaticFrames
from factorgraph_loc.io.bags.poses import POSES, Poses
from factorgraph_loc.model.planar import Turned, about_z, on_floor
from factorgraph_loc.sensors.odometry.measurement import IncrementStream, VelocityStream, YawRateStream
from factorgraph_loc.text import quoted
from factors.se2 import Array, Integers

JOINTS = "sensor_msgs/msg/JointState"
APART = 0.5  # of the usual time between messages of a wheel: more between left and right are no pair
ODOMETRY = "nav_msgs/msg/Odometry"
TWISTS = {"geometry_msgs/msg/Twist": "", "geometry_msgs/msg/TwistStamped": "twist"}
IMU = "sensor_msgs/msg/Imu"
Motion = IncrementStream | VelocityStream


class WheelSettings(FileModel):
    """A differential drive. ``radius`` and ``track`` of the rig ([odometry.wheels]) come before those given here."""

    left: str
    """name of the left wheel's joint; for a topic for each wheel, the field with the number"""
    right: str
    """as left, of the right wheel"""
    right_topic: str | None = None
    """topic of the right wheel, if each wheel has a topic"""
    unit: Literal["rad", "m"] = "rad"
    """whether the wheels tell how they turn, or the way that they roll"""
    radius: Annotated[float, Field(gt=0.0, le=5.0), InUnit("m")] | None = None
    """radius of the wheels, if they tell how they turn"""
    track: Annotated[float, Field(gt=0.0, le=20.0), InUnit("m")] | None = None
    """distance between the wheels"""

    def sizes(self, source: str) -> tuple[float, float]:
        """Metres per unit, and the track [m]. InputError if one of them is missing."""
        needed = {"track": self.track} | ({"radius": self.radius} if self.unit == "rad" else {})
        if lacking := [name for name, value in needed.items() if value is None]:
            raise InputError(
                f"{source}: odometry.wheels.{lacking[0]} is missing [m], here or in [odometry.wheels] of the rig"
            )
        assert self.track is not None
        return 1.0 if self.unit == "m" or self.radius is None else self.radius, self.track


class JointRows:
    """Collects the angles or angular velocities of two joints of a topic."""

    def __init__(self, bag: Bag, topic: str, wheels: WheelSettings, column: str) -> None:
        self._wheels, self._column = wheels, column
        self.rows = TopicRows(f"{bag.path} {topic}", 2)
        self._seen: set[str] = set()

    def add(self, item: Stamped, t_ns: int) -> None:
        names, values = item.message.name, getattr(item.message, self._column)
        self._seen.update(names)
        if len(values) != len(names):
            if self._wheels.left in names:
                raise InputError(
                    f"{self.rows.source}:{item.row}: has {len(values)} numbers of {self._column} for {len(names)} joints, "
                    "expected one for each; select the other with odometry.use"
                )
            return
        if self._wheels.left in names and self._wheels.right in names:  # other messages contain other joints
            wheels = (values[names.index(self._wheels.left)], values[names.index(self._wheels.right)])
            self.rows.append(item, t_ns, (float(wheels[0]), float(wheels[1])))

    def pairs(self, warnings: list[str]) -> tuple[Integers, Array, Array]:
        """Timestamps (N,), left and right (N,). InputError if no message has both joints."""
        if not len(self.rows):
            wrong = next((n for n in (self._wheels.left, self._wheels.right) if n not in self._seen), self._wheels.left)
            raise InputError(
                f"{self.rows.source}: has no message with both wheels, {quoted(wrong)}{nearest(wrong, sorted(self._seen))}"
            )
        t_ns, (left, right) = finite_columns(self.rows, ("left wheel", "right wheel"), warnings)
        return t_ns, left, right


class OneWheel:
    """Collects a number from each message of a topic."""

    def __init__(self, bag: Bag, topic: str, path: str) -> None:
        self.topic = topic
        self._fields = Fields(bag, bag.topic(topic), {"wheel": path})
        self.rows = TopicRows(f"{bag.path} {topic}", 1)
        if self._fields.has_list:
            raise InputError(
                f"{self.rows.source}: odometry.wheels has {quoted(path)}, expected the field of one number"
            )

    def add(self, item: Stamped, t_ns: int) -> None:
        ((value,),) = self._fields.rows(item.message, item.row)
        self.rows.append(item, t_ns, (as_number(value),))


class TwoWheels:
    """The numbers of two topics, in pairs with the nearest stamps. A pair has the later one, when both are known."""

    def __init__(self, left: OneWheel, right: OneWheel) -> None:
        self.left, self.right = left, right
        self.add = left.add
        self.rows = left.rows

    def pairs(self, warnings: list[str]) -> tuple[Integers, Array, Array]:
        """Timestamps (N,), left and right (N,). InputError if the topics have no time in common."""
        l_ns, (left,) = finite_columns(self.left.rows, ("wheel",), warnings)
        r_ns, (right,) = finite_columns(self.right.rows, ("wheel",), warnings)
        after = np.clip(np.searchsorted(r_ns, l_ns), 0, len(r_ns) - 1)
        before = np.maximum(after - 1, 0)
        near = np.where(np.abs(r_ns[before] - l_ns) <= np.abs(r_ns[after] - l_ns), before, after)
        usual = float(np.median(np.diff(l_ns))) if len(l_ns) > 1 else 0.0
        keep = np.flatnonzero(np.abs(r_ns[near] - l_ns) <= APART * usual)
        t_ns = np.maximum(l_ns, r_ns[near])[keep]
        if not len(t_ns):
            raise InputError(f"{self.left.rows.source} and {self.right.rows.source}: no messages are near in time")
        if lost := len(l_ns) - len(keep):
            warnings.append(f"{self.left.rows.source}: {lost} messages have none of the right wheel near in time")
        alone = np.append(np.diff(t_ns) > 0, True)  # the last one of equal stamps
        return t_ns[alone], left[keep][alone], right[near[keep]][alone]


def wheel_motion(
    rows: JointRows | TwoWheels, wheels: WheelSettings, column: str, warnings: list[str]
) -> tuple[Integers, Array, bool]:
    """Timestamps (N,) with velocities v, w (N, 2), or with motions (N - 1, 3) between them; and whether these are motions."""
    source = rows.rows.source
    size, track = wheels.sizes(source)
    t_ns, left, right = rows.pairs(warnings)
    turned = np.column_stack((left, right))
    if column == "velocity":
        return t_ns, motions.velocities_of_wheels(size * turned, track), False
    return t_ns, motions.between_wheels(source, t_ns, size * turned, np.full(2, size), track, warnings), True


def finite_columns(rows: TopicRows, names: Sequence[str], warnings: list[str]) -> tuple[Integers, list[Any]]:
    """Timestamps and columns of rows in order of time, all finite; InputError names the invalid message."""
    number, t_ns, values = rows.rows, rows.t_ns, rows.values
    for i, name in enumerate(names):
        checks.require_finite(rows.source, number, name, values[:, i])
    keep = checks.in_order(rows.source, number, t_ns, warnings)
    return t_ns[keep], [values[keep, i] for i in range(len(names))]


class OdometryTopic(Turned):
    """A topic of odometry, of tf with two frames, or of wheel joints."""

    topic: str
    """name of the topic"""
    use: Literal["pose", "twist"] = "pose"
    """the pose of odometry, as motion between messages, or its twist; for wheels, how far they turned, or how fast"""
    parent: str | None = None
    """frame of the odometry's origin, for tf"""
    child: str | None = None
    """frame of the robot, for tf"""
    wheels: WheelSettings | None = None
    """wheels of a topic of joints, or of two topics; topic is the one of the left wheel"""
    clock: Clock | None = None
    """timestamps of message headers or of receipt; by default as for the bag"""


class ImuTopic(Turned):
    """A topic of an IMU: its turn rate about the robot's z axis."""

    topic: str
    """name of the topic"""
    frame: str | None = None
    """frame of the IMU, whose orientation is in tf_static; without it use axes and mounting"""
    clock: Clock | None = None
    """timestamps of message headers or of receipt; by default as for the bag"""


class PoseMotion:
    """Odometry from poses in its own frame: the motion between consecutive poses."""

    def __init__(self, bag: Bag, options: OdometryTopic) -> None:
        self._poses = Poses(bag, options.topic, options)
        self.add = self._poses.add

    def stream(self, warnings: list[str]) -> tuple[Integers, Motion]:
        """Absolute timestamps (N,) and the stream, whose timestamps start at 0."""
        t_ns, poses = self._poses.in_order(warnings)
        return t_ns, increments(t_ns, motions.between_poses(self._poses.rows.source, t_ns, poses, warnings))


class TransformMotion:
    """Odometry from transforms: the motion of a frame in another one between consecutive transforms."""

    def __init__(self, bag: Bag, options: OdometryTopic, stamper: Stamper, static: StaticFrames) -> None:
        self._frames = FrameReference(bag, options, stamper)
        self._source, self._turned, self._static = f"{bag.path} {options.topic}", options, static
        self.add = self._frames.add

    def stream(self, warnings: list[str]) -> tuple[Integers, Motion]:
        path = self._frames.path(self._static, warnings)
        assert path.t_ns is not None
        poses = on_floor(self._source, path.positions, path.rotations, warnings, self._turned)
        return path.t_ns, increments(path.t_ns, motions.between_poses(self._source, path.t_ns, poses, warnings))


class TwistMotion:
    """Odometry from velocities, each held until the next."""

    def __init__(self, bag: Bag, options: OdometryTopic) -> None:
        kind = bag.topic(options.topic).type
        self._of_odometry = kind == ODOMETRY
        self._stamped = kind.endswith("TwistStamped")
        self._rows = TopicRows(f"{bag.path} {options.topic}", 2)

    def add(self, item: Stamped, t_ns: int) -> None:
        twist = item.message
        if self._of_odometry:
            twist = twist.twist.twist
        elif self._stamped:
            twist = twist.twist
        self._rows.append(item, t_ns, (twist.linear.x, twist.angular.z))

    def stream(self, warnings: list[str]) -> tuple[Integers, Motion]:
        t_ns, (v, w) = finite_columns(self._rows, ("v", "w"), warnings)
        return t_ns, VelocityStream(checks.seconds(t_ns, int(t_ns[0])), v, w)


class WheelMotion:
    """Odometry from the angles or angular velocities of two wheels, of joints or with a topic each."""

    def __init__(self, bag: Bag, options: OdometryTopic, wheels: WheelSettings) -> None:
        self._wheels = wheels
        self._column = "position" if options.use == "pose" else "velocity"
        self._rows: JointRows | TwoWheels
        if wheels.right_topic is None:
            self._rows = JointRows(bag, options.topic, wheels, self._column)
        else:
            left, right = OneWheel(bag, options.topic, wheels.left), OneWheel(bag, wheels.right_topic, wheels.right)
            self._rows = TwoWheels(left, right)
        self.add = self._rows.add

    @property
    def right(self) -> OneWheel | None:
        """The collector of the right wheel's own topic, if there is one."""
        return self._rows.right if isinstance(self._rows, TwoWheels) else None

    def stream(self, warnings: list[str]) -> tuple[Integers, Motion]:
        t_ns, motion, moves = wheel_motion(self._rows, self._wheels, self._column, warnings)
        if moves:
            return t_ns, increments(t_ns, motion)
        return t_ns, VelocityStream(checks.seconds(t_ns, int(t_ns[0])), *np.ascontiguousarray(motion.T))


class YawRates:
    """The turn rate of an IMU."""

    def __init__(self, bag: Bag, options: ImuTopic) -> None:
        topic = bag.topic(options.topic)
        if topic.type != IMU:
            raise InputError(f"{bag.path}: topic {topic.name} is of type {topic.type}, expected {IMU}")
        if options.frame is not None and options.is_given():
            raise InputError(f"{bag.path} {topic.name}: tf_static has the frame, expected no axes or mounting")
        self._options = options
        self._rows = TopicRows(f"{bag.path} {options.topic}", 3)

    def add(self, item: Stamped, t_ns: int) -> None:
        rate = item.message.angular_velocity
        self._rows.append(item, t_ns, (rate.x, rate.y, rate.z))

    def stream(self, frames: StaticFrames, base: str, t0_ns: int, warnings: list[str]) -> YawRateStream:
        """Turn rates about the robot's z axis; only the axes of the IMU that contribute must be finite."""
        turned = self._options.turned()
        if self._options.frame is not None:
            turned = frames.known(self._rows.source, self._options.frame, base)[:3, :3]
        rows, t_ns = self._rows.rows, self._rows.t_ns
        w = about_z(self._rows.source, rows, self._rows.values, turned)
        keep = checks.in_order(self._rows.source, rows, t_ns, warnings)
        return YawRateStream(checks.seconds(t_ns[keep], t0_ns), w[keep])


OdometryRows = PoseMotion | TransformMotion | TwistMotion | WheelMotion


def odometry(bag: Bag, options: OdometryTopic, stamper: Stamper, static: StaticFrames) -> OdometryRows:
    """The collector for an odometry topic, by message type."""
    kind = bag.topic(options.topic).type
    if kind in TF:
        return TransformMotion(bag, options, stamper, static)
    if options.parent is not None or options.child is not None:
        raise InputError(f"{bag.path} {options.topic}: odometry.parent and odometry.child are for tf, this is {kind}")
    poses = kind in POSES and not (kind == ODOMETRY and options.use == "twist")
    if options.is_given() and not poses:
        raise InputError(f"{bag.path} {options.topic}: axes and mounting are for odometry that comes as poses")
    if kind == JOINTS and options.wheels is None:
        raise InputError(f"{bag.path} {options.topic}: odometry.wheels is missing: left, right, radius and track")
    if options.wheels is not None:
        if kind != JOINTS and options.wheels.right_topic is None:
            raise InputError(
                f"{bag.path} {options.topic}: odometry.wheels.right_topic is missing, as {kind} has no joints"
            )
        return WheelMotion(bag, options, options.wheels)
    if poses:
        return PoseMotion(bag, options)
    if kind in TWISTS or kind == ODOMETRY:
        return TwistMotion(bag, options)
    known = ", ".join(sorted({*POSES, *TWISTS, JOINTS, TF[0]}))
    raise InputError(f"{bag.path}: topic {options.topic} is of type {kind}, expected one of {known}")


def increments(t_ns: Integers, moves: Array) -> IncrementStream:
    """The motions (N - 1, 3) between N timestamps as increments; the first row only defines the start."""
    dx, dy, dtheta = np.vstack((np.zeros((1, 3)), moves)).T
    return IncrementStream(checks.seconds(t_ns, int(t_ns[0])), dx, dy, dtheta)
