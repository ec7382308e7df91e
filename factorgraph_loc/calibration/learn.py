"""Learning of a rig from logs along given trajectories, by the calibrators of all sensors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from factorgraph_loc.fitting.posterior import FittedConstant
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.calibrating import Calibrator, SensorKnowledge
from factorgraph_loc.sensors.registry import functions
from factorgraph_loc.sensors.smoothed import Traced


@dataclass(frozen=True)
class Knowledge:
    """A learnt ``rig``, and what was ``found``, by sensor."""

    rig: Rig
    found: Mapping[str, SensorKnowledge]

    @property
    def constants(self) -> tuple[FittedConstant, ...]:
        return tuple(constant for found in self.found.values() for constant in found.constants)

    @property
    def notes(self) -> tuple[str, ...]:
        """Messages on parameters that were not learnt, one line each."""
        return tuple(note for found in self.found.values() for note in found.notes)


@cache
def calibrators() -> Mapping[str, Calibrator]:
    """The calibrators of all sensors that have one, by name."""
    return dict(functions("calibrator"))


def senses() -> tuple[str, ...]:
    """The exteroceptive channels that can be calibrated."""
    return tuple(one.channel for one in calibrators().values() if one.senses)


def learn(
    traced: Sequence[Traced],
    rig: Rig,
    first: Rig | None = None,
    grids: Path | None = None,
    like: Knowledge | None = None,
) -> Knowledge:
    """Learn a rig from logs along their trajectories, starting from ``rig``: see
    :meth:`~factorgraph_loc.sensors.calibrating.Calibrator.learn`. Along a given trajectory the sensors are independent, so
    that each is a problem of its own."""
    traced = [replace(one, log=replace(one.log, rig=rig)) for one in traced]
    found, changed = {}, rig
    for name, calibrator in calibrators().items():
        known = None if like is None else like.found.get(name)
        found[name] = calibrator.learn(traced, rig, first or rig, grids, known)
        changed = changed.model_copy(update=dict(found[name].sections))
    return Knowledge(changed, found)


def sensing(rig: Rig, log: Log) -> Rig:
    """``rig`` with exactly the exteroceptive sensors that the log has, among those that are used."""
    kept = [name for name in rig.sensors if name not in senses() or name in log.streams]
    added = [name for name in senses() if name in log.streams and name not in kept]
    return rig.model_copy(update={"sensors": (*kept, *added)})


def has_heading(log: Log) -> bool:
    """Whether the log's reference has meaningful headings."""
    return log.reference is not None and log.reference.has_heading
