"""What registered sensors add to a rig and to a world: sections and layers by name, each with its class.

Classes and functions are named by their places, ``package.module:name``, and loaded when they are first used.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Protocol

from factorgraph_loc.errors import InputError
from factorgraph_loc.plugins import SENSORS, Place
from factorgraph_loc.text import plain


@dataclass(frozen=True)
class Section:
    """A section of a rig. ``kind``: its class, a :class:`~factorgraph_loc.files.models.FileModel`; ``always``: whether a rig that
    does not say it has the default one."""

    kind: Place
    always: bool = False


@dataclass(frozen=True)
class Layer:
    """A layer of a world, things by name. ``kind``: the class of one, a :class:`~factorgraph_loc.files.models.FileModel`;
    ``table``: the description of the table that may hold many of them.

    ``read``: ``(content, source, folder) -> things``, of what stands in the file of a world in ``folder``, such as the name of a
    table; ``write``: ``(things, world's file without suffixes) -> what stands there in place of them``, or None; ``suffix``: of the
    tables that they read and write.
    """

    kind: Place
    table: Place = ""
    read: Place = ""
    write: Place = ""
    suffix: str = ""


class _Channel(Protocol):
    @property
    def name(self) -> str: ...
    @property
    def section(self) -> str: ...


class Sensor(Protocol):
    """What is asked of a registered sensor here."""

    @property
    def channels(self) -> Sequence[_Channel]: ...
    @property
    def settings(self) -> Mapping[str, Section]: ...
    @property
    def layers(self) -> Mapping[str, Layer]: ...


@cache
def registered() -> Mapping[str, Sensor]:
    """The sensors by name, ours first. InputError if one of another package cannot be loaded, or if two bring the same name."""
    found: dict[str, Sensor] = dict(SENSORS)
    owners: dict[tuple[str, str], str] = {}
    for name, sensor in found.items():
        names = {"channel": [c.name for c in sensor.channels], "setting": sensor.settings, "layer": sensor.layers}
        for key in ((kind, each) for kind, several in names.items() for each in several):
            if key in owners:
                raise InputError(f"sensors: {plain(name)} and {owners[key]} both have the {key[0]} {plain(key[1])}")
            owners[key] = name
    return found


def sections() -> dict[str, Section]:
    """The sections of a rig by name, in the order in which they are written: what belongs to no channel comes last."""
    found = {name: section for sensor in registered().values() for name, section in sensor.settings.items()}
    used = set(sections_of_channels().values())
    return {name: found[name] for name in sorted(found, key=lambda name: name not in used)}


def sections_of_channels() -> dict[str, str]:
    """The section of the rig that tells the clock of a channel, by the channel's name."""
    return {channel.name: channel.section for sensor in registered().values() for channel in sensor.channels}


def layers() -> dict[str, Layer]:
    """The layers of a world by name."""
    return {name: layer for sensor in registered().values() for name, layer in sensor.layers.items()}
