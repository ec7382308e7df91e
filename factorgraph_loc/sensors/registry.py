"""The sensors: what each brings, and which of them a name is of.

A sensor is a package. Its ``__init__`` has a :class:`SensorType` that names the classes and functions of its modules by their
places, ``package.module:name``, so that asking what there is imports nothing else; :func:`factorgraph_loc.plugins.load` does. Ours
stand in :mod:`factorgraph_loc.builtin`. Another package registers one by an entry point of the group ``factorgraph_loc.sensors``
whose value is the place of its :class:`SensorType`.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Literal, cast

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import nearest
from factorgraph_loc.model.sections import Layer, Section, registered
from factorgraph_loc.plugins import SENSORS, Place, load
from factorgraph_loc.text import quoted


@dataclass(frozen=True)
class Channel:
    """A name in ``--sensors``, and of a log's streams.

    ``streams``, ``measurements``: the classes that a stream of this name may have, and what it yields. Both are empty of a channel
    that only says how the rows of another one are used, as ``rssi`` and ``phase`` do of those of ``rfid``: they are columns of it
    (``column_of``). ``rows``: what its rows are called. ``section``: the one of the rig that has the ``time_offset`` of its stamps,
    without which it tells nothing if it ``needs_section``. ``motion``: whether it tells how the robot moves on a floor or in space,
    or how it turns.

    ``tables``: the descriptions (:class:`~factorgraph_loc.files.columns.Table`) of those in which a log keeps it; ``described``: of
    further ones, such as what its measurements hold where that is not what the tables do. Where a stream's fields are no columns:
    ``assemble``: ``(rows by table, reading) -> stream``, ``disassemble``: ``(stream, writing) -> columns by table``, see
    :mod:`factorgraph_loc.sensors.tables`. Of measurements that a program pushes, where their fields are no columns: ``check``:
    ``(measurement, where) -> fields``, checked; ``sequence``: a class, made of (rig, world), whose ``require(measurement, where)``
    raises InputError for one that does not go with those before it.
    """

    name: str
    streams: tuple[Place, ...] = ()
    measurements: tuple[Place, ...] = ()
    section: str = ""
    needs_section: bool = False
    column_of: str = ""
    rows: str = "rows"
    motion: Literal["", "floor", "space", "turn"] = ""
    tables: tuple[Place, ...] = ()
    described: tuple[Place, ...] = ()
    assemble: Place = ""
    disassemble: Place = ""
    check: Place = ""
    sequence: Place = ""


@dataclass(frozen=True)
class SensorType:
    """What a sensor brings: its ``channels``, the sections of the rig that are its ``settings``, its ``layers`` of the world, and
    the places of its functions, "" where it has none; :func:`functions` gives those of all sensors.

    ``summarize``: ``(log) ->`` :class:`~factorgraph_loc.sensors.summary.Summary`, what ``fgloc info`` says of a log; ``draw``:
    ``(log) ->`` :class:`~factorgraph_loc.sensors.marks.Marks`, what plots and viewers draw of it.

    Of an estimator: ``bind``: ``(binding) ->`` :class:`~factorgraph_loc.sensors.base.Sensor`, None where a run does not use it;
    ``predict``: ``(rig, sensors, diagnostics, self_calibration) ->`` :class:`~factorgraph_loc.model.motion.Motion`.

    Of a run (:class:`~factorgraph_loc.sensors.usage.Use`): ``check``: ``(use)``, InputError where log and settings do not go
    together; ``prepare``: ``(use, progress) ->`` :class:`~factorgraph_loc.sensors.usage.Prepared`; ``doubts``: ``(use,
    diagnostics)``, the warnings at its end; ``findable``: ``(log, sensors)``, a plural for what these channels can find in the map
    and the words for that nothing of it was found, or None; ``mappable``: ``(log)``, the layer of a world that ``fgloc map`` can
    make of what it measured, or None.

    Of simulated logs, whose settings have the sections ``simulation``: ``simulate``: ``(ride) ->``
    :class:`~factorgraph_loc.sensors.simulated.Simulated`, from a :class:`~factorgraph_loc.sensors.simulated.Ride`; ``looks``:
    ``(settings)``, how often per second a drive looks for all things of a kind, by a plural for these; ValueError where the
    settings do not fit together. Of robots that choose where to drive: ``on_robot``: ``(world, rig, settings, rng) ->``
    :class:`~factorgraph_loc.sensors.simulated.LiveSensor` or None; ``forecast``: ``(world, rig, speed, settings) ->``
    :class:`~factorgraph_loc.sensors.forecast.Forecast` or None.

    ``calibrator``: a :class:`~factorgraph_loc.sensors.calibrating.Calibrator`.
    """

    name: str
    channels: tuple[Channel, ...]
    settings: Mapping[str, Section] = field(default_factory=dict)
    layers: Mapping[str, Layer] = field(default_factory=dict)
    simulation: Mapping[str, Section] = field(default_factory=dict)
    bind: Place = ""
    predict: Place = ""
    summarize: Place = ""
    draw: Place = ""
    check: Place = ""
    prepare: Place = ""
    doubts: Place = ""
    findable: Place = ""
    mappable: Place = ""
    simulate: Place = ""
    looks: Place = ""
    on_robot: Place = ""
    forecast: Place = ""
    calibrator: Place = ""


def sensors() -> Mapping[str, SensorType]:
    """All sensors by name, ours first. InputError if one of another package cannot be loaded, or if two bring the same name."""
    return cast(Mapping[str, SensorType], registered())


@cache
def channels() -> Mapping[str, Channel]:
    """All channels by name: what may stand in ``--sensors``."""
    return {channel.name: channel for sensor in sensors().values() for channel in sensor.channels}


@cache
def sensor_of(channel: str) -> SensorType:
    """The sensor that a channel is of, which is also the ``sensor`` of a measurement and the name of a log's stream. InputError if
    there is none of that name."""
    for sensor in sensors().values():
        if any(own.name == channel for own in sensor.channels):
            return sensor
    raise InputError(f"no sensor is called {quoted(channel)}{nearest(channel, list(channels()))}")


def moving(names: Iterable[str], *motions: str) -> tuple[str, ...]:
    """The channels among ``names`` that tell how the robot moves on the ``floor`` or in ``space``, or how it turns (``turn``)."""
    known = channels()
    return tuple(name for name in names if name in known and known[name].motion in motions)


def channel(name: str) -> Channel:
    """A channel by name; InputError as of :func:`sensor_of`."""
    return next(own for own in sensor_of(name).channels if own.name == name)


def functions(kind: str) -> Iterator[tuple[str, Any]]:
    """The functions of one kind, a field of :class:`SensorType`, of the sensors that have one, with their names."""
    for name, sensor in sensors().items():
        if place := getattr(sensor, kind):
            yield name, load(place)


def forget() -> None:
    """Look once more for what is installed."""
    SENSORS.forget()
    for function in (registered, channels, sensor_of):
        function.cache_clear()
