"""The robot's sensors with their mounting and noise, read from and written to ``NAME.rig.toml``.

Each sensor has its own section, registered by its package. Descriptions state units; bounds reject wrong units (degrees for
radians, mm for m).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import FileModel, add_fields
from factorgraph_loc.model.sections import sections, sections_of_channels
from factorgraph_loc.model.settings import NOTHING, Estimated, SensorSettings
from factorgraph_loc.plugins import load

S = TypeVar("S", bound=FileModel)


class Rig(FileModel):
    """A robot: the sensors that estimators use by default, and the settings of each as an attribute with the section's name, None
    if the robot lacks the sensor."""

    name: str = "rig"
    """name of the robot"""
    sensors: tuple[str, ...] = ("odometry", "bearing_range")
    """sensors that estimators use by default"""

    if TYPE_CHECKING:

        def __init__(self, **values: Any) -> None: ...
        def __getattr__(self, section: str) -> Any: ...

    def find(self, kind: type[S], section: str | None = None) -> S | None:
        """The settings of class ``kind``, or None; ``section`` selects one if several have the same class."""
        settings: S | None = getattr(self, section or _SECTIONS[kind])
        return settings

    def of(self, kind: type[S], section: str | None = None) -> S:
        """As :meth:`find`; InputError if the rig lacks the section."""
        settings = self.find(kind, section)
        if settings is None:
            raise InputError(f"the rig {self.name} has no [{section or _SECTIONS[kind]}]")
        return settings

    def estimated(self, section: str) -> Estimated:
        """The constants of a sensor that are estimated; none if the rig lacks the sensor."""
        settings = getattr(self, section)
        return settings.estimated() if isinstance(settings, SensorSettings) else NOTHING

    def time_offset(self, channel: str) -> float:
        """Seconds to add to the timestamps of a channel."""
        settings = getattr(self, _CLOCKS.get(channel, ""), None)
        return float(settings.time_offset) if isinstance(settings, SensorSettings) else 0.0

    def placed(self, folder: Path) -> Self:
        """A copy whose file references are relative to ``folder``."""
        return self.model_copy(update={name: settings.placed(folder) for name, settings in self._of_sensors().items()})

    def write_beside(self, folder: Path) -> None:
        """Write the files that the rig refers to into ``folder``."""
        for settings in self._of_sensors().values():
            settings.write_beside(folder)

    def _of_sensors(self) -> dict[str, SensorSettings]:
        return {name: settings for name in _KINDS if isinstance(settings := getattr(self, name), SensorSettings)}


_KINDS: dict[str, type[FileModel]] = {name: load(section.kind) for name, section in sections().items()}
_SECTIONS = {kind: name for name, kind in reversed(_KINDS.items())}  # the first one if several have the same class
_CLOCKS = sections_of_channels()
add_fields(
    Rig,
    {n: (_KINDS[n], _KINDS[n]()) if s.always else (_KINDS[n] | None, None) for n, s in sections().items()},
    after="sensors",
)
