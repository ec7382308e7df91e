"""The wheels of a differential drive in a bag: joints of a message, or a topic for each wheel."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import checks
from factorgraph_loc.files.models import FileModel, InUnit, nearest
from factorgraph_loc.io import motions
from factorgraph_loc.io.bags.fields import Fields, as_number
from factorgraph_loc.io.bags.file import Bag, Stamped
from factorgraph_loc.io.bags.rows import TopicRows
from factorgraph_loc.text import quoted
from factors.se2 import Array, Integers

JOINTS = "sensor_msgs/msg/JointState"
APART = 0.5  # of the usual time between messages of a wheel: more between left and right are no pair


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
