"""A trajectory in a bag: the poses of a topic, or of a frame in another one."""

from dataclasses import replace
from pathlib import Path

from factorgraph_loc.errors import InputError
from factorgraph_loc.io.bags.clock import TF
from factorgraph_loc.io.bags.file import open_bag
from factorgraph_loc.io.bags.frames import FrameReference
from factorgraph_loc.io.bags.poses import POINT, POSES, Poses, ReferenceTopic
from factorgraph_loc.io.bags.rosbag import Listeners, static_frames
from factorgraph_loc.model.trajectory3 import PosePath
from factorgraph_loc.text import listed

FRAMES, WITHIN = ":", "."  # /tf:PARENT.CHILD


def read_trajectory(path: Path, topic: str) -> PosePath:
    """The poses of ``topic`` in the bag ``path``, at the stamps of headers where there are any: messages with poses or points, or
    ``/tf:PARENT.CHILD``, the frame CHILD in the frame PARENT. InputError names the invalid message."""
    name, _, frames = topic.partition(FRAMES)
    with open_bag(path) as bag:
        if not name:
            known = [one.name for one in bag.topics.values() if one.type in (*POSES, POINT, *TF)]
            told = listed(known) or "none has poses"
            raise InputError(f"{path}: is a bag, expected {path}:TOPIC, with one of its topics: {told}")
        listeners, warnings = Listeners(bag, "header"), list[str]()
        stamper = listeners.stamper(name, None)
        if bag.topic(name).type not in TF:
            poses = Poses(bag, name)
            listeners.add(name, poses, stamper)
            listeners.run()
            return replace(poses.in_space(warnings), warnings=tuple(warnings))
        parent, _, child = frames.partition(WITHIN)
        if not parent or not child:
            raise InputError(f"{path}: {name} holds transforms, expected two frames too: {path}:{name}:map.base_link")
        static = static_frames(listeners)
        moving = FrameReference(bag, ReferenceTopic(topic=name, parent=parent, child=child), stamper)
        listeners.add(name, moving, stamper)
        listeners.run()
        return replace(moving.path(static, warnings), warnings=tuple(warnings))
