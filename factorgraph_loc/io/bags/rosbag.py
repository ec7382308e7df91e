"""The reader of ROS bags by a mapping of topics, which ``fgloc manifest BAG`` proposes.

The bag is read once; only the needed numbers of its messages are kept, and images are written to files.
"""

from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, TypeVar

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import FileModel, add_fields
from factorgraph_loc.io.bags import clock as bag_clock
from factorgraph_loc.io.bags import rig as bag_rig
from factorgraph_loc.io.bags.camera import CameraTopic, Images, Info
from factorgraph_loc.io.bags.clock import TF, Clock, Stamper
from factorgraph_loc.io.bags.file import Bag, Stamped, open_bag
from factorgraph_loc.io.bags.frames import STATIC, FrameReference, StaticFrames
from factorgraph_loc.io.bags.landmarks import Landmarks, LandmarkTopic, PixelsOfPoints, PixelTopic
from factorgraph_loc.io.bags.messages import tables_of_messages
from factorgraph_loc.io.bags.motion import ImuTopic, OdometryTopic, WheelMotion, YawRates, odometry
from factorgraph_loc.io.bags.poses import Poses, ReferenceTopic, Start, StartTopic
from factorgraph_loc.io.bags.rfid import Reads, RfidTopic
from factorgraph_loc.io.bags.tables import DescribedRows, TableTopic
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.measurement import Stream
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.rfid.stream import RfidStream
from factorgraph_loc.text import told


class Options(FileModel):
    """The topic of each sensor."""

    odometry: OdometryTopic
    imu: ImuTopic | None = None
    rfid: RfidTopic | None = None
    bearing_range: LandmarkTopic | None = None
    camera: CameraTopic | None = None
    sightings: PixelTopic | None = None
    reference: ReferenceTopic | None = None
    start: StartTopic | None = None
    clock: Clock = "header"
    """timestamps of message headers or of receipt; a topic may override it"""
    base_frame: str = "base_link"
    """frame of the robot, for mountings in tf_static"""


OTHERS = [table for table in tables_of_messages().values() if table.name not in Options.model_fields]
add_fields(Options, {table.name: (TableTopic | None, None) for table in OTHERS}, after="sightings")


class Gatherer(Protocol):
    """Collects the needed data from the messages of one topic; messages are not kept, so they are validated here."""

    def add(self, item: Stamped, t_ns: int) -> None: ...


class TimedTopic(Protocol):
    """The common options of all topics."""

    @property
    def topic(self) -> str: ...
    @property
    def clock(self) -> Clock | None: ...


G = TypeVar("G", bound=Gatherer)


class Listeners:
    """The collectors of each topic, with their clocks."""

    def __init__(self, bag: Bag, clock: Clock) -> None:
        self.bag, self.clock = bag, clock
        self.stampers: list[Stamper] = []
        self._of: dict[str, list[tuple[Stamper, Gatherer]]] = {}

    def stamper(self, topic: str, clock: Clock | None) -> Stamper:
        """The timestamps of a topic, by its own clock or that of the bag."""
        return Stamper(self.bag, self.bag.topic(topic), clock or self.clock)

    def add(self, topic: str, gatherer: Gatherer, stamper: Stamper, *, timed: bool = True) -> None:
        """Register a collector. ``timed``: whether timestamps of the topic are meaningful."""
        self._of.setdefault(topic, []).append((stamper, gatherer))
        if timed:
            self.stampers.append(stamper)

    def listen(self, options: TimedTopic, gatherer: G) -> G:
        """Register a collector for a topic and return it."""
        self.add(options.topic, gatherer, self.stamper(options.topic, options.clock))
        return gatherer

    def run(self) -> None:
        """Read the bag."""
        for item in self.bag.messages(list(self._of)):
            for stamper, gatherer in self._of[item.topic]:
                try:
                    gatherer.add(item, stamper.stamp(item))
                except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
                    kind = self.bag.topics[item.topic].type
                    where = f"{self.bag.path} {item.topic}:{item.row}"
                    raise InputError(f"{where}: {kind} is defined in the bag unlike in ROS: {told(error)}") from error
        for stamper in self.stampers:
            stamper.check()


@dataclass
class Gathered:
    """The collectors of all sensors in the manifest."""

    imu: YawRates | None = None
    rfid: Reads | None = None
    bearing_range: Landmarks | None = None
    camera: Images | None = None
    info: Info | None = None
    sightings: PixelsOfPoints | None = None
    reference: Poses | FrameReference | None = None
    start: Start | None = None
    others: dict[str, DescribedRows] = field(default_factory=dict)


def read(path: Path | None, options: Options) -> Log:
    """The log in a bag; t = 0 at the first odometry. InputError names bag, topic, message and field of an invalid value."""
    if path is None:
        raise InputError("rosbag: the path of the bag is missing")
    with open_bag(path) as bag, ExitStack() as stack:
        return _read(bag, options, stack)


def _read(bag: Bag, options: Options, stack: ExitStack) -> Log:
    listeners = Listeners(bag, options.clock)
    frames = static_frames(listeners)
    stamper = listeners.stamper(options.odometry.topic, options.odometry.clock)
    motion = odometry(bag, options.odometry, stamper, frames)
    listeners.add(options.odometry.topic, motion, stamper)
    if isinstance(motion, WheelMotion) and motion.right is not None:
        listeners.add(motion.right.topic, motion.right, listeners.stamper(motion.right.topic, options.odometry.clock))
    gathered = _listen(listeners, options)
    if gathered.camera:
        stack.callback(gathered.camera.discard)
    listeners.run()

    clock, warnings = bag_clock.report(listeners.stampers, options.clock)
    t_ns, moved = motion.stream(warnings)
    t0_ns = int(t_ns[0])
    streams: dict[str, Stream] = {"odometry": moved}
    if gathered.imu:
        streams["imu"] = gathered.imu.stream(frames, options.base_frame, t0_ns, warnings)
    if gathered.rfid:
        streams["rfid"] = gathered.rfid.rounds(warnings).stream(t0_ns)
    if gathered.bearing_range:
        streams["bearing_range"] = gathered.bearing_range.stream(frames, options.base_frame, t0_ns, warnings)
    if gathered.camera:
        streams["camera"] = gathered.camera.stream(t0_ns, warnings)
    if gathered.sightings:
        streams["sightings"] = gathered.sightings.stream(t0_ns, warnings)
    streams |= {name: rows.stream(t0_ns, warnings) for name, rows in gathered.others.items()}
    notes: list[str] = []  # on the bag's own rig, which one in the manifest replaces
    rig = _rig(streams, gathered, options, frames, notes)
    name = bag.path.resolve().stem
    return Log(
        name=name,
        rig=rig,
        world=World(name=name),
        streams=streams,
        reference=_reference(gathered, options, frames, t0_ns, warnings),
        start=gathered.start.pose(t0_ns, warnings) if gathered.start else None,
        t0_ns=t0_ns,
        warnings=tuple(warnings),
        metadata={"clock": clock} | ({"robot": "; ".join(notes)} if notes else {}),
    )


def static_frames(listeners: Listeners) -> StaticFrames:
    """Register a collector for the static transforms of the bag, if it has any, and return it."""
    bag, frames = listeners.bag, StaticFrames()
    if STATIC in bag.topics and bag.topics[STATIC].type in TF and bag.topics[STATIC].count:
        listeners.add(STATIC, frames, listeners.stamper(STATIC, None), timed=False)
    return frames


def _listen(listeners: Listeners, options: Options) -> Gathered:
    """Register collectors for the manifest's topics except odometry."""
    bag, out = listeners.bag, Gathered()
    if options.imu:
        out.imu = listeners.listen(options.imu, YawRates(bag, options.imu))
    if options.rfid:
        out.rfid = listeners.listen(options.rfid, Reads(bag, options.rfid))
    if options.bearing_range:
        out.bearing_range = listeners.listen(options.bearing_range, Landmarks(bag, options.bearing_range))
    if options.sightings:
        out.sightings = listeners.listen(options.sightings, PixelsOfPoints(bag, options.sightings))
    for table in OTHERS:
        if (told := getattr(options, table.name)) is not None:
            out.others[table.name] = listeners.listen(told, DescribedRows(bag, told, table))
    if options.camera:
        out.camera, out.info = _listen_to_camera(listeners, options.camera)
    if options.reference:
        topic = options.reference
        stamper = listeners.stamper(topic.topic, topic.clock)
        if bag.topic(topic.topic).type not in TF:
            out.reference = Poses(bag, topic.topic, topic)
        else:
            out.reference = FrameReference(bag, topic, stamper)
        listeners.add(topic.topic, out.reference, stamper)
    if options.start:
        out.start = listeners.listen(options.start, Start(bag, options.start.topic, options.start))
    return out


def _listen_to_camera(listeners: Listeners, options: CameraTopic) -> tuple[Images, Info | None]:
    bag, stamper = listeners.bag, listeners.stamper(options.topic, options.clock)
    images = Images(bag, options.topic, stamper)
    if images.known:
        listeners.stampers.append(stamper)
    else:
        listeners.add(options.topic, images, stamper)
    info = None
    if options.info:
        info = Info(bag, options.info)
        listeners.add(options.info, info, listeners.stamper(options.info, None), timed=False)
    return images, info


def _reference(
    gathered: Gathered, options: Options, frames: StaticFrames, t0_ns: int, warnings: list[str]
) -> Trajectory | None:
    if options.reference is None:
        return None
    if isinstance(gathered.reference, FrameReference):
        return gathered.reference.trajectory(frames, t0_ns, options.reference, warnings)
    if gathered.reference is None:
        return None
    return gathered.reference.trajectory(t0_ns, options.reference.has_heading, warnings)


def _rig(
    streams: dict[str, Stream], gathered: Gathered, options: Options, frames: StaticFrames, notes: list[str]
) -> Rig:
    """The rig from the bag; a rig in the manifest replaces it."""
    base = options.base_frame
    camera = bag_rig.camera_of(gathered.info, frames, base, notes) if gathered.info else None
    reads = streams.get("rfid")
    rfid = None
    if options.rfid and isinstance(reads, RfidStream) and reads.antenna:
        rfid = bag_rig.antennas_of(set(reads.antenna), options.rfid.frames, frames, base, notes)
    usable = [name for name in streams if name not in {"camera", "sightings"} or camera is not None]
    return bag_rig.rig_of(usable, camera, rfid)
