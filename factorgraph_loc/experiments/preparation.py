"""The sensors of a run, and what their packages prepare before an estimator runs."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from factorgraph_loc.errors import FglocError, InputError
from factorgraph_loc.files.models import FileModel, nearest
from factorgraph_loc.fusion import registry
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.registry import channels, functions, moving
from factorgraph_loc.sensors.usage import PreparedLog, Use, lacking_section
from factorgraph_loc.text import listed, quoted


def columns_of(streams: Iterable[str]) -> tuple[str, ...]:
    """The channels that are columns of ``streams``."""
    there = set(streams)
    return tuple(channel.name for channel in channels().values() if channel.column_of in there)


def used_sensors(log: Log, asked: tuple[str, ...] | None) -> tuple[str, ...]:
    """The sensors to use: those of the rig that the log has, or ``asked``, which must be available."""
    there = (*log.streams, *_told_columns(log))
    for sensor in asked or ():
        channel = channels().get(sensor)
        rows = channels()[channel.column_of] if channel is not None and channel.column_of else None
        if rows is not None and rows.name not in (asked or ()):
            raise InputError(f"{log.name}: {sensor} comes with {rows.rows}, expected {rows.name} among the sensors too")
        if rows is not None and sensor not in there:
            raise InputError(f"{log.name}: has no sensor {quoted(sensor)}: none of its {rows.rows} has a value of it")
        if sensor not in there:
            raise InputError(f"{log.name}: has no sensor {quoted(sensor)}{nearest(sensor, list(there))}")
        if section := lacking_section(log.rig, sensor):
            raise InputError(f"{log.name}: {sensor} needs [{section}] in the rig, and {log.rig.name} has none")
    sensors = tuple(
        s for s in (log.rig.sensors if asked is None else asked) if s in there and not lacking_section(log.rig, s)
    )
    if not log.streams:
        as_odometry = "--reader trajectory --reader-option use=odometry"
        raise InputError(
            f"{log.name}: is a trajectory without measurements, expected a log; as odometry: {as_odometry}"
        )
    if not sensors:
        raise InputError(
            f"{log.name}: has none of the rig's sensors {listed(log.rig.sensors)}{nearest('', list(there))}"
        )
    return sensors


def unused(log: Log, sensors: tuple[str, ...]) -> tuple[str, ...]:
    """Warnings about unusable sensors of the rig, and about missing odometry."""
    there = (*log.streams, *_told_columns(log))
    doubts = [f"{log.name}: the rig lists the sensor {s}, the log has none" for s in log.rig.sensors if s not in there]
    lacking = {s: section for s in log.streams if s in log.rig.sensors and (section := lacking_section(log.rig, s))}
    for section in dict.fromkeys(lacking.values()):
        names = ", ".join(name for name, of in lacking.items() if of == section)
        doubts.append(f"{log.name}: {names} left out, as the rig {log.rig.name} has no [{section}]")
    if not moving(sensors, "floor", "space"):
        doubts.append(f"{log.name}: run without odometry, the motion between measurements is unknown")
    return tuple(doubts)


def use_of(log: Log, sensors: Sequence[str], estimator: str, settings: FileModel) -> Use:
    """The description of a run for the sensors' packages."""
    kind = registry.estimator_type(estimator)
    modalities = getattr(kind, "modalities", frozenset[str]())
    return Use(log, tuple(sensors), estimator, settings, modalities, getattr(kind, "estimates_points", False))


def prepare(use: Use, progress: Callable[[float], None] = lambda _: None) -> PreparedLog:
    """The log of a run after the preparation by its sensors, and warnings."""
    made = PreparedLog(use.log)
    for _, function in functions("prepare"):
        one: PreparedLog = function(replace(use, log=made.log), progress)
        images, seconds = made.images + one.images, made.seconds + one.seconds
        made = PreparedLog(one.log, (*made.warnings, *one.warnings), images, seconds)
    return made


def fill_cache(uses: Iterable[Use]) -> None:
    """Find the features of a log's images, so that parallel runs find them in the cache.

    Errors of the log are left to the runs.
    """
    with suppress(FglocError):
        any(prepare(use).images for use in uses)


def _told_columns(log: Log) -> tuple[str, ...]:
    """The columns that have a value in any row of the log."""
    names = columns_of(log.streams)
    return tuple(n for n in names if np.any(np.isfinite(getattr(log.streams[channels()[n].column_of], n, np.nan))))
