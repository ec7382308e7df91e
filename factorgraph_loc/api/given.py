"""Logs, rigs and maps as they are given to functions: values, names or files."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from factorgraph_loc.io.native.rig_file import read_rig
from factorgraph_loc.io.native.world_file import read_world
from factorgraph_loc.io.readers import load, read_log
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World

LogLike = Log | str | Path
RigLike = Rig | str | Path
WorldLike = World | str | Path
Settings = Mapping[str, Any]
Progress = Callable[[float, float], None]


def one(log: LogLike, rig: RigLike | None = None, world: WorldLike | None = None) -> Log:
    """The log, loaded if it is given by name, with another rig or map if one is given."""
    if isinstance(log, Log):
        return _with(log, rig, world)
    return read_log(log, rig=rig, world=world)


def every(logs: LogLike | Sequence[LogLike], rig: RigLike | None = None, world: WorldLike | None = None) -> list[Log]:
    """The logs, loaded if they are given by name, with another rig or map if one is given."""
    several = [logs] if isinstance(logs, (Log, str, Path)) else logs
    return [
        found
        for log in several
        for found in ([_with(log, rig, world)] if isinstance(log, Log) else load(log, rig=rig, world=world))
    ]


def _with(log: Log, rig: RigLike | None, world: WorldLike | None) -> Log:
    if rig is not None:
        log = replace(log, rig=rig if isinstance(rig, Rig) else read_rig(rig))
    if world is not None:
        log = replace(log, world=world if isinstance(world, World) else read_world(world))
    return log
