"""The rig sections and world layers that sensors register.

Classes and functions are given as places, ``package.module:name``, and loaded when they are first used.
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
    """A section of a rig. ``kind``: its class, a :class:`~factorgraph_loc.files.models.FileModel`; ``always``: whether a rig
    without the section gets the default one. ``several``: whether a rig may have several such sensors by name,
    ``[section.NAME]``. Their channel, its only table and the modality of its measurements have the name of the section then."""

    kind: Place
    always: bool = False
    several: bool = False


@dataclass(frozen=True)
class Layer:
    """A layer of a world: elements by name. ``kind``: the class of an element, a
    :class:`~factorgraph_loc.files.models.FileModel`; ``table``: the description of a table that may hold many of them.

    ``read``: ``(content, source, folder) -> elements`` converts the content of a world file in ``folder``, such as the name of a
    table. ``write``: ``(elements, path of the world file without suffixes) -> content``, or None. ``suffix``: of these tables.
    """

    kind: Place
    table: Place = ""
    read: Place = ""
    write: Place = ""
    suffix: str = ""


@cache
def registered() -> Mapping[str, Any]:
    """The registered sensors by name, each a :class:`~factorgraph_loc.sensors.registry.SensorType`, built-in ones first.
    InputError if one cannot be loaded or two share a name."""
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
    """The sections of a rig by name in the order of its file; those without a channel are last."""
    by_name = {name: section for sensor in registered().values() for name, section in sensor.settings.items()}
    used = set(sections_of_channels().values())
    return {name: by_name[name] for name in sorted(by_name, key=lambda name: name not in used)}


def sections_of_channels() -> dict[str, str]:
    """The rig section of each channel."""
    return {channel.name: channel.section for sensor in registered().values() for channel in sensor.channels}


@cache
def several() -> frozenset[str]:
    """The kinds of sensors that a rig may have several times, each with a name."""
    return frozenset(name for name, section in sections().items() if section.several)


def kind_of(name: str) -> str:
    """The section or channel of a sensor by its name: ``bearing_range`` of ``bearing_range.front``."""
    return name.partition(".")[0]


def as_only(names: Iterable[str], chosen: str) -> dict[str, str]:
    """``names`` without the other sensors of the kind of ``chosen``, by new names: ``chosen`` has the name of its kind."""
    kind = kind_of(chosen)
    return {kind if name == chosen else name: name for name in names if name == chosen or kind_of(name) != kind}


def layers() -> dict[str, Layer]:
    """The layers of a world by name."""
    return {name: layer for sensor in registered().values() for name, layer in sensor.layers.items()}
