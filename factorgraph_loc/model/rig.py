"""The robot's sensors with their mounting and noise, read from and written to ``NAME.rig.toml``.

Each sensor has its own section, registered by its package. Descriptions state units; bounds reject wrong units (degrees for
radians, mm for m).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar

from pydantic import model_validator

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import FileModel, add_fields
from factorgraph_loc.files.several import by_name, one_or_several
from factorgraph_loc.model.sections import Section, as_only, kind_of, sections, sections_of_channels
from factorgraph_loc.model.settings import NOTHING, Estimated, SensorSettings
from factorgraph_loc.plugins import load

S = TypeVar("S", bound=FileModel)


class Rig(FileModel):
    """A robot: the sensors that estimators use by default, and the settings of each as an attribute with the section's name, None
    if the robot lacks the sensor. Several sensors of a kind are a table of settings by name; ``bearing_range.front`` is the name of
    one of them. Among ``sensors``, the name of a kind stands for all of it."""

    name: str = "rig"
    """name of the robot"""
    sensors: tuple[str, ...] = ("odometry", "bearing_range")
    """sensors that estimators use by default"""

    if TYPE_CHECKING:

        def __init__(self, **values: Any) -> None: ...
        def __getattr__(self, section: str) -> Any: ...

    @model_validator(mode="after")
    def _expand(self) -> Self:
        object.__setattr__(self, "sensors", self.expanded(self.sensors))
        return self

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """A copy with updated values; a name with a dot is that of one of several sensors."""
        changed = dict(update or {})
        for name in [name for name in changed if kind_of(name) != name]:
            kind, _, own = name.partition(".")
            changed[kind] = {**(changed.get(kind) or getattr(self, kind) or {}), own: changed.pop(name)}
        return super().model_copy(update=changed, deep=deep)

    def section(self, name: str) -> Any:
        """The settings in a section, ``bearing_range.front`` for one of several; None if the rig lacks it."""
        return by_name(kind_of(name), getattr(self, kind_of(name), None)).get(name)

    def names(self, section: str) -> tuple[str, ...]:
        """The names of the sensors with settings in a section."""
        return tuple(by_name(section, getattr(self, section, None)))

    def expanded(self, sensors: Iterable[str]) -> tuple[str, ...]:
        """``sensors`` with all names of several sensors in place of that of their kind."""
        return tuple(dict.fromkeys(each for name in sensors for each in self.names(name) or (name,)))

    def alone(self, sensor: str) -> Self:
        """The rig with one of several sensors as the only one of its kind; unchanged for a name without a dot."""
        if kind_of(sensor) == sensor:
            return self
        sensors = tuple(as_only(self.sensors, sensor))
        return self.model_copy(update={kind_of(sensor): self.section(sensor), "sensors": sensors})

    def find(self, kind: type[S], section: str | None = None) -> S | None:
        """The settings of class ``kind``, or None; ``section`` selects one if several have the same class."""
        settings: S | None = self.section(section or _SECTIONS[kind])
        return settings

    def of(self, kind: type[S], section: str | None = None) -> S:
        """As :meth:`find`; InputError if the rig lacks the section."""
        settings = self.find(kind, section)
        if settings is None:
            raise InputError(f"the rig {self.name} has no [{section or _SECTIONS[kind]}]")
        return settings

    def estimated(self, section: str) -> Estimated:
        """The constants of a sensor that are estimated; none if the rig lacks the sensor."""
        settings = self.section(section)
        return settings.estimated() if isinstance(settings, SensorSettings) else NOTHING

    def time_offset(self, channel: str) -> float:
        """Seconds to add to the timestamps of a channel."""
        kind = kind_of(channel)
        settings = self.section(_CLOCKS.get(kind, "") + channel.removeprefix(kind))
        return float(settings.time_offset) if isinstance(settings, SensorSettings) else 0.0

    def placed(self, folder: Path) -> Self:
        """A copy whose file references are relative to ``folder``."""
        return self.model_copy(update={name: settings.placed(folder) for name, settings in self._of_sensors().items()})

    def write_beside(self, folder: Path) -> None:
        """Write the files that the rig refers to into ``folder``."""
        for settings in self._of_sensors().values():
            settings.write_beside(folder)

    def _of_sensors(self) -> dict[str, SensorSettings]:
        tables = {each: settings for name in _KINDS for each, settings in by_name(name, getattr(self, name)).items()}
        return {name: settings for name, settings in tables.items() if isinstance(settings, SensorSettings)}


_KINDS: dict[str, type[FileModel]] = {name: load(section.kind) for name, section in sections().items()}
_SECTIONS = {kind: name for name, kind in reversed(_KINDS.items())}  # the first one if several have the same class
_CLOCKS = sections_of_channels()


def _type_of(name: str, section: Section) -> tuple[Any, Any]:
    """The type of a section, and its default."""
    kind = _KINDS[name]
    if section.always:
        return kind, kind()
    return one_or_several(kind) if section.several else kind | None, None


add_fields(Rig, {name: _type_of(name, section) for name, section in sections().items()}, after="sensors")
