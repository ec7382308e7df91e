"""Learning of a rig from logs by the calibrators of all sensors, along reference trajectories or smoothed ones.

Without a reference, smoothing and learning alternate (expectation-maximisation: Dempster, Laird and Rubin, JRSS B 39,
1977; with a smoother: Shumway and Stoffer, "An approach to time series smoothing and forecasting using the EM
algorithm", 1982). Each turn smooths the logs with the current rig, and learns a rig from the smoothed trajectories and
their covariances. The iteration ends when a turn changes all values by less than a fraction of their standard errors.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.fitting.posterior import FittedConstant
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.result import RunResult
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.sections import kind_of
from factorgraph_loc.sensors.calibrating import Calibrator, OneOfSeveral, SensorKnowledge
from factorgraph_loc.sensors.registry import functions
from factorgraph_loc.sensors.smoothed import Traced
from factorgraph_loc.text import Notice, notice

Smooth = Callable[[Log], RunResult]
"""Runs the smoother on a log, with the log's rig."""

SETTLED = 0.3  # standard errors; the iteration ends when no value changes by more than this
TURNS = 8  # maximum number of turns of smoothing and learning
TOO_VAGUE = 1.0  # m; a smoothed trajectory with a larger median standard deviation is not used


@dataclass(frozen=True)
class Knowledge:
    """A learnt ``rig``, and the learnt constants, warnings and figures of its ``sensors``, by the name of the sensor.

    ``turns``: the largest change of a constant in each iteration, in standard errors. Iterations of smoothing and
    learning occur for logs without a reference. Otherwise the tuple is empty.
    """

    rig: Rig
    sensors: Mapping[str, SensorKnowledge]
    turns: tuple[float, ...] = ()

    @property
    def constants(self) -> tuple[FittedConstant, ...]:
        """The learnt constants of all sensors."""
        return tuple(constant for sensor in self.sensors.values() for constant in sensor.constants)

    @property
    def notes(self) -> tuple[Notice, ...]:
        """The warnings of all sensors, and one if the iterations of smoothing and learning have not converged."""
        notes = [note for sensor in self.sensors.values() for note in sensor.notes]
        if self.turns and self.turns[-1] >= SETTLED:
            change = "The last of {turns} turns still changed a value by {change:.1f} standard errors: "
            notes.append(notice("unsettled", change + "the logs hardly determine it.", len(self.turns), self.turns[-1]))
        return tuple(notes)


def calibrators(rig: Rig) -> Mapping[str, Calibrator]:
    """Return a calibrator for each sensor of the rig that can be calibrated, by the name of the sensor."""
    return {
        name: calibrator if kind_of(name) == name else OneOfSeveral(calibrator, name)
        for name, calibrator in functions("calibrator", rig)
    }


def senses(rig: Rig) -> tuple[str, ...]:
    """Return the names of the exteroceptive streams that can be calibrated, such as ``bearing_range``."""
    return tuple(calibrator.channel for calibrator in calibrators(rig).values() if calibrator.senses)


def learn(
    traced: Sequence[Traced],
    rig: Rig,
    first: Rig | None = None,
    grids: Path | None = None,
    like: Knowledge | None = None,
) -> Knowledge:
    """Return a rig learnt from logs with known trajectories, its constants and warnings. Each sensor is learnt
    separately.

    ``traced``: logs with trajectories. ``rig``: initial values. ``first``: the rig before the first iteration of
    smoothing and learning, None for ``rig``. ``grids``: path and name prefix of files of detection grids that may be
    written. ``like``: a result from more logs, or None. The types of sensor models in it are used again. Raises
    InputError if a log is too short.
    """
    traced = [replace(trace, log=replace(trace.log, rig=rig)) for trace in traced]
    sensors, learnt = {}, rig
    for name, calibrator in calibrators(rig).items():
        known = None if like is None else like.sensors.get(name)
        sensors[name] = calibrator.learn(traced, rig, first or rig, grids, known)
        learnt = learnt.model_copy(update=dict(sensors[name].sections))
    return Knowledge(learnt, sensors)


def sensing(rig: Rig, log: Log) -> Rig:
    """Return a copy of ``rig`` for a log. In its list ``sensors``, exteroceptive sensors without measurements in the
    log are removed, and those with measurements are added."""
    sensed = senses(rig)
    kept = [name for name in rig.sensors if name not in sensed or name in log.streams]
    added = [name for name in sensed if name in log.streams and name not in kept]
    return rig.model_copy(update={"sensors": (*kept, *added)})


def has_heading(log: Log) -> bool:
    """True if the log has a reference with meaningful headings."""
    return log.reference is not None and log.reference.has_heading


def learn_by_turns(
    logs: Sequence[Log],
    start: Rig,
    smooth: Smooth,
    grids: Path | None = None,
    progress: Callable[[float, float], None] | None = None,
) -> Knowledge:
    """Return a rig learnt from ``logs`` without reference trajectories, its constants and warnings. All logs are
    smoothed and a rig is learnt from the smoothed trajectories, alternately until the constants converge.

    ``start``: the rig of the first iteration. ``smooth``: a function that runs the smoother on a log. ``grids``: path
    and name prefix of files of detection grids that may be written. ``progress``: called with the number of smoothed
    logs so far and its maximum. Raises InputError if a log contains too little information.
    """
    rig, turns, fitted = start, list[float](), dict[tuple[str, str], float]()
    while True:
        for calibrator in calibrators(start).values():
            rig = calibrator.with_priors(rig, start)
        smoothed = []
        for log in logs:
            smoothed.append(_smoothed(replace(log, rig=rig, reference=None), smooth))
            if progress is not None:
                progress(len(turns) * len(logs) + len(smoothed), TURNS * len(logs))
        knowledge = learn(smoothed, rig, start, grids)
        if not knowledge.constants and not knowledge.notes:
            raise InputError(
                f"{logs[0].name}: nothing can be learnt without a reference, because the rig {start.name} has neither a detection "
                "model nor a constant with an uncertainty for the sensors of the log"
            )
        rig = knowledge.rig
        turns.append(max((_change(constant, fitted) for constant in knowledge.constants), default=0.0))
        fitted = {(c.sensor, c.name): c.fitted for c in knowledge.constants}
        if len(turns) == TURNS or turns[-1] < SETTLED:
            return replace(knowledge, turns=tuple(turns))


def _smoothed(log: Log, smooth: Smooth) -> Traced:
    """Return a log with the smoothed trajectory as reference. ``smooth``: a function that runs the smoother on a log.
    Raises InputError if the robot is not localized, or if the median position sigma exceeds :data:`TOO_VAGUE`."""
    result = smooth(log)
    final = result.final
    if result.first_localized() is None or len(final) < 2 or final.covariances is None:
        raise InputError(
            f"{log.name}: the smoother did not localize the robot, so that nothing can be learnt without a reference"
        )
    sigma = float(np.sqrt(np.median(np.trace(final.covariances[:, :2, :2], axis1=1, axis2=2))))
    if sigma > TOO_VAGUE:
        raise InputError(
            f"{log.name}: the smoother estimates the position with a standard deviation of {sigma:.1f} m (median), expected "
            f"{TOO_VAGUE:g} m or less to learn from it without a reference"
        )
    doubted = frozenset[str]().union(*result.diagnostics.doubted.values())
    return Traced(replace(log, reference=final), result.learnt.values, doubted)


def _change(constant: FittedConstant, fitted: Mapping[tuple[str, str], float]) -> float:
    """Return the absolute change of a constant in an iteration, in standard errors. ``fitted``: the values of the
    previous iteration by (sensor, name of the constant)."""
    change = abs(constant.fitted - fitted.get((constant.sensor, constant.name), constant.initial))
    return change / constant.error if change > 0.0 else 0.0
