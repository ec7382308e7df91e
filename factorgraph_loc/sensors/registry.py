"""The registry of sensors and their channels.

A sensor is a package whose ``__init__`` defines a :class:`SensorType`. It names classes and functions of its modules by
strings ``package.module:name``. :func:`factorgraph_loc.plugins.load` imports them when they are needed. Built-in
sensors are listed in :mod:`factorgraph_loc.builtin`. Another package registers the string of its :class:`SensorType` as
an entry point of the group ``factorgraph_loc.sensors``.
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
    """One kind of measurement of a sensor. ``name``: its name in the option ``--sensors`` and in ``Log.streams``.

    ``section``: the section of the rig with the channel's ``time_offset``. All further fields are strings
    ``package.module:name`` of objects and functions.
    ``tables``: the files (:class:`~factorgraph_loc.files.columns.Table`) of the channel in a log. A channel without
    files is an optional column in the files of the sensor's first channel, such as ``rssi`` of ``rfid``.
    ``described``: tables that are not files. They describe the fields of measurements.
    ``assemble``: ``(rows by table, reading) -> stream``. Required if fields of the stream are not columns of a file.
    ``disassemble``: ``(stream, writing) -> columns by table``, the inverse of ``assemble``.
    ``check``: ``(measurement, where) -> validated fields``. Required if the fields are not columns of a file.
    ``intake``: a subclass of :class:`~factorgraph_loc.sensors.tables.Intake`. Its arguments are rig and world.
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
        """The classes of the channel's streams. The attribute ``kind`` of each is the class of its measurements."""
        tables = [load(place) for place in (*self.tables, *self.described)]
        return [load(table.stream) for table in tables if table.stream]


@dataclass(frozen=True)
class SensorType:
    """All that the program must know of a type of sensor. A function is a string ``package.module:name``, or "".

    - ``channels``: kinds of measurements. ``settings``: sections of the rig. ``layers``: layers of the map.
    - ``detects``: the layer of the map with the elements that the sensor detects, "" for none.
    - ``locates``: True if the sensor localizes the robot without a map.
    - ``bind``: ``(binding) ->`` :class:`~factorgraph_loc.sensors.base.Sensor`, or None if the run does not use it.
    - ``summarize``: ``(log) ->`` :class:`~factorgraph_loc.sensors.interfaces.Summary`, for ``fgloc info``.
    - ``draw``: ``(log) ->`` :class:`~factorgraph_loc.sensors.interfaces.Marks`, for plots and viewers.
    - ``check``: ``(use) -> use``, called before a run. It may change settings. It raises InputError for wrong settings.
    - ``review``: ``(use, ending) ->`` :class:`~factorgraph_loc.sensors.interfaces.Review`, called after a run.
    - ``simulation``: sections of the settings of simulated logs.
    - ``simulate``: ``(ride) ->`` :class:`~factorgraph_loc.sensors.interfaces.Simulated`, for simulated logs.
    - ``looks``: ``(settings) ->`` expected detections per second in a simulated log, such as {"tags": 80.0}. It raises
      ValueError if the settings of the simulation are inconsistent.
    - ``on_robot``: ``(world, rig, settings, rng) ->`` :class:`~factorgraph_loc.sensors.interfaces.LiveSensor` or None.
      It is used for active localization.
    - ``forecast``: ``(world, rig, speed, settings) ->`` :class:`~factorgraph_loc.sensors.interfaces.Forecast` or None.
      It is used for the planning of paths.
    - ``calibrator``: a :class:`~factorgraph_loc.sensors.calibrating.Calibrator`.
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
    """Return all types of sensors by name. Built-in sensors come before those of other packages. Raises InputError if a
    sensor cannot be loaded or if two sensors have the same name."""
    return registered()


def sensor(name: str) -> SensorType:
    """Return the type of the sensor ``name``, or of the sensor with a channel ``name``. Raises InputError if no sensor
    or channel has this name."""
    if name in sensors():
        return sensors()[name]
    if name in channels():
        return sensor_of(name)
    raise InputError(f"no sensor is called {quoted(name)}{nearest(name, [*sensors(), *channels()])}")


def sections_of(sensor: SensorType) -> dict[str, list[Setting]]:
    """Return the settings in each section of the rig that belongs to the sensor type ``sensor``, by section name."""
    return {name: settings_in(load(section.kind)) for name, section in sensor.settings.items()}


def about(name: str) -> str:
    """Return the first sentence of the docstring of the package of the sensor ``name``."""
    return first_sentence(load(SENSORS.place(name).partition(":")[0]))


@cache
def channels() -> Mapping[str, Channel]:
    """Return all channels of all sensors by name. These names are the possible values of the option ``--sensors``."""
    return {channel.name: channel for sensor in sensors().values() for channel in sensor.channels}


@cache
def sensor_of(channel: str) -> SensorType:
    """Return the sensor that a channel belongs to. Raises InputError if the channel is unknown. ``channel``: the name
    of a channel or stream, possibly of one of several sensors, such as ``bearing_range.front``."""
    kind = kind_of(channel)
    for sensor in sensors().values():
        if any(own.name == kind for own in sensor.channels) and (kind == channel or kind in several()):
            return sensor
    raise InputError(f"no sensor is called {quoted(channel)}{nearest(channel, list(channels()))}")


def moving(names: Iterable[str], rank: int = 0) -> tuple[str, ...]:
    """Return those of the channels ``names`` that measure the motion of the robot. ``rank``: 0 for motion in the plane.
    Use :data:`~factorgraph_loc.model.measurement.TURN` to include channels that measure only rotation."""
    streams = {name: channels()[kind_of(name)].streams for name in names if kind_of(name) in channels()}
    return tuple(name for name, kinds in streams.items() if kinds and kinds[0].rank <= rank)


def parent_of(channel: str) -> str:
    """Return the channel whose files have ``channel`` as an optional column, or "" if ``channel`` has its own files."""
    known = channels().get(channel)
    return "" if known is None or known.tables else sensor_of(channel).channels[0].name


def detecting(world: Any, names: Collection[str]) -> list[SensorType]:
    """Return the types of sensors that can localize the robot in the map ``world``. ``names``: the available
    channels."""
    return [
        sensor
        for sensor in sensors().values()
        if any(channel.name == kind_of(name) for channel in sensor.channels for name in names)
        and (sensor.locates or any(getattr(world, layer, None) for layer in (sensor.detects, *sensor.layers)))
    ]


def channel(name: str) -> Channel:
    """Return the channel ``name``. For one of several sensors, such as "bearing_range.front", this is the channel
    "bearing_range". Raises InputError if the name is unknown."""
    return next(own for own in sensor_of(name).channels if own.name == kind_of(name))


def functions(kind: str, rig: Rig | None = None) -> Iterator[tuple[str, Any]]:
    """Yield the name of each sensor that registers a function ``kind``, and the function.

    ``kind``: a field of :class:`SensorType`, such as "draw". If the ``rig`` has several sensors of one type, each is
    yielded by its own name, such as "bearing_range.front". Call the function with a rig or log that
    :meth:`~factorgraph_loc.model.rig.Rig.alone` has reduced to this sensor.
    """
    for name, sensor in sensors().items():
        if place := getattr(sensor, kind):
            known = () if rig is None else [each for section in sensor.settings for each in rig.names(section)]
            for each in [each for each in known if kind_of(each) != each] or (name,):
                yield each, load(place)


def bound_sensors(binding: Binding) -> dict[str, Sensor]:
    """Return the exteroceptive sensors that a run uses, by name. ``binding``: the arguments of the sensors."""
    named = [("" if kind_of(name) == name else name, bind) for name, bind in functions("bind", binding.setup.rig)]
    sensors = [bind(replace(binding, setup=binding.setup.alone(name), name=name)) for name, bind in named]
    return {sensor.name: sensor for sensor in sensors if sensor is not None}
