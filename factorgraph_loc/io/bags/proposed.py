"""The proposed manifest of a bag as a file, with remarks as comments, among them on what a bag carries that nothing here uses."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomli_w

from factorgraph_loc.io.bags.file import Bag, open_bag
from factorgraph_loc.io.bags.manifest import Proposal, propose

UNUSED = {
    "sensor_msgs/msg/LaserScan": "laser scan",
    "sensor_msgs/msg/MultiEchoLaserScan": "laser scan",
    "sensor_msgs/msg/PointCloud": "point cloud",
    "sensor_msgs/msg/PointCloud2": "point cloud",
    "velodyne_msgs/msg/VelodyneScan": "point cloud",
    "livox_ros_driver/msg/CustomMsg": "point cloud",
    "livox_ros_driver2/msg/CustomMsg": "point cloud",
    "sensor_msgs/msg/NavSatFix": "GNSS",
    "sensor_msgs/msg/NavSatStatus": "GNSS",
    "gps_common/msg/GPSFix": "GNSS",
    "gps_msgs/msg/GPSFix": "GNSS",
    "nmea_msgs/msg/Sentence": "GNSS",
    "ublox_msgs/msg/NavPVT": "GNSS",
    "sensor_msgs/msg/Range": "sonar or infrared range",
    "sensor_msgs/msg/MagneticField": "magnetometer",
    "sensor_msgs/msg/FluidPressure": "pressure",
    "sensor_msgs/msg/Temperature": "temperature",
    "sensor_msgs/msg/BatteryState": "battery",
    "sensor_msgs/msg/Joy": "joystick",
    "geometry_msgs/msg/WrenchStamped": "force",
    "nav_msgs/msg/OccupancyGrid": "grid map",
    "nav_msgs/msg/Path": "path",
    "stereo_msgs/msg/DisparityImage": "depth image",
    "dvs_msgs/msg/EventArray": "event camera",
    "diagnostic_msgs/msg/DiagnosticArray": "diagnostics",
    "rosgraph_msgs/msg/Log": "messages of programs",
    "rcl_interfaces/msg/Log": "messages of programs",
}


@dataclass(frozen=True)
class TopicUse:
    """A topic of a bag. ``rate``: messages per second, None for fewer than two; ``use``: what it is taken for, or None; ``unused``:
    what it carries that nothing here uses, such as a laser scan, or None."""

    topic: str
    type: str
    messages: int
    rate: float | None
    use: str | None
    unused: str | None


@dataclass(frozen=True)
class BagManifest:
    """A proposed manifest: its ``content``, and its ``text`` as TOML with ``remarks`` as comments. Its paths are relative to
    ``folder``. ``duration``: of the bag [s]; ``topics``: all that are in it."""

    content: Mapping[str, Any]
    remarks: tuple[str, ...]
    text: str
    folder: Path
    duration: float
    topics: tuple[TopicUse, ...]


def manifest_of_bag(bag: Path, here: Path) -> BagManifest:
    """Propose a manifest to be saved in ``here``, if the bag is below that folder, else beside the bag. InputError if the bag
    cannot be read."""
    path, here = Path(os.path.realpath(bag)), here.resolve()
    root = here if path.is_relative_to(here) else path.parent
    with open_bag(path) as opened:
        stem = path.with_suffix("") if path.is_file() else path
        beside = {
            kind: (file.relative_to(root)).as_posix()
            for kind in ("rig", "world")
            if (file := stem.with_name(f"{stem.name}.{kind}.toml")).is_file()
        }
        proposal = propose(opened)
        content = manifest_of(proposal, path.relative_to(root).as_posix(), beside)
        told = remarks(opened, proposal, beside)
        duration, topics = opened.duration, topics_of(opened, proposal)
    return BagManifest(content, tuple(told), manifest_text(content, told), root, duration, topics)


def topics_of(bag: Bag, proposal: Proposal) -> tuple[TopicUse, ...]:
    """The topics of a bag with their proposed uses."""
    span = bag.duration
    return tuple(
        TopicUse(
            topic.name,
            topic.type,
            topic.count,
            (topic.count - 1) / span if span > 0.0 and topic.count > 1 else None,
            proposal.uses.get(topic.name),
            None if topic.name in proposal.uses else UNUSED.get(topic.type),
        )
        for topic in bag.topics.values()
    )


def manifest_of(proposal: Proposal, path: str, beside: Mapping[str, str]) -> dict[str, Any]:
    """The manifest of the bag ``path``; ``beside``: names of existing rig and world files."""
    return {
        "title": f"The bag {Path(path).name}",
        "reader": "rosbag",
        "path": path,
        **beside,
        "licence": "none stated",
        "origin": "your own recording",
        "options": proposal.options,
    }


def remarks(bag: Bag, proposal: Proposal, beside: Mapping[str, str]) -> list[str]:
    """Remarks on a proposed manifest for the user, and the unused topics."""
    out = list(proposal.notes)
    if "rig" not in beside:
        out.append('no rig is given: set rig = "NAME.rig.toml" to a file next to this one; `fgloc rigs new` writes one')
    if "world" not in beside:
        out.append('no map is given: set world = "NAME.world.toml" to a file next to this one with tags and landmarks')
    unused = [topic for topic in bag.topics.values() if topic.name not in proposal.uses]
    for topic in unused:
        what = f", {UNUSED[topic.type]}: nothing here uses it" if topic.type in UNUSED else ""
        out.append(f"not used: {topic.name} ({topic.type}, {topic.count} messages){what}")
    return out


def manifest_text(manifest: Mapping[str, Any], told: Sequence[str]) -> str:
    """A manifest as TOML, with the lines ``told`` as comments."""
    head = {key: value for key, value in manifest.items() if key != "options"}
    options = dict(sorted(manifest["options"].items(), key=lambda item: isinstance(item[1], dict)))  # tables last
    comments = "".join(f"# {line}\n" for line in told)
    return f"{tomli_w.dumps(head)}{comments}\n{tomli_w.dumps({'options': options})}"
