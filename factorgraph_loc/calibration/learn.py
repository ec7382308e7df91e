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
from factorgraph_loc.text import Notice, notice

SETTLED = 0.3  # standard errors that the last turn may change


@dataclass(frozen=True)
class Knowledge:
    """A learnt ``rig``, and the results of its ``sensors`` by name.

    ``turns``: for logs without a reference, the largest change of a constant in each turn of smoothing and learning, in standard
    errors.
    """

    rig: Rig
    sensors: Mapping[str, SensorKnowledge]
    turns: tuple[float, ...] = ()

    @property
    def constants(self) -> tuple[FittedConstant, ...]:
        return tuple(constant for sensor in self.sensors.values() for constant in sensor.constants)

    @property
    def notes(self) -> tuple[Notice, ...]:
        """The warnings."""
        notes = [note for sensor in self.sensors.values() for note in sensor.notes]
        if self.turns and self.turns[-1] >= SETTLED:
            change = "The last of {turns} turns still changed a value by {change:.1f} standard errors: "
            notes.append(notice("unsettled", change + "the logs hardly determine it.", len(self.turns), self.turns[-1]))
        return tuple(notes)


@cache
def calibrators() -> Mapping[str, Calibrator]:
    """The calibrators of all sensors that have one, by name."""
    return dict(functions("calibrator"))


def senses() -> tuple[str, ...]:
    """The exteroceptive channels that can be calibrated."""
    return tuple(calibrator.channel for calibrator in calibrators().values() if calibrator.senses)


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
    traced = [replace(trace, log=replace(trace.log, rig=rig)) for trace in traced]
    sensors, learnt = {}, rig
    for name, calibrator in calibrators().items():
        known = None if like is None else like.sensors.get(name)
        sensors[name] = calibrator.learn(traced, rig, first or rig, grids, known)
        learnt = learnt.model_copy(update=dict(sensors[name].sections))
    return Knowledge(learnt, sensors)


def sensing(rig: Rig, log: Log) -> Rig:
    """``rig`` with exactly the exteroceptive sensors that the log has, among those that are used."""
    kept = [name for name in rig.sensors if name not in senses() or name in log.streams]
    added = [name for name in senses() if name in log.streams and name not in kept]
    return rig.model_copy(update={"sensors": (*kept, *added)})


def has_heading(log: Log) -> bool:
    """Whether the log's reference has meaningful headings."""
    return log.reference is not None and log.reference.has_heading
