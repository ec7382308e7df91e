"""The reader of ROS bags. A manifest maps topics to sensors, and ``fgloc manifest BAG`` proposes one.

The bag is read once. Only the needed numbers of its messages are kept. Images are written to files.
"""

import math
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import checks
from factorgraph_loc.files.models import FileModel, add_fields, parse_model
from factorgraph_loc.files.several import by_name, one_or_several
from factorgraph_loc.io.bags.camera import CameraTopic, Images, Info
from factorgraph_loc.io.bags.file import Bag, open_bag
from factorgraph_loc.io.bags.motion import ImuTopic, OdometryTopic, YawRates, odometry
from factorgraph_loc.io.bags.poses import (
    POINT,
    POSES,
    ROBOT,
    STATIC,
    PoseTopic,
    ReferenceTopic,
    Start,
    StartTopic,
    StaticFrames,
    poses_of_topic,
    static_frames,
)
from factorgraph_loc.io.bags.tables import Landmarks, LandmarkTopic, Reads, RfidTopic, TableTopic, rows_of_table
from factorgraph_loc.io.bags.topics import TF, Clock, Listeners, report
from factorgraph_loc.io.motions import odometry_stream
from factorgraph_loc.io.native.rig_file import DEFAULT_RIG, default_rig
from factorgraph_loc.model.log import NOT_READ, RIG_NOTES, Log
from factorgraph_loc.model.measurement import Stream, of_sensor
from factorgraph_loc.model.pose_path import PosePath
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.sections import several
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.rfid.settings import AntennaSettings, RfidSettings
from factorgraph_loc.sensors.rfid.stream import RfidStream
from factorgraph_loc.sensors.tables import Reading, native_tables
from factorgraph_loc.text import Notice, listed, notice, plain
from factors.camera.model import angles_of_camera
from factors.se2 import Array

FRAMES, WITHIN = ":", "."  # /tf:PARENT.CHILD


def camera_of(info: Info, frames: StaticFrames, notes: list[Notice]) -> CameraSettings:
    """Return the settings of a camera. ``info``: its CameraInfo. ``frames``: the static transforms of the bag.

    If the transforms lack the camera, it is at the robot's origin and points forward. Then a note is appended to
    ``notes``.
    """
    pose = frames.pose(info.frame)
    if pose is None:
        sentence = "tf_static has no mounting of {frame} on {base}: set it in the rig"
        notes.append(notice("unmounted", sentence, info.frame, frames.base))
        return info.settings({})
    notes.append(notice("mounted", "tf_static has the mounting of {frame} on {base}", info.frame, frames.base))
    roll, pitch, yaw = angles_of_camera(pose[:3, :3])
    x, y, z = pose[:3, 3].tolist()
    return info.settings({"x": x, "y": y, "z": z, "roll": roll, "pitch": pitch, "yaw": yaw})


def antennas_of(
    names: Iterable[str], given: Mapping[str, str], frames: StaticFrames, notes: list[Notice]
) -> RfidSettings:
    """Return the settings of the RFID antennas ``names``, mounted at the poses of their frames in ``tf_static``.

    ``given``: the frame by antenna; the frame of any other antenna has the antenna's name. The x axis of a frame is the
    boresight. An antenna without a frame is at the robot's origin. Notes for the user are appended to ``notes``.
    """
    poses = {name: frames.pose(given.get(name, name)) for name in sorted(names)}
    for verb, known in (("has the", True), ("has no", False)):
        if which := [name for name, pose in poses.items() if (pose is not None) == known]:
            sentence = f"tf_static {verb} mounting of antennas {{antennas}} on {{base}}"
            notes.append(notice("mounted" if known else "unmounted", sentence, ", ".join(which), frames.base))
    return RfidSettings(
        antennas={name: AntennaSettings() if p is None else _antenna(name, p) for name, p in poses.items()}
    )


def _antenna(name: str, pose: Array) -> AntennaSettings:
    x, y, z = pose[:3, 3].tolist()
    ahead = pose[:3, 0]
    pitch = math.asin(float(np.clip(ahead[2], -1.0, 1.0)))
    place = {"x": x, "y": y, "z": z, "yaw": math.atan2(ahead[1], ahead[0]), "pitch": pitch}
    return parse_model(AntennaSettings, place, f"tf_static of antenna {plain(name)}")


class Options(FileModel):
    """The options of the reader of ROS bags: for each sensor, the settings of its topic."""

    odometry: OdometryTopic
    imu: ImuTopic | None = None
    rfid: RfidTopic | None = None
    bearing_range: one_or_several(LandmarkTopic) = None  # type: ignore[valid-type]
    camera: CameraTopic | None = None
    reference: ReferenceTopic | None = None
    start: StartTopic | None = None
    clock: Clock = "header"
    """timestamps to use: header for the timestamps of message headers, receive for the times of receipt; a topic may override it"""
    base_frame: str = "base_link"
    """frame of the robot; mountings of sensors are read from tf_static relative to this frame"""


OTHERS = {
    name: tables for name, (_, tables) in native_tables().items() if name not in {*Options.model_fields, "inventories"}
}
add_fields(
    Options,
    {name: (one_or_several(TableTopic) if name in several() else TableTopic | None, None) for name in OTHERS},
    after="camera",
)


def read(path: Path | None, options: Options) -> Log:
    """Return the log in the bag ``path``. Its t = 0 is the time of the first odometry message.

    ``options``: the topic of each sensor. Raises InputError with the bag, topic, message and field of an invalid value.
    """
    if path is None:
        raise InputError("rosbag: the path of the bag is missing")
    with open_bag(path) as bag, ExitStack() as stack:
        return _read(bag, options, stack)


def _read(bag: Bag, options: Options, stack: ExitStack) -> Log:
    listeners = Listeners(bag, options.clock)
    frames = static_frames(listeners, options.base_frame)
    motion = odometry(listeners, options.odometry, frames)
    sensors = _sensors(listeners, options, frames, stack)
    info = None
    if options.camera and options.camera.info:
        info = Info(bag, options.camera.info)
        listeners.add(options.camera.info, info)
    of_reference = options.reference
    poses = poses_of_topic(listeners, of_reference, frames) if of_reference else None
    start = listeners.listen(options.start, Start(bag, options.start)) if options.start else None
    listeners.run()

    clock, warnings = report(listeners.stampers, options.clock)
    t_ns, moves = motion(warnings)
    t0_ns = int(t_ns[0])
    streams: dict[str, Stream] = {"odometry": odometry_stream(t_ns, moves, t0_ns, options.odometry, warnings)}
    reading = Reading(DEFAULT_RIG, t0_ns, warnings)
    streams |= {name: of_sensor(sensor.stream(reading), name) for name, sensor in sensors.items()}
    reference = None
    if poses and of_reference:
        path = poses(warnings)
        has_heading = of_reference.has_heading and path.has_rotations
        t = checks.seconds(path.stamps(), t0_ns)
        reference = Trajectory(t, path.on_floor(warnings, of_reference), has_heading=has_heading)
    notes: list[Notice] = []  # about the rig that is made from the bag
    rig = _rig(streams, info, options, frames, notes)
    name = bag.path.resolve().stem
    return Log(
        name=name,
        rig=rig,
        world=World(name=name),
        streams=streams,
        reference=reference,
        start=start.pose(t0_ns, warnings) if start else None,
        t0_ns=t0_ns,
        warnings=tuple(warnings),
        metadata={"clock": clock}
        | ({RIG_NOTES: "; ".join(map(str, notes))} if notes else {})
        | ({NOT_READ: left_out} if (left_out := _left_out(bag, listeners)) else {}),
    )


def _left_out(bag: Bag, listeners: Listeners) -> str:
    """Return, as one text, the names and types of the topics with messages that have no collector in ``listeners``."""
    unread = [topic for topic in bag.topics.values() if topic.count and topic.name not in (*listeners.topics, STATIC)]
    return ", ".join(f"{topic.name} ({topic.type})" for topic in unread)


def _sensors(listeners: Listeners, options: Options, frames: StaticFrames, stack: ExitStack) -> dict[str, Any]:
    """Return a collector of each sensor in ``options`` except odometry, registered at ``listeners``, by the sensor's
    name. ``stack``: closes temporary files at the end. ``frames``: the static transforms of the bag."""
    bag = listeners.bag
    out: dict[str, Any] = {}
    if options.imu:
        out["imu"] = listeners.listen(options.imu, YawRates(bag, options.imu, frames))
    if options.rfid:
        out["rfid"] = listeners.listen(options.rfid, Reads(bag, options.rfid))
    for name, topic in by_name("bearing_range", options.bearing_range).items():
        out[name] = listeners.listen(topic, Landmarks(bag, topic, frames))
    if options.camera:
        out["camera"] = _images(listeners, options.camera, stack)
    for kind, tables in OTHERS.items():
        for name, mapping in by_name(kind, getattr(options, kind)).items():
            out[name] = listeners.listen(mapping, rows_of_table(bag, mapping, tables))
    return out


def _images(listeners: Listeners, options: CameraTopic, stack: ExitStack) -> Images:
    """Return a collector of images. It is registered at ``listeners`` unless the images are in the cache folder.

    ``stack``: deletes temporary files when it is closed."""
    stamper = listeners.stamper(options.topic, options.clock)
    images = Images(listeners.bag, options.topic, stamper, stack)
    if images.known:
        listeners.stampers.append(stamper)
    else:
        listeners.add(options.topic, images, stamper)
    return images


def _rig(
    streams: dict[str, Stream], info: Info | None, options: Options, frames: StaticFrames, notes: list[Notice]
) -> Rig:
    """Return a rig for the ``streams`` of a bag, with default noise. Notes about mountings are appended to ``notes``.

    ``info``: the CameraInfo of the camera, None without a camera. ``frames``: the static transforms of the bag."""
    camera = camera_of(info, frames, notes) if info else None
    reads = streams.get("rfid")
    rfid = None
    if options.rfid and isinstance(reads, RfidStream) and reads.antenna:
        rfid = antennas_of(set(reads.antenna), options.rfid.frames, frames, notes)
    usable = [name for name in streams if name not in {"camera", "sightings"} or camera is not None]
    return default_rig(streams).model_copy(update={"sensors": tuple(usable), "camera": camera, "rfid": rfid})


def read_trajectory(path: Path, topic: str) -> PosePath:
    """Return the trajectory in the ``topic`` of the bag ``path``.

    The topic has messages with poses or points. ``/tf:PARENT.CHILD`` gives the poses of the frame CHILD in the frame
    PARENT. A timestamp is the header's timestamp, or the time of receipt if a message has no header. Raises InputError
    with the number of an invalid message.
    """
    name, _, frames = topic.partition(FRAMES)
    with open_bag(path) as bag:
        if not name:
            known = [candidate.name for candidate in bag.topics.values() if candidate.type in (*POSES, POINT, *TF)]
            names = f": {listed(known)}" if known else ", but it has no such topic"
            raise InputError(f"{path}: is a bag, expected {path}:TOPIC with one of its topics of poses{names}")
        listeners, warnings = Listeners(bag, "header"), list[Notice]()
        parent, _, child = frames.partition(WITHIN)
        if bag.topic(name).type in TF and not (parent and child):
            raise InputError(
                f"{path}: {name} holds transforms, expected two frames as well, such as {path}:{name}:map.base_link"
            )
        static = static_frames(listeners, ROBOT[0])
        poses = poses_of_topic(listeners, PoseTopic(topic=name, parent=parent, child=child), static)
        listeners.run()
        return replace(poses(warnings), warnings=tuple(warnings))
