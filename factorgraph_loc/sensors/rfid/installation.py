"""The antennas and tags of a run: antennas on the robot and tags in the map, or the reverse.

The antennas of a reader may be fixed in the building, for example at gates. The map file then lists the antennas, and
the rig lists the tags on the robot. :func:`installed` moves these antennas to the rig and these tags to the map, where
all modules of this package expect them. Poses of such antennas are in the world frame, tags are in the robot frame.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import TypeVar

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.sensors.interfaces import Marks, Ride, Use
from factorgraph_loc.sensors.rfid.known_tags import tag_map
from factorgraph_loc.sensors.rfid.map import Tag
from factorgraph_loc.sensors.rfid.settings import FixedAntenna, RfidSettings, SurveySettings
from factorgraph_loc.sensors.rfid.stream import RfidStream
from factorgraph_loc.text import listed, quoted

Run = TypeVar("Run", Log, Setup, Ride)


def installed(run: Run) -> Run:
    """Return a copy of ``run`` that describes antennas in the building as antennas of the rig.

    If the tags are on the robot, the antennas of the map are added to the rig. The tags of the rig become the tags of
    the map. A rig with antennas on the robot is not changed. Raises InputError if the map has no antennas, or if an
    antenna has an unknown detection model. Raises InputError if a tag on the robot is also in the map.
    """
    settings = run.rig.find(RfidSettings)
    if settings is None or not settings.tags or settings.antennas:
        return run
    antennas: Mapping[str, FixedAntenna] = run.world.antennas
    if not antennas:
        raise InputError(
            "the rig has [rfid.tags], but the map has no antennas: add [antennas.NAME] with x, y, z and yaw to the map"
        )
    for name, antenna in antennas.items():
        if antenna.model not in settings.models:
            raise InputError(
                f"antenna {quoted(name)} of the map has the model {quoted(antenna.model)}, expected one of [rfid.models] in the "
                f"rig: {listed(settings.models)}"
            )
    if both := [epc for epc in settings.tags if epc in run.world.tags]:
        raise InputError(
            f"tag {quoted(both[0])} is on the robot ([rfid.tags] of the rig) and also in the map: remove it from one of them"
        )
    tags = {epc: Tag(**tag.model_dump()) for epc, tag in settings.tags.items()}
    reader = settings.model_copy(update={"antennas": dict(antennas)})
    rig = run.rig.model_copy(update={"rfid": reader, "survey": SurveySettings()})
    return replace(run, rig=rig, world=run.world.model_copy(update={"tags": tags}))


def is_fixed(rig: Rig) -> bool:
    """Return True if the antennas are fixed in the building, and the tags are on the robot."""
    settings = rig.find(RfidSettings)
    return settings is not None and bool(settings.tags)


def check(use: Use) -> Use:
    """Return ``use`` unchanged. Raises InputError if the tags are on the robot and the map lacks an antenna of the log.
    Raises InputError if the antennas are on the robot, and an antenna that the rig lacks is in the map."""
    settings, stream = use.log.rig.find(RfidSettings), use.log.streams.get("rfid")
    if settings is None or "rfid" not in use.sensors or not isinstance(stream, RfidStream):
        return use
    names, known = dict.fromkeys(stream.antenna), installed(use.log).rig.of(RfidSettings).all_antennas()
    lacking = [name for name in names if name not in known]
    if settings.tags and lacking:
        raise InputError(
            f"{use.log.name}: antenna {quoted(lacking[0])} is not in the map: add [antennas.{quoted(lacking[0])}] with x, y, z and "
            "yaw to the map"
        )
    if fixed := [name for name in lacking if name in use.log.world.antennas]:
        raise InputError(
            f"{use.log.name}: antenna {quoted(fixed[0])} is fixed in the map, but the rig has antennas on the robot: write "
            "[rfid.tags.EPC] with x, y and z instead of its antennas"
        )
    return use


def draw(log: Log) -> Marks:
    """Return the tags of the map and the times of their reads in ``log``, for plots and viewers. If the tags are on the
    robot, return the antennas in the building instead."""
    stream, fixed = log.streams.get("rfid"), is_fixed(log.rig)
    t, names = np.empty(0), tuple[str, ...]()
    if isinstance(stream, RfidStream):
        rows = [i for i, epc in enumerate(stream.epc) if epc]
        t = (stream.t - stream.age + log.rig.time_offset("rfid"))[rows]
        names = tuple((stream.antenna if fixed else stream.epc)[i] for i in rows)
    if fixed:
        antennas: Mapping[str, FixedAntenna] = log.world.antennas
        points = np.array([(a.x, a.y, a.z) for a in antennas.values()]).reshape(-1, 3)
        return Marks("antennas", tuple(antennas), points, t, names, marker="^", size=6.0, order=2.0)
    known = tag_map(log.world, log.rig.of(SurveySettings))
    return Marks("tags", known.names, known.tags.points, t, names, marker="s", size=5.0, order=2.0)
