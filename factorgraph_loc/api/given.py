"""Logs, rigs and maps as they are given to functions: values, names or files."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from factorgraph_loc.io.readers import load
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World

LogLike = Log | str | Path
RigLike = Rig | str | Path
WorldLike = World | str | Path
Settings = Mapping[str, Any]
Progress = Callable[[float, float], None]


def every(logs: LogLike | Sequence[LogLike], rig: RigLike | None = None, world: WorldLike | None = None) -> list[Log]:
    """The logs, loaded if they are given by name, with another rig or map if one is given."""
    several = [logs] if isinstance(logs, (Log, str, Path)) else logs
    return [found for log in several for found in load(log, rig=rig, world=world)]
