"""Sections of a rig and layers of a map, which the packages of sensors register.

Classes and functions are registered as texts ``package.module:name``, and loaded when they are first used.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from factorgraph_loc.errors import InputError
from factorgraph_loc.plugins import SENSORS, Place
from factorgraph_loc.text import plain


@dataclass(frozen=True)
class Section:
    """A section of a rig. Classes are given as text ``package.module:name``.

    ``kind``: the class of its settings, a :class:`~factorgraph_loc.files.models.FileModel`. ``always``: True if a rig
    without the section gets the default settings. ``several``: True if a rig may have several such sensors, each in a
    table ``[section.NAME]``. The sensor's stream, its only table and the modality of its measurements must then have
    the name of the section.
    """

    kind: Place
    always: bool = False
    several: bool = False


@dataclass(frozen=True)
class Layer:
    """A layer of a map: elements of one class by name, such as RFID tags. All fields except ``suffix`` are texts
    ``package.module:name``.

    ``kind``: the class of an element, a :class:`~factorgraph_loc.files.models.FileModel`. ``table``: the description of
    a table with many elements. ``read``: a function ``(content, source, folder) -> elements``. It converts the value in
    a world file, such as the name of a table in ``folder``. ``write``: a function ``(elements, path of the world file
    without suffixes) -> content``. It writes a table and returns the name of the table. It returns None if the elements
    are written in the world file itself. ``suffix``: the suffix of the tables that ``write`` writes.
    """

    kind: Place
    table: Place = ""
    read: Place = ""
    write: Place = ""
    suffix: str = ""


@cache
def registered() -> Mapping[str, Any]:
    """Return the types of sensors by name, each a :class:`~factorgraph_loc.sensors.registry.SensorType`, built-in ones
    first.

    Raises InputError if a sensor cannot be loaded, or if two sensors have the same channel, section or layer.
    """
    known = dict(SENSORS)
    owners: dict[tuple[str, str], str] = {}
    for name, sensor in known.items():
        names = {"channel": [c.name for c in sensor.channels], "setting": sensor.settings, "layer": sensor.layers}
        for key in ((kind, each) for kind, several in names.items() for each in several):
            if key in owners:
                raise InputError(f"sensors: {plain(name)} and {owners[key]} both have the {key[0]} {plain(key[1])}")
            owners[key] = name
    return known


def sections() -> dict[str, Section]:
    """Return {name: section} of the sections that a rig may have, in the order of a rig file. Sections of sensors
    without measurements are last."""
    by_name = {name: section for sensor in registered().values() for name, section in sensor.settings.items()}
    used = set(sections_of_channels().values())
    return {name: by_name[name] for name in sorted(by_name, key=lambda name: name not in used)}


def sections_of_channels() -> dict[str, str]:
    """Return {channel: section of the rig}. A channel is the name of a stream of measurements in a log."""
    return {channel.name: channel.section for sensor in registered().values() for channel in sensor.channels}


@cache
def several() -> frozenset[str]:
    """Return the kinds of sensors that a rig may have more than once, such as ``camera.front`` and ``camera.back``."""
    return frozenset(name for name, section in sections().items() if section.several)


def kind_of(name: str) -> str:
    """Return the kind of a sensor, its name before the dot: ``bearing_range`` for ``bearing_range.front``."""
    return name.partition(".")[0]


def as_only(names: Iterable[str], chosen: str) -> dict[str, str]:
    """Return {new name: old name} of sensors, after ``chosen`` has become the only sensor of its kind. ``names``: all
    sensors. The new name of ``chosen`` is the name of its kind. Other sensors of that kind are left out."""
    kind = kind_of(chosen)
    return {kind if name == chosen else name: name for name in names if name == chosen or kind_of(name) != kind}


def layers() -> dict[str, Layer]:
    """Return the layers that a map may have, such as ``landmarks`` and ``tags``, by name. Sensors register them."""
    return {name: layer for sensor in registered().values() for name, layer in sensor.layers.items()}
