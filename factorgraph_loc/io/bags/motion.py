"""Motion of the robot in a bag: poses or velocities of odometry, wheel angles, or the gyro of an IMU."""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import checks
from factorgraph_loc.files.models import FileModel, InUnit, nearest
from factorgraph_loc.io import motions
from factorgraph_loc.io.bags.clock import Clock
from factorgraph_loc.io.bags.file import Bag, Stamped
from factorgraph_loc.io.bags.frames import StaticFrames
from factorgraph_loc.io.bags.poses import POSES, Poses
from factorgraph_loc.io.bags.rows import TopicRows
from factorgraph_loc.model.planar import Turned, about_z
from factorgraph_loc.sensors.odometry.stream import IncrementStream, VelocityStream, YawRateStream
from factorgraph_loc.text import quoted
from factors import se2
from factors.se2 import Array, Integers

ODOMETRY = "nav_msgs/msg/Odometry"
TWISTS = {"geometry_msgs/msg/Twist": "", "geometry_msgs/msg/TwistStamped": "twist"}
JOINTS = "sensor_msgs/msg/JointState"
IMU = "sensor_msgs/msg/Imu"


class WheelSettings(FileModel):
    """A differential drive."""

    left: str
    """name of the left wheel's joint"""
    right: str
    """name of the right wheel's joint"""
    radius: Annotated[float, Field(gt=0.0, le=5.0), InUnit("m")]
    """radius of the wheels"""
    track: Annotated[float, Field(gt=0.0, le=20.0), InUnit("m")]
    """distance between the wheels"""


class OdometryTopic(Turned):
    """A topic of odometry or of wheel joints."""

    topic: str
    """name of the topic"""
    use: Literal["pose", "twist"] = "pose"
    """the pose of odometry, as motion between messages, or its twist; for wheels, position or velocity"""
    wheels: WheelSettings | None = None
    """wheels of a topic of joints"""
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
    """Odometry from the angles or angular velocities of two wheels."""

    def __init__(self, bag: Bag, options: OdometryTopic) -> None:
        if options.wheels is None:
            raise InputError(f"{bag.path} {options.topic}: odometry.wheels is missing: left, right, radius and track")
        self._wheels = options.wheels
        self._column = "position" if options.use == "pose" else "velocity"
        self._rows = TopicRows(f"{bag.path} {options.topic}", 2)
        self._seen: set[str] = set()

    def add(self, item: Stamped, t_ns: int) -> None:
        names, values = item.message.name, getattr(item.message, self._column)
        self._seen.update(names)
        if len(values) != len(names):
            if self._wheels.left in names:
                raise InputError(
                    f"{self._rows.source}:{item.row}: has {len(values)} numbers of {self._column} for {len(names)} joints, "
                    "expected one for each; select the other with odometry.use"
                )
            return
        if self._wheels.left in names and self._wheels.right in names:  # other messages contain other joints
            wheels = (values[names.index(self._wheels.left)], values[names.index(self._wheels.right)])
            self._rows.append(item, t_ns, (float(wheels[0]), float(wheels[1])))

    def stream(self, warnings: list[str]) -> tuple[Integers, Motion]:
        if not len(self._rows):
            wrong = next((n for n in (self._wheels.left, self._wheels.right) if n not in self._seen), self._wheels.left)
            raise InputError(
                f"{self._rows.source}: has no message with both wheels, {quoted(wrong)}{nearest(wrong, sorted(self._seen))}"
            )
        t_ns, (left, right) = finite_columns(self._rows, ("left wheel", "right wheel"), warnings)
        radius, track = self._wheels.radius, self._wheels.track
        if self._column == "velocity":
            v, w = radius * (left + right) / 2.0, radius * (right - left) / track
            return t_ns, VelocityStream(checks.seconds(t_ns, int(t_ns[0])), v, w)
        ways, scales = radius * np.column_stack((left, right)), np.full(2, radius)
        left, right = motions.between_ways(self._rows.source, t_ns, ways, scales, warnings).T
        arc, turn = (left + right) / 2.0, (right - left) / track
        return t_ns, increments(t_ns, se2.exp(np.column_stack((arc, np.zeros(len(arc)), turn))))


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


OdometryRows = PoseMotion | TwistMotion | WheelMotion


def odometry(bag: Bag, options: OdometryTopic) -> OdometryRows:
    """The collector for an odometry topic, by message type."""
    kind = bag.topic(options.topic).type
    poses = kind in POSES and not (kind == ODOMETRY and options.use == "twist")
    if options.is_given() and not poses:
        raise InputError(f"{bag.path} {options.topic}: axes and mounting are for odometry that comes as poses")
    if kind == JOINTS:
        return WheelMotion(bag, options)
    if poses:
        return PoseMotion(bag, options)
    if kind in TWISTS or kind == ODOMETRY:
        return TwistMotion(bag, options)
    known = ", ".join(sorted({*POSES, *TWISTS, JOINTS}))
    raise InputError(f"{bag.path}: topic {options.topic} is of type {kind}, expected one of {known}")


def increments(t_ns: Integers, moves: Array) -> IncrementStream:
    """The motions (N - 1, 3) between N timestamps as increments; the first row only defines the start."""
    dx, dy, dtheta = np.vstack((np.zeros((1, 3)), moves)).T
    return IncrementStream(checks.seconds(t_ns, int(t_ns[0])), dx, dy, dtheta)


def finite_columns(rows: TopicRows, names: tuple[str, ...], warnings: list[str]) -> tuple[Integers, list[Array]]:
    """Timestamps and columns of rows in order of time, all finite; InputError names the invalid message."""
    number, t_ns, values = rows.rows, rows.t_ns, rows.values
    for i, name in enumerate(names):
        checks.require_finite(rows.source, number, name, values[:, i])
    keep = checks.in_order(rows.source, number, t_ns, warnings)
    return t_ns[keep], [values[keep, i] for i in range(len(names))]
