"""ROS bags by a mapping of topics: ``fgloc manifest BAG`` proposes one.

The bag is read once, as a stream; of its messages only the numbers that a log needs are kept.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import FileModel
from factorgraph_loc.log import Log, Stream
from factorgraph_loc.readers import bag_clock
from factorgraph_loc.readers.bag_clock import Clock, Stamper
from factorgraph_loc.readers.bag_file import Bag, Stamped, open_bag
from factorgraph_loc.readers.bag_motion import ImuTopic, OdometryTopic, YawRates, odometry
from factorgraph_loc.readers.bag_poses import Poses, ReferenceTopic
from factorgraph_loc.readers.bag_rfid import Reads, RfidTopic
from factorgraph_loc.readers.registry import DEFAULT_RIG
from factorgraph_loc.world import World


class Options(FileModel):
    """Which topic is which sensor. ``clock``: which stamps count, those of the messages' headers or those of their receipt; a topic
    may have its own."""

    odometry: OdometryTopic
    imu: ImuTopic | None = None
    rfid: RfidTopic | None = None
    reference: ReferenceTopic | None = None
    clock: Clock = "header"


class Gatherer(Protocol):
    """Takes the messages of one topic."""

    def add(self, item: Stamped, t_ns: int) -> None: ...


@dataclass(frozen=True)
class _Ear:
    """Who listens to a topic, and by which clock."""

    stamper: Stamper
    gatherer: Gatherer


def read(path: Path | None, options: Options) -> Log:
    """The log in a bag; t = 0 at the first odometry. InputError names bag, topic, message and field of what is wrong."""
    if path is None:
        raise InputError("rosbag: the path of the bag is missing")
    with open_bag(path) as bag:
        return _read(bag, options)


def _read(bag: Bag, options: Options) -> Log:
    ears: dict[str, list[_Ear]] = {}

    def listen(gatherer: Gatherer, topic: str, clock: Clock | None) -> None:
        stamper = Stamper(bag, bag.topic(topic), clock or options.clock)
        ears.setdefault(topic, []).append(_Ear(stamper, gatherer))

    motion = odometry(bag, options.odometry)
    listen(motion, options.odometry.topic, options.odometry.clock)
    imu = YawRates(bag, options.imu) if options.imu else None
    if options.imu and imu:
        listen(imu, options.imu.topic, options.imu.clock)
    reads = Reads(bag, options.rfid) if options.rfid else None
    if options.rfid and reads:
        listen(reads, options.rfid.topic, options.rfid.clock)
    reference = Poses(bag, options.reference.topic) if options.reference else None
    if options.reference and reference:
        listen(reference, options.reference.topic, options.reference.clock)

    for item in bag.messages(list(ears)):
        for ear in ears[item.topic]:
            ear.gatherer.add(item, ear.stamper.stamp(item))

    stampers = [ear.stamper for heard in ears.values() for ear in heard]
    for stamper in stampers:
        stamper.check()
    clock, warnings = bag_clock.report(stampers, options.clock)
    t_ns, moved = motion.stream(warnings)
    t0_ns = int(t_ns[0])
    streams: dict[str, Stream] = {"odometry": moved}
    if imu:
        streams["imu"] = imu.stream(t0_ns, warnings)
    if reads:
        streams["rfid"] = reads.rounds(warnings).stream(t0_ns)
    log = Log(
        name=bag.path.resolve().stem,
        rig=DEFAULT_RIG,
        world=World(name=bag.path.resolve().stem),
        streams=streams,
        t0_ns=t0_ns,
        warnings=tuple(warnings),
        metadata={"clock": clock},
    )
    if options.reference and reference:
        trajectory = reference.trajectory(t0_ns, options.reference.has_heading, warnings)
        log = replace(log, reference=trajectory, warnings=tuple(warnings))
    return log
