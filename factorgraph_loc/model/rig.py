"""The rig: a robot's sensors with their mounting and noise, as in a file ``NAME.rig.toml``.

Each sensor has its own section, which its package registers. Bounds of values reject wrong units (degrees for radians, mm for m).
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
    """A robot and its sensors. The settings of a sensor are an attribute with the name of its section, None if the
    robot lacks it.

    If the robot has several sensors of a kind, the attribute is a dict of settings by name. The full name of such a
    sensor is ``bearing_range.front``, for example. ``sensors``: names of the default sensors of a run. The name of a
    kind means all sensors of that kind.
    """

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
        """Return a copy with the values in ``update`` (by section). A name with a dot, ``bearing_range.front``, updates
        one of several sensors."""
        changed = dict(update or {})
        for name in [name for name in changed if kind_of(name) != name]:
            kind, _, own = name.partition(".")
            changed[kind] = {**(changed.get(kind) or getattr(self, kind) or {}), own: changed.pop(name)}
        return super().model_copy(update=changed, deep=deep)

    def section(self, name: str) -> Any:
        """Return the settings of the section or sensor ``name``, such as ``bearing_range.front``. None if it is
        missing."""
        return by_name(kind_of(name), getattr(self, kind_of(name), None)).get(name)

    def names(self, section: str) -> tuple[str, ...]:
        """Return the names of all sensors in a section: one, several such as ``bearing_range.front``, or none."""
        return tuple(by_name(section, getattr(self, section, None)))

    def expanded(self, sensors: Iterable[str]) -> tuple[str, ...]:
        """Return ``sensors`` with each name of a kind replaced by the names of all sensors of that kind in the rig."""
        return tuple(dict.fromkeys(each for name in sensors for each in self.names(name) or (name,)))

    def alone(self, sensor: str) -> Self:
        """Return the rig with ``sensor`` as the only sensor of its kind. The sensor is renamed to its kind. For example
        ``bearing_range.front`` becomes ``bearing_range``, and ``bearing_range.back`` is left out. Other kinds do not
        change. If ``sensor`` has no dot, the rig is returned unchanged."""
        if kind_of(sensor) == sensor:
            return self
        sensors = tuple(as_only(self.sensors, sensor))
        return self.model_copy(update={kind_of(sensor): self.section(sensor), "sensors": sensors})

    def find(self, kind: type[S], section: str | None = None) -> S | None:
        """Return the settings of class ``kind``, or None if the rig lacks them. ``section``: the name of the section,
        needed if several sections have this class."""
        settings: S | None = self.section(section or _SECTIONS[kind])
        return settings

    def of(self, kind: type[S], section: str | None = None) -> S:
        """Return the settings of class ``kind``. Raises InputError if the rig lacks them. ``section``: the name of the
        section, needed if several sections have this class."""
        settings = self.find(kind, section)
        if settings is None:
            raise InputError(f"the rig {self.name} has no [{section or _SECTIONS[kind]}]")
        return settings

    def estimated(self, section: str) -> Estimated:
        """Return the calibration constants of a sensor that are estimated, none if the rig lacks the sensor.
        ``section``: the name of the sensor's section in the rig, such as ``odometry``."""
        settings = self.section(section)
        return settings.estimated() if isinstance(settings, SensorSettings) else NOTHING

    def time_offset(self, channel: str) -> float:
        """Return the time offset [s] to add to the timestamps of a stream. ``channel``: the stream, such as
        ``rfid``."""
        kind = kind_of(channel)
        settings = self.section(_CLOCKS.get(kind, "") + channel.removeprefix(kind))
        return float(settings.time_offset) if isinstance(settings, SensorSettings) else 0.0

    def placed(self, folder: Path) -> Self:
        """Return a copy for a rig file in ``folder``: paths, such as those of tables of RFID models, are relative to
        it."""
        return self.model_copy(update={name: settings.placed(folder) for name, settings in self._of_sensors().items()})

    def write_beside(self, folder: Path) -> None:
        """Write the files that the rig names, such as tables of RFID models, into ``folder``."""
        for settings in self._of_sensors().values():
            settings.write_beside(folder)

    def _of_sensors(self) -> dict[str, SensorSettings]:
        tables = {each: settings for name in _KINDS for each, settings in by_name(name, getattr(self, name)).items()}
        return {name: settings for name, settings in tables.items() if isinstance(settings, SensorSettings)}


_KINDS: dict[str, type[FileModel]] = {name: load(section.kind) for name, section in sections().items()}
_SECTIONS = {kind: name for name, kind in reversed(_KINDS.items())}  # the first one if several have the same class
_CLOCKS = sections_of_channels()


def _type_of(name: str, section: Section) -> tuple[Any, Any]:
    """Return the type of a section's settings, and their default. ``name``: the name of the section."""
    kind = _KINDS[name]
    if section.always:
        return kind, kind()
    return one_or_several(kind) if section.several else kind | None, None


add_fields(Rig, {name: _type_of(name, section) for name, section in sections().items()}, after="sensors")
