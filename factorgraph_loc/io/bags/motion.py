"""Motion of the robot in a bag: poses or velocities of odometry, the gyro of an IMU, or the wheels of a differential drive, each a
topic, or joints of one message.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import checks
from factorgraph_loc.files.models import nearest
from factorgraph_loc.io import motions
from factorgraph_loc.io.bags.fields import TF, Fields, TopicSettings, as_number, getter
from factorgraph_loc.io.bags.file import Bag, Stamped, TopicRows
from factorgraph_loc.io.bags.frames import FrameReference, StaticFrames, poses_of_topic
from factorgraph_loc.io.bags.listeners import Listeners
from factorgraph_loc.io.bags.poses import POSES, Poses, PoseTopic
from factorgraph_loc.model.planar import Turned, about_z
from factorgraph_loc.sensors.odometry.measurement import IncrementStream, VelocityStream, YawRateStream
from factorgraph_loc.text import quoted
from factors.se2 import Array, Integers

JOINTS = "sensor_msgs/msg/JointState"
APART = 0.5  # of the usual time between messages of a wheel: more between left and right are no pair
ODOMETRY = "nav_msgs/msg/Odometry"
TWISTS = {  # path of the twist by type
    "geometry_msgs/msg/Twist": "",
    "geometry_msgs/msg/TwistStamped": "twist",
}
IMU = "sensor_msgs/msg/Imu"
Motion = IncrementStream | VelocityStream


class WheelSettings(motions.WheelSizes):
    """A differential drive. ``radius`` and ``track`` of the rig ([odometry.wheels]) come before those given here."""

    left: str
    """name of the left wheel's joint; for a topic for each wheel, the field with the number"""
    right: str
    """as left, of the right wheel"""
    right_topic: str | None = None
    """topic of the right wheel, if each wheel has a topic"""
    unit: Literal["rad", "m"] = "rad"
    """whether the wheels tell how they turn, or the way that they roll"""


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

    def pairs(self, warnings: list[str]) -> tuple[Integers, Array]:
        """Timestamps (N,), and the left and the right number (N, 2). InputError if no message has both joints."""
        if not len(self.rows):
            wrong = next((n for n in (self._wheels.left, self._wheels.right) if n not in self._seen), self._wheels.left)
            raise InputError(
                f"{self.rows.source}: has no message with both wheels, {quoted(wrong)}{nearest(wrong, sorted(self._seen))}"
            )
        return finite_rows(self.rows, ("left wheel", "right wheel"), warnings)


class OneWheel:
    """Collects a number from each message of a topic."""

    def __init__(self, bag: Bag, topic: str, path: str) -> None:
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

    def __init__(self, left: TopicRows, right: TopicRows) -> None:
        self.rows, self._right = left, right

    def pairs(self, warnings: list[str]) -> tuple[Integers, Array]:
        """Timestamps (N,), and the left and the right number (N, 2). InputError if the topics have no time in common."""
        l_ns, left = finite_rows(self.rows, ("wheel",), warnings)
        r_ns, right = finite_rows(self._right, ("wheel",), warnings)
        after = np.clip(np.searchsorted(r_ns, l_ns), 0, len(r_ns) - 1)
        before = np.maximum(after - 1, 0)
        near = np.where(np.abs(r_ns[before] - l_ns) <= np.abs(r_ns[after] - l_ns), before, after)
        usual = float(np.median(np.diff(l_ns))) if len(l_ns) > 1 else 0.0
        keep = np.flatnonzero(np.abs(r_ns[near] - l_ns) <= APART * usual)
        t_ns = np.maximum(l_ns, r_ns[near])[keep]
        if not len(t_ns):
            raise InputError(f"{self.rows.source} and {self._right.source}: no messages are near in time")
        if lost := len(l_ns) - len(keep):
            warnings.append(f"{self.rows.source}: {lost} messages have none of the right wheel near in time")
        alone = np.append(np.diff(t_ns) > 0, True)  # the last one of equal stamps
        return t_ns[alone], np.hstack((left[keep], right[near[keep]]))[alone]


def finite_rows(rows: TopicRows, names: Sequence[str], warnings: list[str]) -> tuple[Integers, Array]:
    """Timestamps (N,) and numbers (N, K) in order of time, all finite; InputError names the invalid message."""
    checks.require_finite(rows.source, rows.rows, names, rows.values)
    keep = checks.in_order(rows.source, rows.rows, rows.t_ns, warnings)
    return rows.t_ns[keep], rows.values[keep]


def velocities(t_ns: Integers, values: Array) -> VelocityStream:
    """Speeds and turn rates (N, 2) at N timestamps as a stream."""
    return VelocityStream(checks.seconds(t_ns, int(t_ns[0])), *np.ascontiguousarray(values.T))


class OdometryTopic(PoseTopic):
    """A topic of odometry, of tf with two frames, or of wheel joints."""

    use: Literal["pose", "twist"] = "pose"
    """the pose of odometry, as motion between messages, or its twist; for wheels, how far they turned, or how fast"""
    wheels: WheelSettings | None = None
    """wheels of a topic of joints, or of two topics; topic is the one of the left wheel"""


class ImuTopic(TopicSettings, Turned):
    """A topic of an IMU: its turn rate about the robot's z axis."""

    frame: str | None = None
    """frame of the IMU, whose orientation is in tf_static; without it use axes and mounting"""


class PoseMotion:
    """Odometry from poses in its own frame, or from transforms: the motion between consecutive poses."""

    def __init__(self, poses: Poses | FrameReference, turned: Turned) -> None:
        self._poses, self._turned = poses, turned

    def stream(self, warnings: list[str]) -> tuple[Integers, Motion]:
        """Absolute timestamps (N,) and the stream, whose timestamps start at 0."""
        path = self._poses.path(warnings)
        assert path.t_ns is not None
        poses = path.on_floor(warnings, self._turned)
        return path.t_ns, increments(path.t_ns, motions.between_poses(path.name, path.t_ns, poses, warnings))


class TwistMotion:
    """Odometry from velocities, each held until the next."""

    def __init__(self, bag: Bag, options: OdometryTopic) -> None:
        self._twist = getter(TWISTS.get(bag.topic(options.topic).type, "twist.twist"))
        self._rows = TopicRows(f"{bag.path} {options.topic}", 2)

    def add(self, item: Stamped, t_ns: int) -> None:
        twist = self._twist(item.message)
        self._rows.append(item, t_ns, (twist.linear.x, twist.angular.z))

    def stream(self, warnings: list[str]) -> tuple[Integers, Motion]:
        t_ns, values = finite_rows(self._rows, ("v", "w"), warnings)
        return t_ns, velocities(t_ns, values)


class WheelMotion:
    """Odometry from the angles or angular velocities of two wheels, of joints or with a topic each."""

    def __init__(self, listeners: Listeners, options: OdometryTopic, wheels: WheelSettings) -> None:
        bag = listeners.bag
        self._wheels = wheels
        self._are_speeds = options.use == "twist"
        self._rows: JointRows | TwoWheels
        if wheels.right_topic is None:
            rows = JointRows(bag, options.topic, wheels, "velocity" if self._are_speeds else "position")
            self._rows = listeners.listen(options, rows)
        else:
            left = listeners.listen(options, OneWheel(bag, options.topic, wheels.left))
            of_right = options.model_copy(update={"topic": wheels.right_topic})
            right = listeners.listen(of_right, OneWheel(bag, wheels.right_topic, wheels.right))
            self._rows = TwoWheels(left.rows, right.rows)

    def stream(self, warnings: list[str]) -> tuple[Integers, Motion]:
        source = self._rows.rows.source
        size, track = self._wheels.sizes(source, "odometry.wheels", turns=self._wheels.unit == "rad")
        t_ns, numbers = self._rows.pairs(warnings)
        ways = size * numbers
        if self._are_speeds:
            return t_ns, velocities(t_ns, motions.velocities_of_wheels(ways, track))
        moves = motions.between_wheels(source, t_ns, ways, np.full(2, size), track, warnings)
        return t_ns, increments(t_ns, moves)


class YawRates:
    """The turn rate of an IMU."""

    def __init__(self, bag: Bag, options: ImuTopic, frames: StaticFrames) -> None:
        topic = bag.topic(options.topic, IMU)
        if options.frame is not None and options.is_given():
            raise InputError(f"{bag.path} {topic.name}: tf_static has the frame, expected no axes or mounting")
        self._options, self._frames = options, frames
        self._rows = TopicRows(f"{bag.path} {options.topic}", 3)

    def add(self, item: Stamped, t_ns: int) -> None:
        rate = item.message.angular_velocity
        self._rows.append(item, t_ns, (rate.x, rate.y, rate.z))

    def stream(self, t0_ns: int, warnings: list[str]) -> YawRateStream:
        """Turn rates about the robot's z axis; only the axes of the IMU that contribute must be finite."""
        turned = self._options.turned()
        if self._options.frame is not None:
            turned = self._frames.known(self._rows.source, self._options.frame)[:3, :3]
        rows, t_ns = self._rows.rows, self._rows.t_ns
        w = about_z(self._rows.source, rows, self._rows.values, turned)
        keep = checks.in_order(self._rows.source, rows, t_ns, warnings)
        return YawRateStream(checks.seconds(t_ns[keep], t0_ns), w[keep])


def odometry(
    listeners: Listeners, options: OdometryTopic, static: StaticFrames
) -> PoseMotion | TwistMotion | WheelMotion:
    """Register the collectors of an odometry topic, by message type, and return its motion."""
    bag, source = listeners.bag, f"{listeners.bag.path} {options.topic}"
    known = () if options.wheels else sorted({*POSES, *TWISTS, JOINTS, *TF})
    kind = bag.topic(options.topic, *known).type
    if kind not in TF and (options.parent is not None or options.child is not None):
        raise InputError(f"{source}: odometry.parent and odometry.child are for tf, this is {kind}")
    poses = kind in TF or (kind in POSES and not (kind == ODOMETRY and options.use == "twist"))
    if options.is_given() and not poses:
        raise InputError(f"{source}: axes and mounting are for odometry that comes as poses")
    if kind == JOINTS and options.wheels is None:
        raise InputError(f"{source}: odometry.wheels is missing: left, right, radius and track")
    if options.wheels is not None and kind not in TF:
        if kind != JOINTS and options.wheels.right_topic is None:
            raise InputError(f"{source}: odometry.wheels.right_topic is missing, as {kind} has no joints")
        return WheelMotion(listeners, options, options.wheels)
    if poses:
        return PoseMotion(poses_of_topic(listeners, options, static), options)
    return listeners.listen(options, TwistMotion(bag, options))


def increments(t_ns: Integers, moves: Array) -> IncrementStream:
    """The motions (N - 1, 3) between N timestamps as increments; the first row only defines the start."""
    return IncrementStream(checks.seconds(t_ns, int(t_ns[0])), *motions.after_rest(moves).T)
