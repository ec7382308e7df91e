"""A rig learnt from logs with reference poses, before any estimator runs: constants, noise, scatter."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from factorgraph_loc.fitting.constants import Learnt
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.calibrating import Calibrator
from factorgraph_loc.sensors.registry import functions


@dataclass(frozen=True)
class Knowledge:
    """What the logs say. ``rig`` has the scatter as noise; ``notes``: what could not be learnt, one line each. ``found``: what the
    calibrators of sensors found, by the sensors' names, from which their constants are chosen; ``details``: what is learnt for
    these, such as the noise of the odometry."""

    rig: Rig
    constants: tuple[Learnt, ...]
    notes: tuple[str, ...]
    found: Mapping[str, Any]
    details: Mapping[str, Any]


@cache
def calibrators() -> Mapping[str, Calibrator]:
    """Those of all sensors that have one, by name."""
    return dict(functions("calibrator"))


def senses() -> tuple[str, ...]:
    """The channels that a robot knows its place by, among those that can be calibrated."""
    return tuple(one.channel for one in calibrators().values() if one.senses)


def learn(
    logs: Sequence[Log],
    rig: Rig,
    grids: Path | None = None,
    like: Knowledge | None = None,
    *,
    by_log: bool = True,
) -> Knowledge:
    """The rig that ``logs`` tell, starting from ``rig``, whose values stay where a log cannot tell them better.

    ``grids``: path and beginning of the names of files that are written, of logs with reads of tags; ``like``: what all logs tell,
    if these are some of them. ``by_log``: see :func:`settled`. Raises InputError if a log is too short.
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
    """What is learnt with those constants alone that are worth it and ``accepted``, by their names with the section's; None: all
    that are worth it.

    What depends on the constants, noise, scatter and uncertainty, is learnt for these. ``rig``: that with which ``logs`` came.
    Unless ``by_log``, no log is looked at alone: then there are neither uncertainties nor correlations.
    """
    logs = [replace(log, rig=rig) for log in logs]
    parts = {
        name: calibrators()[name].settle(found, logs, rig, accepted, by_log=by_log)
        for name, found in knowledge.found.items()
    }
    notes = [note for part in parts.values() for note in part.notes]
    if not has_heading(logs[0]):
        notes.insert(
            0, "The reference has no headings: of the constants only the range scale is learnt, the odometry stays."
        )
    if len(logs) == 1:
        notes.append(
            "One log cannot tell what differs between runs: the uncertainties of constants are those of the input rig."
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
    """The rig with all exteroceptive sensors of the log, and none that the log lacks, among those that are used."""
    kept = [name for name in rig.sensors if name not in senses() or name in log.streams]
    added = [name for name in senses() if name in log.streams and name not in kept]
    return rig.model_copy(update={"sensors": (*kept, *added)})


def _uncertainties(rig: Rig, learnt: Sequence[Learnt]) -> Rig:
    """The rig with what differs between logs, where there are several."""
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
    """Whether the log's reference has headings that mean something."""
    return log.reference is not None and log.reference.has_heading
