"""Proposes a manifest (the description of a log) for a ROS bag. The manifest assigns topics to sensors.

Topics are recognised by their message types and by common names.
"""

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from operator import attrgetter
from pathlib import Path
from typing import Any

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.several import by_name
from factorgraph_loc.io.bags.camera import COMPRESSED, INFO, RAW
from factorgraph_loc.io.bags.file import Bag, Topic, open_bag
from factorgraph_loc.io.bags.motion import IMU, JOINTS, ODOMETRY, TWISTS
from factorgraph_loc.io.bags.poses import ODOMETRY as ORIGINS
from factorgraph_loc.io.bags.poses import POINT, POSES, ROBOT, SAMPLE, STATIC, WORLD, Tree, tree_of
from factorgraph_loc.io.bags.tables import CORNERS, DETECTIONS
from factorgraph_loc.io.bags.topics import LIST, TF, has_header, leaves
from factorgraph_loc.io.guesses import ANGLES, ENDS, LANDMARK, RANGE, READ, TRUTH, plain, rank
from factorgraph_loc.io.proposals import Proposal, distinct, proposal_of
from factorgraph_loc.sensors.positions.measurement import POSITIONS_ON_EARTH
from factorgraph_loc.text import listed

LEFT, RIGHT = re.compile("left", re.IGNORECASE), re.compile("right", re.IGNORECASE)
WHEEL, REAR = re.compile("wheel", re.IGNORECASE), re.compile("rear|back", re.IGNORECASE)
WHEELS = {"radius": 0.1, "track": 0.5}  # m: examples that the user replaces
NOT_MEASURED = re.compile(r"goal|cmd|command|target|plan|initialpose", re.IGNORECASE)

INITIAL_POSE = ("/initialpose", "geometry_msgs/msg/PoseWithCovarianceStamped")

# units of the fields of an RFID read that are assumed if the names of the message fields imply none
IF_UNSTATED = {"phase": "rad", "frequency": "Hz", "stamp": "us"}
# for each field of an RFID read: the unit that a suffix of the name implies; the longest suffix is used
UNITS = {"phase": ANGLES, "frequency": ENDS["frequency"], "stamp": {unit: unit for unit in ("us", "ms", "ns")}}


@dataclass(frozen=True)
class TopicUse:
    """A topic of a bag and its proposed use.

    ``messages``: number of messages.
    ``rate``: messages per second, None if there are fewer than two.
    ``use``: the sensor that measured the messages, or "reference" for ground truth. None for an unused topic.
    """

    topic: str
    type: str
    messages: int
    rate: float | None
    use: str | None


@dataclass(frozen=True)
class BagManifest(Proposal):
    """A proposed manifest, which describes how to read the log in a bag. ``duration``: length of the bag [s].
    ``topics``: all topics of the bag."""

    duration: float
    topics: tuple[TopicUse, ...]


@dataclass
class Uses:
    """The proposed uses of the topics of a bag.

    ``options``: proposed options for reading the bag, such as the topic of each sensor. ``uses``: the name of the
    sensor, or "reference", by topic. ``remarks``: hints for the user.
    """

    options: dict[str, Any] = field(default_factory=dict)
    uses: dict[str, str] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)

    def take(self, sensor: str, topics: Sequence[Topic], **settings: Any) -> None:
        """Propose the first of ``topics`` for a sensor, such as "imu". ``settings``: further options of this sensor.

        If there are more topics, a remark lists them as alternatives. Does nothing if ``topics`` is empty.
        """
        if topics:
            self.options[sensor] = {"topic": topics[0].name, **settings}
            self.uses[topics[0].name] = sensor
        if topics[1:]:
            self.remarks.append(f"{sensor} could also be {', '.join(topic.name for topic in topics[1:])}")

    def take_all(self, sensor: str, topics: Mapping[str, Mapping[str, Any]]) -> None:
        """Propose each topic as a sensor of its own, of the kind ``sensor``, such as "bearing_range".

        ``topics``: the proposed options of each sensor, by the name of its topic."""
        names = distinct(list(topics)) if len(topics) > 1 else []
        settings = {topic: {"topic": topic, **more} for topic, more in topics.items()}
        if names:
            self.options[sensor] = dict(zip(names, settings.values(), strict=True))
        elif topics:
            (self.options[sensor],) = settings.values()
        self.uses |= dict(zip(topics, [f"{sensor}.{name}" for name in names] or [sensor], strict=False))


def manifest_of_bag(bag: Path, folder: Path) -> BagManifest:
    """Return a proposed manifest of a bag. A manifest is a TOML file that describes how to read a log.

    Nothing is written. Paths in the manifest are relative to ``folder`` if the bag is below ``folder``, else to the
    folder that contains the bag. Raises InputError if the bag cannot be read.
    """
    path, folder = Path(os.path.realpath(bag)), folder.resolve()
    with open_bag(path) as opened:
        uses = propose(opened)
        span = opened.duration
        topics = tuple(
            TopicUse(
                topic.name,
                topic.type,
                topic.count,
                (topic.count - 1) / span if span > 0.0 and topic.count > 1 else None,
                uses.uses.get(topic.name),
            )
            for topic in opened.topics.values()
        )
    unused = [f"not used: {t.topic} ({t.type}, {t.messages} messages)" for t in topics if t.use is None]
    proposal = proposal_of("rosbag", path, folder, uses.options, [*uses.remarks, *unused])
    return BagManifest(**vars(proposal), duration=span, topics=topics)


def propose(bag: Bag) -> Uses:
    """Return a proposed use of each topic of a bag, such as "odometry".

    If several topics fit one sensor, the likeliest topic is used, and a remark lists the rest."""
    out = Uses()
    topics = [topic for topic in bag.topics.values() if topic.count]
    tree = tree_of(bag, out.remarks)
    _motion(out, bag, topics, tree)
    _reference(out, bag, topics, tree)
    out.take("imu", [topic for topic in topics if topic.type == IMU])
    _camera(out, topics)
    detections: dict[str, dict[str, Any]] = {topic.name: {} for topic in topics if topic.type in DETECTIONS}
    out.take_all("bearing_range", detections)
    out.take("sightings", [topic for topic in topics if topic.type == CORNERS])
    out.take("start", [topic for topic in topics if (topic.name, topic.type) == INITIAL_POSE])
    custom = _custom(out, bag, topics)
    _rfid(out, custom)
    out.take_all("bearing_range", detections | _ranges(out, custom))
    if len(out.options.get("bearing_range", {}).values()) > 1 and "topic" not in out.options["bearing_range"]:
        names = listed(by_name("bearing_range", out.options["bearing_range"]))
        out.remarks.append(
            f"{names} are separate sensors: remove any that repeats another; the rig needs a section for each name"
        )
    if STATIC in bag.topics:
        out.uses[STATIC] = "sensor mounting"
    options = [each for option in out.options.values() for each in ([option] if "topic" in option else option.values())]
    used = [bag.topics[option["topic"]] for option in options]
    if not any(topic.type in TF or has_header(bag, topic) for topic in used):
        out.options["clock"] = "receive"
    if (robot := tree.robot()) not in (None, ROBOT[0]):
        out.options["base_frame"] = robot
    if tree.topic and tree.topic not in out.uses:
        frames = listed(f"{child} in {tree.parents[child]}" for child in sorted(tree.moving))
        out.remarks.append(
            f"{tree.topic} has the frames {frames}: to use one as the reference, set parent and child in [options.reference]"
        )
    return out


def _motion(out: Uses, bag: Bag, topics: Sequence[Topic], tree: Tree) -> None:
    """Add the proposed topic of odometry to ``out``, or a remark if none of ``topics`` measures odometry.

    Messages of type Odometry are preferred, then tf with an odometry frame, Twist, and JointState. ``tree``: the
    coordinate frames of the bag."""
    robot = tree.robot()
    origin = None if robot is None else tree.above(robot, ORIGINS)
    frames = {} if origin is None else {"parent": origin, "child": robot}
    ranked = [
        topic
        for kinds in ({ODOMETRY}, set(TF) if frames else set(), set(TWISTS), {JOINTS})
        for topic in topics
        if topic.type in kinds
        and (topic.type not in TF or topic.name == tree.topic)
        and not TRUTH.search(topic.name)
        and not NOT_MEASURED.search(topic.name)
    ]
    if not ranked:
        out.remarks.append(
            "no topic was recognised as odometry, which every estimator needs: name one in [options.odometry]"
        )
        return
    settings: dict[str, Any] = frames if ranked[0].type in TF else {}
    if ranked[0].type == ODOMETRY and _has_no_pose(bag, ranked[0]):
        settings = {"use": "twist"}
        out.remarks.append(f"the quaternions in {ranked[0].name} are zero: its velocities are used, not its poses")
    elif ranked[0].type == JOINTS:
        settings = _joints(bag, ranked[0], out.remarks)
    out.take("odometry", ranked, **settings)


def _has_no_pose(bag: Bag, topic: Topic) -> bool:
    """True if the quaternion in the first odometry message is zero. Drivers that measure only velocities send such messages."""
    first = next(bag.messages([topic.name]), None)
    if first is None:
        return False
    turned = first.message.pose.pose.orientation
    return not any((turned.x, turned.y, turned.z, turned.w))


def _joints(bag: Bag, topic: Topic, remarks: list[str]) -> dict[str, Any]:
    """Return the proposed settings of wheels for a JointState topic. Wheels are recognised by the names of joints in
    its first message. Questions for the user are appended to ``remarks``."""
    first = next(bag.messages([topic.name]), None)
    names = [name for name in getattr(first and first.message, "name", ()) if isinstance(name, str)]
    wheels = [name for name in names if WHEEL.search(name)] or names
    rear = [name for name in wheels if REAR.search(name)]
    front = [name for name in wheels if name not in rear] or wheels
    left = next((name for name in front if LEFT.search(name)), "left_wheel_joint")
    right = next((name for name in front if RIGHT.search(name)), "right_wheel_joint")
    sides = {"left": left, "right": right}
    if len(rear) == len(front) == 2:
        sides |= {"rear_left": next(filter(LEFT.search, rear), ""), "rear_right": next(filter(RIGHT.search, rear), "")}
        remarks.append(
            "there are four wheels: if they are mecanum wheels, set wheels.base [m], the distance between the axles"
        )
    values = getattr(first and first.message, "position", ())
    if len(values) and all(float(value).is_integer() for value in values) and any(values):
        remarks.append(
            "positions of joints are whole numbers: if they are encoder counts, set wheels.unit to the radians per count"
        )
    remarks.append(
        f"wheels: of the joints {listed(names)}, {left} and {right} are used; measure the wheels and set their radius and "
        "track [m] here, or in [odometry.wheels] of the rig, which has precedence"
    )
    return {"wheels": sides | WHEELS}


def _reference(out: Uses, bag: Bag, topics: Sequence[Topic], tree: Tree) -> None:
    """Add the topics of the reference and of a position sensor to ``out``. ``tree``: the coordinate frames of the bag.

    A topic whose name suggests ground truth is the reference. Otherwise, a topic of poses with headings is the
    reference. A topic of positions without headings is a position sensor."""
    poses = [topic for topic in topics if topic.type in {*POSES, POINT} and topic.name not in out.uses]
    named = [topic for topic in poses if TRUTH.search(topic.name)]
    measured = [t for t in poses if t.type != ODOMETRY and not NOT_MEASURED.search(t.name) and t not in named]
    positions = [t for t in measured if t.type == POINT or _never_turns(bag, t)]
    fixes = [topic for topic in topics if topic.type in POSITIONS_ON_EARTH.messages]
    out.take("position", [*positions, *fixes])
    if positions or fixes:
        name = out.options["position"]["topic"]
        out.remarks.append(f"{name} has positions without headings: give the rig the section [position]")
    if named:
        out.take("reference", named)
        return
    plain = [topic for topic in measured if topic not in positions]
    if plain:
        out.take("reference", plain[:1])
        out.remarks.append(
            f"{plain[0].name} is used as the reference: remove [options.reference] if it is an estimate, not the truth"
        )
    robot = tree.robot()
    world = None if robot is None else tree.above(robot, WORLD)
    if not plain and world is not None:
        settings = {"topic": tree.topic, "parent": world, "child": robot}
        out.options["reference"] = settings
        out.uses[tree.topic] = ", ".join(dict.fromkeys((*filter(None, [out.uses.get(tree.topic)]), "reference")))
        out.remarks.append(
            f"the pose of {robot} in {world}, from {tree.topic}, is used as the reference: remove [options.reference] if it is an "
            "estimate, such as that of amcl or SLAM, not the truth"
        )


def _never_turns(bag: Bag, topic: Topic) -> bool:
    """True if the first :data:`SAMPLE` messages of a topic of poses have the same orientation.

    False if the topic has fewer than three messages."""
    get = attrgetter(f"{POSES[topic.type]}.{'rotation' if topic.type.endswith('TransformStamped') else 'orientation'}")
    turned = [get(item.message) for item in islice(bag.messages([topic.name]), SAMPLE)]
    return len(turned) > 2 and len({(q.x, q.y, q.z, q.w) for q in turned}) == 1


def _camera(out: Uses, topics: Sequence[Topic]) -> None:
    candidates = [topic for topic in topics if topic.type in {COMPRESSED, RAW}]
    images = [topic for topic in candidates if "depth" not in topic.name.lower()]
    if not images:
        return
    infos = {topic.name.rsplit("/", 1)[0]: topic for topic in topics if topic.type == INFO}
    place = images[0].name
    while place and place not in infos:  # the CameraInfo of /camera/image_raw/compressed is /camera/camera_info
        place = place.rpartition("/")[0]
    settings = {"info": infos[place].name} if place in infos else {}
    out.take("camera", images, **settings)
    if settings:
        out.uses[settings["info"]] = "camera: lens"
    else:
        out.remarks.append("the images have no CameraInfo topic: describe the camera in the rig")


def _custom(out: Uses, bag: Bag, topics: Sequence[Topic]) -> list[tuple[Topic, list[str]]]:
    """Return (topic, paths of its message fields) for the topics whose message types do not come with ROS.

    Topics that ``out`` already uses are left out. A topic that cannot be read adds a remark to ``out``."""
    custom = []
    for topic in topics:
        if topic.name in out.uses or topic.type.startswith(
            ("sensor_msgs/", "nav_msgs/", "geometry_msgs/", "tf2_msgs/")
        ):
            continue
        try:
            custom.append((topic, leaves(bag.store(topic.name), topic.type)))
        except InputError as error:  # only a remark, because the log may not need this topic
            out.remarks.append(str(error))
    return custom


def _rfid(out: Uses, custom: Sequence[tuple[Topic, Sequence[str]]]) -> None:
    """Add the topic of RFID reads to ``out``. It has a field for the EPC and the most other fields of a read.

    ``custom``: unused topics with message types that do not come with ROS, and the paths of their fields."""
    reads = [(topic, read_fields(paths)) for topic, paths in custom if not range_fields(paths)]
    candidates = [(topic, fields) for topic, fields in reads if "epc" in fields]
    if not candidates:
        return
    topic, fields = max(candidates, key=lambda entry: len(entry[1]))
    settings: dict[str, Any] = {"fields": fields}
    if "antenna" not in fields:
        settings["antenna"] = "antenna"
        out.remarks.append(
            f"{topic.name} does not distinguish antennas: antenna in [options.rfid] is the antenna name of all reads"
        )
    if units := _units(fields):
        settings["units"] = units
    if LIST in fields["epc"] and LIST not in fields.get("antenna", LIST):
        settings["rounds"] = "message"
        out.remarks.append(
            "rfid: each message is treated as one inventory round of its antenna, an empty one as a round without reads"
        )
    out.take("rfid", [topic, *(candidate for candidate, _ in candidates if candidate is not topic)], **settings)
    doubtful = [name for name in UNITS if name in fields and name not in units]
    if doubtful:
        assumed = ", ".join(f"{name} in {IF_UNSTATED[name]}" for name in doubtful)
        out.remarks.append(f"rfid: assumed {assumed}: correct this with units in [options.rfid]")


def _ranges(out: Uses, custom: Sequence[tuple[Topic, Sequence[str]]]) -> dict[str, dict[str, Any]]:
    """Return the proposed settings of each topic with ranges to landmarks, by the name of the topic.

    Such a topic has fields for a distance and for the name of a landmark, in the same part of the message. ``custom``:
    unused topics with message types that do not come with ROS, and the paths of their fields."""
    candidates = {t.name: fields for t, paths in custom if t.name not in out.uses and (fields := range_fields(paths))}
    out.remarks += [
        f"{topic} is read as ranges [m] to landmarks of the map; {fields['landmark']} has the name of the landmark"
        for topic, fields in candidates.items()
    ]
    return {topic: {"fields": fields} for topic, fields in candidates.items()}


def range_fields(paths: Sequence[str]) -> dict[str, str]:
    """Return the paths of two message fields, with the keys "landmark" (name of a landmark) and "range" (its distance).

    ``paths``: the paths of all fields of the message type. The two fields are recognised by common names. Returns an
    empty dictionary if one of the two is missing.
    """
    distances = {p.rpartition(".")[0]: p for p in paths if _plain(p) in RANGE and p.count(LIST) <= 1}
    named = [p for p in paths if _plain(p) in LANDMARK and p.rpartition(".")[0] in distances]
    if not named:
        return {}
    landmark = min(named, key=lambda p: LANDMARK.index(_plain(p)))
    return {"landmark": landmark, "range": distances[landmark.rpartition(".")[0]]}


def read_fields(paths: Sequence[str]) -> dict[str, str]:
    """Return the paths of the message fields of an RFID read, by keys such as "epc", "antenna" and "rssi".

    ``paths``: the paths of all fields of the message type. Fields are recognised by common names.
    """
    usable = [path for path in paths if path.count(LIST) <= 1 and not path.startswith("header.")]
    out = {}
    for name, known in READ.items():
        fitting = [(at, len(path), path) for path in usable if (at := rank(_plain(path), known)) is not None]
        if fitting:
            out[name] = min(fitting)[-1]
    if "stamp" not in out:  # a list of reads may have a timestamp for each read
        out.update([("stamp", path) for path in paths if path.endswith("stamp") and LIST in path][:1])
    return out


def _units(fields: Mapping[str, str]) -> dict[str, str]:
    """Return the units of the values of an RFID read by name. A message field such as ``rssi_cdbm`` implies a unit.

    ``fields``: the path of the message field of each value, by name. Values without an implied unit are left out."""
    out = {}
    for name, ends in UNITS.items():
        plain = _plain(fields.get(name, ""))
        if known := [end for end in ends if plain.endswith(end)]:
            out[name] = ends[max(known, key=len)]
    return out


def _plain(path: str) -> str:
    return plain(path.rsplit(".", 1)[-1].removesuffix(LIST))
