"""Calibration of a complete rig: learn it along references, try it on held-out logs, and keep the input rig if it is worse."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from factorgraph_loc.calibration.held_out import Run, Trial, folds_of, refusal, tried
from factorgraph_loc.calibration.learn import Knowledge, calibrators, has_heading, learn, senses, sensing
from factorgraph_loc.calibration.turns import learn_by_turns
from factorgraph_loc.errors import InputError
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.plugins import load
from factorgraph_loc.sensors.registry import channels, moving
from factorgraph_loc.sensors.smoothed import Traced
from factorgraph_loc.text import listed


@dataclass(frozen=True)
class Calibration:
    """Result of a calibration.

    ``rig``: the learnt one, or the ``input_rig`` if it was ``refused`` for this reason. ``knowledge``: of all logs. ``trials``:
    scores on held-out logs, empty if logs have no reference or are too short. ``doubts``: warnings, one line each.
    ``turns``: for logs without a reference, by how many standard errors each turn changed what was learnt.
    """

    logs: tuple[str, ...]
    input_rig: Rig
    rig: Rig
    knowledge: Knowledge
    trials: tuple[Trial, ...]
    refused: str
    doubts: tuple[str, ...]
    turns: tuple[float, ...] = ()


def calibrate(
    logs: Sequence[Log],
    run: Run,
    rig: Rig | None = None,
    progress: Callable[[float, float], None] | None = None,
    *,
    grids: Path | None = None,
) -> Calibration:
    """Calibrate a rig from ``logs``, with priors about the values of ``rig``, by default that of the first log.

    ``run`` runs an estimator. If no log has a reference, smoothing and learning take turns. ``progress`` is called with the number
    of steps done and of all steps. ``grids``: path prefix of the files of learnt detection grids; needed for logs with tag reads.
    Raises InputError if a log lacks a reference or odometry, has neither exteroceptive measurements nor a reference with headings,
    is too short, or differs in kind from the others.
    """
    report = progress or (lambda _done, _total: None)
    blind = bool(logs) and all(log.reference is None for log in logs)
    if blind:
        check_together(logs)
    else:
        check(logs)
    names, start = tuple(log.name for log in logs), sensing(rig or logs[0].rig, logs[0])
    if blind:
        turns = learn_by_turns(logs, start, lambda log: run(log, "smoother").result, grids, progress)
        return Calibration(names, start, turns.knowledge.rig, turns.knowledge, (), "", turns.doubts, turns.changed)
    knowledge = learn([Traced(log) for log in logs], start, grids=grids)
    folds = folds_of(logs)
    steps = len(folds) + 1
    report(1, steps)
    trials: list[Trial] = []
    short = False
    for i, fold in enumerate(folds):
        try:
            unseen = learn([Traced(log) for log in fold.train], start, grids=_folder(grids, i), like=knowledge).rig
            trials += tried(fold.tests, start, unseen, run)
        except InputError:  # too short
            short = True
        report(i + 2, steps)
    refused = refusal(trials) if trials else ("the logs are too short to hold out parts of them" if short else "")
    doubts = [
        *knowledge.notes,
        *(doubt for n, one in calibrators().items() for doubt in one.doubts(knowledge.found[n])),
    ]
    if not has_heading(logs[0]):
        doubts.insert(
            0, "The reference has no headings: only the range scale is learnt, the constants of the odometry stay."
        )
    if len(logs) == 1:
        doubts.append(
            "Differences between runs cannot be learnt from one log: the uncertainties are those of the input rig."
        )
    doubts += _doubted(trials)
    if refused:
        doubts.append(f"The input rig is kept: {refused}.")
    return Calibration(
        names, start, start if refused else knowledge.rig, knowledge, tuple(trials), refused, tuple(doubts)
    )


def _doubted(trials: Sequence[Trial]) -> list[str]:
    """Elements of the map that the smoother doubts on held-out logs, one line for each kind."""
    found: dict[str, dict[str, None]] = {}
    for trial in trials:
        for kind, names in trial.doubted.items() if trial.estimator == "smoother" else ():
            found.setdefault(kind, {}).update(dict.fromkeys(names))
    return [
        f"The smoother doubts the map on held-out logs: {kind.replace('_', ' ')} {listed(names)}."
        for kind, names in found.items()
        if names
    ]


def _folder(grids: Path | None, fold: int) -> Path | None:
    """The path prefix of a fold's grids."""
    if grids is None:
        return None
    folder = grids.parent / f"{grids.name}.fold{fold}"
    folder.mkdir()
    return folder / grids.name


def check(logs: Sequence[Log]) -> None:
    """Raise InputError if these logs cannot be calibrated together against their references."""
    if not logs:
        raise InputError("there is no log to calibrate from")
    for log in logs:
        if log.reference is None or len(log.reference) < 2:
            more = "; logs without any reference are calibrated by themselves" if len(logs) > 1 else ""
            raise InputError(f"{log.name}: has no reference, expected one to calibrate against{more}")
    check_together(logs)


def check_together(logs: Sequence[Log]) -> None:
    """Raise InputError if these logs are not of one kind, or nothing can be learnt from one of them."""
    for log in logs:
        if not any(_has(log, name) for name in moving(log.streams)):
            raise InputError(f"{log.name}: has no odometry, expected one in every log to calibrate from")
        if not any(_has(log, sensor) for sensor in senses()) and not has_heading(log):
            lacking = " and ".join(f"no {sensor}" for sensor in senses())
            expected = "one of them, or headings in the reference, from which wheels alone are calibrated"
            raise InputError(f"{log.name}: has {lacking}, expected {expected}")
        for sensor in senses():
            kinds = tuple(load(place) for place in channels()[sensor].streams)
            if sensor in log.streams and not isinstance(log.streams[sensor], kinds):
                raise InputError(f"{log.name}: its {sensor} is of another kind than that sensor's")
    first = logs[0]
    for log in logs[1:]:
        _check_alike(first, log)
    names = [log.name for log in logs]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise InputError(f"{twice}: is given twice, or two logs have this name")


def _check_alike(first: Log, log: Log) -> None:
    for sensor in senses():
        for one, other in ((first, log), (log, first)):
            if _has(one, sensor) and not _has(other, sensor):
                raise InputError(f"{other.name}: has no {sensor}, expected one in every log to calibrate from")
    for calibrator in calibrators().values():
        calibrator.check_alike(first, log)
    if has_heading(log) != has_heading(first):
        raise InputError(
            f"{log.name} and {first.name}: only one has headings in its reference; calibrate them separately"
        )


def _has(log: Log, sensor: str) -> bool:
    return sensor in log.streams and len(log.streams[sensor].t) > 0
