"""The frames that a bag tells of by its transforms, and those of the robot, its odometry and the world by their usual names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Any

from factorgraph_loc.errors import InputError
from factorgraph_loc.io.bags.clock import TF
from factorgraph_loc.io.bags.file import Bag
from factorgraph_loc.io.bags.frames import STATIC, plain
from factorgraph_loc.text import told

MANY = 2000  # messages of a topic that are looked at
ROBOT = ("base_link", "base_footprint", "base")
ODOMETRY = ("odom", "odom_combined", "odometry")
WORLD = ("mocap", "vicon", "optitrack", "world", "map")  # what is measured comes before what may be an estimate


@dataclass(frozen=True)
class Tree:
    """``parents``: the parent of each frame; ``topic``: that of the moving frames, "" if none moves; ``moving``: these frames."""

    parents: Mapping[str, str]
    topic: str
    moving: frozenset[str]

    def robot(self) -> str | None:
        """The frame of the robot, by its usual names."""
        return next((name for name in ROBOT if name in self.parents), None)

    def above(self, frame: str, names: tuple[str, ...]) -> str | None:
        """The first of ``names`` that is above ``frame``, which moves in it."""
        moves = False
        known: set[str] = set()
        seen = {frame}
        while frame in self.parents and self.parents[frame] not in seen:
            moves |= frame in self.moving
            frame = self.parents[frame]
            seen.add(frame)
            if moves:
                known.add(frame)
        return next((name for name in names if name in known), None)


def tree_of(bag: Bag, notes: list[str]) -> Tree:
    """The frames in the transforms of a bag. A topic that cannot be read is told of in ``notes``."""
    parents: dict[str, str] = {}
    moving: set[str] = set()
    topic = ""
    for one in bag.topics.values():
        if one.type not in TF or not one.count:
            continue
        found: dict[str, str] = {}
        try:
            found.update(_edges(bag, one.name))
        except InputError as error:
            notes.append(str(error))
        except (AttributeError, TypeError, ValueError) as error:
            notes.append(f"{bag.path}: topic {one.name} is defined in the bag unlike in ROS: {told(error)}")
        parents |= found
        if one.name != STATIC:
            moving |= found.keys()
            topic = topic or one.name
    return Tree(parents, topic, frozenset(moving))


def _edges(bag: Bag, topic: str) -> Iterator[tuple[str, str]]:
    for item in islice(bag.messages([topic]), MANY):
        transforms: Any = item.message.transforms
        for transform in transforms:
            yield plain(transform.child_frame_id), plain(transform.header.frame_id)
