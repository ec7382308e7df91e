"""A rig learnt from logs with reference poses, before any estimator runs: constants, noise, scatter."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from factorgraph_loc.fitting.constants import FittedConstant
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.calibrating import Calibrator
from factorgraph_loc.sensors.registry import functions


@dataclass(frozen=True)
class Knowledge:
    """What is learnt from logs.

    ``rig``: with the scatter of the residuals as noise; ``notes``: what could not be learnt, one line each. ``found``: results
    of the sensors' calibrators, by sensor, from which the constants are selected; ``details``: what is learnt given these, such
    as the noise of the odometry.
    """

    rig: Rig
    constants: tuple[FittedConstant, ...]
    notes: tuple[str, ...]
    found: Mapping[str, Any]
    details: Mapping[str, Any]


@cache
def calibrators() -> Mapping[str, Calibrator]:
    """The calibrators of all sensors that have one, by name."""
    return dict(functions("calibrator"))


def senses() -> tuple[str, ...]:
    """The exteroceptive channels that can be calibrated."""
    return tuple(one.channel for one in calibrators().values() if one.senses)


def learn(
    logs: Sequence[Log],
    rig: Rig,
    grids: Path | None = None,
    like: Knowledge | None = None,
    *,
    by_log: bool = True,
) -> Knowledge:
    """Learn a rig from ``logs``, starting from ``rig``, whose values stay where the logs do not determine better ones.

    ``grids``: path prefix of the files written for logs with tag reads; ``like``: the result from all logs, if ``logs`` is a
    part of them. ``by_log``: see :func:`settled`. Raises InputError if a log is too short.
    """
    logs = [replace(log, rig=rig) for log in logs]
    found = {}
    for name, calibrator in calibrators().items():
        one = calibrator.learn(logs, rig, grids, None if like is None else like.found.get(name))
        if one is not None:
            found[name] = one
    return settled(Knowledge(rig, (), (), found, {}), logs, rig, by_log=by_log)


def settled(
    knowledge: Knowledge,
    logs: Sequence[Log],
    rig: Rig,
    accepted: Collection[str] | None = None,
    *,
    by_log: bool = True,
) -> Knowledge:
    """What is learnt with those constants that improve the prediction of held-out data and are in ``accepted`` (names
    ``section.parameter``; None: all).

    Noise, scatter and uncertainty are learnt given these constants. ``rig``: the rig of ``logs``. With ``by_log`` False, logs
    are not fitted individually, and there are neither uncertainties nor correlations.
    """
    logs = [replace(log, rig=rig) for log in logs]
    parts = {
        name: calibrators()[name].settle(found, logs, rig, accepted, by_log=by_log)
        for name, found in knowledge.found.items()
    }
    notes = [note for part in parts.values() for note in part.notes]
    if not has_heading(logs[0]):
        notes.insert(
            0, "The reference has no headings: only the range scale is learnt, the constants of the odometry stay."
        )
    if len(logs) == 1:
        notes.append(
            "Differences between runs cannot be learnt from one log: the uncertainties of constants are those of the input rig."
        )
    learnt = tuple(one for part in parts.values() for one in part.constants)
    out = rig.model_copy(update={name: settings for part in parts.values() for name, settings in part.sections.items()})
    return Knowledge(
        sensing(_uncertainties(out, learnt), logs[0]),
        learnt,
        tuple(notes),
        knowledge.found,
        {name: part.details for name, part in parts.items()},
    )


def sensing(rig: Rig, log: Log) -> Rig:
    """``rig`` with exactly the exteroceptive sensors that the log has, among those that are used."""
    kept = [name for name in rig.sensors if name not in senses() or name in log.streams]
    added = [name for name in senses() if name in log.streams and name not in kept]
    return rig.model_copy(update={"sensors": (*kept, *added)})


def _uncertainties(rig: Rig, learnt: Sequence[FittedConstant]) -> Rig:
    """``rig`` with the standard deviations of constants between logs, where there are several."""
    sections: dict[str, object] = {}
    for calibrator in calibrators().values():
        settings, most = getattr(rig, calibrator.section), calibrator.uncertain
        if settings is None or not most:
            continue
        found = {
            one.name: min(one.uncertainty, most[one.name])
            for one in learnt
            if one.sensor == calibrator.section and one.uncertainty is not None
        }
        uncertainty = settings.uncertainty.model_copy(update=found)
        sections[calibrator.section] = settings.model_copy(update={"uncertainty": uncertainty})
    return rig.model_copy(update=sections)


def has_heading(log: Log) -> bool:
    """Whether the log's reference has meaningful headings."""
    return log.reference is not None and log.reference.has_heading
