"""How a run uses a sensor."""

from collections.abc import Container
from dataclasses import dataclass

from factorgraph_loc.files.models import FileModel
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.registry import channels


@dataclass(frozen=True)
class Use:
    """A run of a log. ``sensors``: names of usable channels; ``estimator``: its name, with ``settings``; ``modalities``: of
    measurements that it uses; ``estimates_points``: whether it may estimate points that are not in the map."""

    log: Log
    sensors: tuple[str, ...]
    estimator: str
    settings: FileModel
    modalities: Container[str]
    estimates_points: bool


@dataclass(frozen=True)
class PreparedLog:
    """A ``log`` that can be run, with images replaced by features. ``images``: number of images whose features were computed or
    loaded from the cache, in ``seconds``."""

    log: Log
    warnings: tuple[str, ...] = ()
    images: int = 0
    seconds: float = 0.0


def lacking_section(rig: Rig, sensor: str) -> str:
    """The section that a sensor requires, if the rig lacks it, else ""."""
    channel = channels().get(sensor)
    if channel is None or not channel.needs_section or getattr(rig, channel.section, None) is not None:
        return ""
    return channel.section
