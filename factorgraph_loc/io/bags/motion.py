"""Motion of the robot in a bag: poses or velocities of odometry, wheel angles, or the gyro of an IMU."""

from typing import Literal

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import checks
from factorgraph_loc.io import motions
from factorgraph_loc.io.bags.clock import TF, Clock, Stamper
from factorgraph_loc.io.bags.file import Bag, Stamped
from factorgraph_loc.io.bags.frames import FrameReference, StaticFrames
from factorgraph_loc.io.bags.poses import POSES, Poses
from factorgraph_loc.io.bags.rows import TopicRows
from factorgraph_loc.io.bags.wheels import (
    JOINTS,
    JointRows,
    OneWheel,
    TwoWheels,
    WheelSettings,
    finite_columns,
    wheel_motion,
)
from factorgraph_loc.model.planar import Turned, about_z, on_floor
from factorgraph_loc.sensors.odometry.stream import IncrementStream, VelocityStream, YawRateStream
from factors.se2 import Array, Integers

ODOMETRY = "nav_msgs/msg/Odometry"
TWISTS = {"geometry_msgs/msg/Twist": "", "geometry_msgs/msg/TwistStamped": "twist"}
IMU = "sensor_msgs/msg/Imu"


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


Motion = IncrementStream | VelocityStream


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
