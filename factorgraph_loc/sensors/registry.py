"""The registry of sensors and their channels.

A sensor is a package whose ``__init__`` defines a :class:`SensorType`. It refers to classes and functions of its modules by place,
``package.module:name``, so that they are imported only when needed (:func:`factorgraph_loc.plugins.load`). Built-in sensors are
listed in :mod:`factorgraph_loc.builtin`; other packages register the place of their :class:`SensorType` as an entry point of the
group ``factorgraph_loc.sensors``.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from typing import TYPE_CHECKING, Any

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import nearest
from factorgraph_loc.files.settings import Setting, first_sentence, settings_in
from factorgraph_loc.model.sections import Layer, Section, kind_of, registered, several
from factorgraph_loc.plugins import SENSORS, Place, load
from factorgraph_loc.text import quoted

if TYPE_CHECKING:
    from factorgraph_loc.model.rig import Rig
    from factorgraph_loc.sensors.base import Binding, Sensor


@dataclass(frozen=True)
class Channel:
    """A name in ``--sensors`` and of a log's streams.

    ``section``: the rig's section with the ``time_offset``. ``tables``: the descriptions
    (:class:`~factorgraph_loc.files.columns.Table`) of its tables in a log; ``described``: of further tables, for measurements that
    differ from those. An optional column of the sensor's first channel has none, as ``rssi`` and ``phase`` of ``rfid``.

    If stream fields are not columns: ``assemble``: ``(rows by table, reading) ->
    stream`` and ``disassemble``: ``(stream, writing) -> columns by table``, see :mod:`factorgraph_loc.sensors.tables`. For pushed
    measurements whose fields are not columns: ``check``: ``(measurement, where) -> validated fields``. ``intake``: the class of an
    :class:`~factorgraph_loc.sensors.tables.Intake`, made of (rig, world).
    """

    name: str
    section: str = ""
    tables: tuple[Place, ...] = ()
    described: tuple[Place, ...] = ()
    assemble: Place = ""
    disassemble: Place = ""
    check: Place = ""
    intake: Place = ""

    @property
    def streams(self) -> list[type[Any]]:
        """The classes of its streams, whose ``kind`` is the class of their measurements."""
        tables = [load(place) for place in (*self.tables, *self.described)]
        return [load(table.stream) for table in tables if table.stream]


@dataclass(frozen=True)
class SensorType:
    """A sensor: its ``channels``, its ``settings`` (sections of the rig), its ``layers`` of the world, and the places of its
    functions, "" for none. :func:`functions` returns those of all sensors.

    ``detects``: the layer of the world whose elements it detects, "" for none. ``locates``: whether it localizes the robot without
    a map.

    ``summarize``: ``(log) ->`` :class:`~factorgraph_loc.sensors.interfaces.Summary`, for ``fgloc info``; ``draw``: ``(log) ->``
    :class:`~factorgraph_loc.sensors.interfaces.Marks`, for plots and viewers. ``bind``: ``(binding) ->``
    :class:`~factorgraph_loc.sensors.base.Sensor`, or None if a run does not use it.

    For runs (:class:`~factorgraph_loc.sensors.interfaces.Use`): ``check``: ``(use) -> use``, with the settings that the log
    requires, or InputError if log and settings do not fit; ``review``: ``(use, ending) ->``
    :class:`~factorgraph_loc.sensors.interfaces.Review`, from an :class:`~factorgraph_loc.sensors.interfaces.Ending`.

    For simulated logs, whose settings have the sections ``simulation``: ``simulate``: ``(ride) ->``
    :class:`~factorgraph_loc.sensors.interfaces.Simulated`, from a :class:`~factorgraph_loc.sensors.interfaces.Ride`; ``looks``:
    ``(settings)``, the measurement rate [Hz] by plural of the detected things; ValueError if the settings are inconsistent. For
    active robots: ``on_robot``: ``(world, rig, settings, rng) ->`` :class:`~factorgraph_loc.sensors.interfaces.LiveSensor` or None;
    ``forecast``: ``(world, rig, speed, settings) ->`` :class:`~factorgraph_loc.sensors.interfaces.Forecast` or None.

    ``calibrator``: a :class:`~factorgraph_loc.sensors.calibrating.Calibrator`.
    """

    name: str
    channels: tuple[Channel, ...]
    settings: Mapping[str, Section] = field(default_factory=dict)
    layers: Mapping[str, Layer] = field(default_factory=dict)
    simulation: Mapping[str, Section] = field(default_factory=dict)
    detects: str = ""
    locates: bool = False
    bind: Place = ""
    summarize: Place = ""
    draw: Place = ""
    check: Place = ""
    review: Place = ""
    simulate: Place = ""
    looks: Place = ""
    on_robot: Place = ""
    forecast: Place = ""
    calibrator: Place = ""


def sensors() -> Mapping[str, SensorType]:
    """All sensors by name, built-in ones first. InputError if one cannot be loaded or two share a name."""
    return registered()


def sensor(name: str) -> SensorType:
    """A sensor by its name or that of one of its channels; InputError if it is unknown."""
    if name in sensors():
        return sensors()[name]
    if name in channels():
        return sensor_of(name)
    raise InputError(f"no sensor is called {quoted(name)}{nearest(name, [*sensors(), *channels()])}")


def sections_of(sensor: SensorType) -> dict[str, list[Setting]]:
    """The settings in each of a sensor's sections of the rig."""
    return {name: settings_in(load(section.kind)) for name, section in sensor.settings.items()}


def about(name: str) -> str:
    """The first sentence of the docstring of a sensor's package."""
    return first_sentence(load(SENSORS.place(name).partition(":")[0]))


@cache
def channels() -> Mapping[str, Channel]:
    """All channels by name, as used in ``--sensors``."""
    return {channel.name: channel for sensor in sensors().values() for channel in sensor.channels}


@cache
def sensor_of(channel: str) -> SensorType:
    """The sensor of a channel; ``channel`` may be the ``sensor`` of a measurement or the name of a stream, also of one of several
    sensors. InputError if it is unknown."""
    kind = kind_of(channel)
    for sensor in sensors().values():
        if any(own.name == kind for own in sensor.channels) and (kind == channel or kind in several()):
            return sensor
    raise InputError(f"no sensor is called {quoted(channel)}{nearest(channel, list(channels()))}")


def moving(names: Iterable[str], rank: int = 0) -> tuple[str, ...]:
    """The channels among ``names`` that measure motion on the floor; with ``rank``
    :data:`~factorgraph_loc.model.measurement.TURN` also those that measure rotation alone."""
    streams = {name: channels()[kind_of(name)].streams for name in names if kind_of(name) in channels()}
    return tuple(name for name, kinds in streams.items() if kinds and kinds[0].rank <= rank)


def parent_of(channel: str) -> str:
    """The channel with ``channel`` as an optional column, or ""."""
    known = channels().get(channel)
    return "" if known is None or known.tables else sensor_of(channel).channels[0].name


def detecting(world: Any, names: Collection[str]) -> list[SensorType]:
    """The sensors with a channel among ``names`` that can localize the robot in a ``world``."""
    return [
        sensor
        for sensor in sensors().values()
        if any(channel.name == kind_of(name) for channel in sensor.channels for name in names)
        and (sensor.locates or (sensor.detects and getattr(world, sensor.detects, None)))
    ]


def channel(name: str) -> Channel:
    """A channel by name, also that of one of several sensors; InputError if it is unknown."""
    return next(own for own in sensor_of(name).channels if own.name == kind_of(name))


def functions(kind: str, rig: Rig | None = None) -> Iterator[tuple[str, Any]]:
    """Names and functions of one kind, a field of :class:`SensorType`, of the sensors that have it.

    Of several sensors of a kind in the ``rig``, each has its name, such as ``bearing_range.front``. Its function expects a rig or a
    log where it is the only one of its kind (:meth:`~factorgraph_loc.model.rig.Rig.alone`).
    """
    for name, sensor in sensors().items():
        if place := getattr(sensor, kind):
            known = () if rig is None else [each for section in sensor.settings for each in rig.names(section)]
            for each in [each for each in known if kind_of(each) != each] or (name,):
                yield each, load(place)


def bound_sensors(binding: Binding) -> dict[str, Sensor]:
    """The exteroceptive sensors of a run by name."""
    named = [("" if kind_of(name) == name else name, bind) for name, bind in functions("bind", binding.setup.rig)]
    sensors = [bind(replace(binding, setup=binding.setup.alone(name), name=name)) for name, bind in named]
    return {sensor.name: sensor for sensor in sensors if sensor is not None}
