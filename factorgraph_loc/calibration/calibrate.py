"""Calibration of a complete rig: estimate it from logs with a reference, test it on held-out logs, and keep the input
rig if the estimated rig is worse."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from factorgraph_loc.calibration.held_out import Run, Trial, folds_of, refusal, trials_of
from factorgraph_loc.calibration.learn import Knowledge, has_heading, learn, learn_by_turns, senses, sensing
from factorgraph_loc.errors import InputError
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.measurement import are_alike
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.registry import moving
from factorgraph_loc.sensors.smoothed import Traced
from factorgraph_loc.text import Notice, listed, notice


@dataclass(frozen=True)
class Calibration:
    """The result of a calibration of a rig (the sensors of a robot, with mounting, constants and noise).

    ``logs``: names of the logs. ``input_rig``: the rig before the calibration.
    ``rig``: the learnt rig, or ``input_rig`` if the learnt rig is refused. ``refused``: the reason of the refusal, or
    "". ``knowledge``: the rig and the constants that are learnt from all logs.
    ``trials``: scores on held-out logs, empty if the logs have no reference or are too short. ``doubts``: warnings.
    """

    logs: tuple[str, ...]
    input_rig: Rig
    rig: Rig
    knowledge: Knowledge
    trials: tuple[Trial, ...]
    refused: str
    doubts: tuple[Notice, ...]


def calibrate(
    logs: Sequence[Log],
    run: Run,
    rig: Rig | None = None,
    progress: Callable[[float, float], None] | None = None,
    *,
    grids: Path | None = None,
) -> Calibration:
    """Return the calibration of a rig (the sensors of a robot): its constants learnt from ``logs``, and tested on
    held-out logs. If no log has a reference trajectory, smoothing and learning alternate, without a test.

    ``run(log, estimator)``: runs the named estimator on a log. ``rig``: its values are the means of the priors. None
    means the rig of the first log. ``progress``: called with the number of steps done and the number of all steps.
    ``grids``: path prefix of the files of learnt detection grids, required for logs with tag reads.

    Raises InputError if only some logs have a reference, or if a log is too short, lacks odometry, or has other
    sensors. A log needs exteroceptive measurements, or a reference with headings.
    """
    report = progress or (lambda _done, _total: None)
    blind = bool(logs) and all(log.reference is None for log in logs)
    check(logs, blind=blind)
    names, start = tuple(log.name for log in logs), sensing(rig or logs[0].rig, logs[0])
    if blind:
        knowledge = learn_by_turns(logs, start, lambda log: run(log, "smoother").result, grids, progress)
        return Calibration(names, start, knowledge.rig, knowledge, (), "", knowledge.notes)
    knowledge = learn([Traced(log) for log in logs], start, grids=grids)
    folds = folds_of(logs)
    report(1, len(folds) + 1)
    trials: list[Trial] = []
    for i, (train, tests) in enumerate(folds):
        with suppress(InputError):  # if these logs are too short
            prefix = None if grids is None else grids.with_name(f"{grids.name}.fold{i}")
            unseen = learn([Traced(log) for log in train], start, grids=prefix, like=knowledge).rig
            trials += trials_of(tests, start, unseen, run)
        report(i + 2, len(folds) + 1)
    refused = refusal(trials) if trials else "the logs are too short to hold out parts of them"
    doubts = [*knowledge.notes, *_map_warnings(trials)]
    if not has_heading(logs[0]):
        doubts.append(notice("no_headings", "The reference has no headings: only the range scale is learnt."))
    if len(logs) == 1:
        sentence = "One log does not show differences between runs: the uncertainties are those of the input rig."
        doubts.append(notice("one_log", sentence))
    if refused:
        doubts.append(notice("refused", "The input rig is kept: {why}.", refused))
    return Calibration(
        names, start, start if refused else knowledge.rig, knowledge, tuple(trials), refused, tuple(doubts)
    )


def _map_warnings(trials: Sequence[Trial]) -> list[Notice]:
    """Return a warning for each kind of error in the map, such as moved tags, with all names from the held-out logs."""
    doubted: dict[str, dict[str, None]] = {}
    for trial in trials:
        for kind, names in trial.doubted.items() if trial.estimator == "smoother" else ():
            doubted.setdefault(kind, {}).update(dict.fromkeys(names))
    sentence = "The smoother doubts the map on held-out logs: {kind} {names}."
    return [notice(kind, sentence, kind.replace("_", " "), listed(names)) for kind, names in doubted.items() if names]


def check(logs: Sequence[Log], *, blind: bool = False) -> None:
    """Raise InputError if ``logs`` cannot be calibrated together. The logs must have odometry, measurements, equal
    sensors and, unless ``blind`` is True, a reference trajectory."""
    if not logs:
        raise InputError("there is no log to calibrate from")
    for log in logs:
        if not blind and (log.reference is None or len(log.reference) < 2):
            more = "; calibrate logs without a reference separately" if len(logs) > 1 else ""
            raise InputError(f"{log.name}: has no reference, expected one to calibrate against{more}")
        if not any(_has(log, name) for name in moving(log.streams)):
            raise InputError(f"{log.name}: has no odometry, expected odometry in every log to calibrate from")
        if not any(_has(log, sensor) for sensor in senses(log.rig)) and not has_heading(log):
            lacking = " or ".join(senses(log.rig)) or "a sensor other than odometry"
            raise InputError(
                f"{log.name}: has no measurements of {lacking}, expected some, or headings in the reference to calibrate the wheels"
            )
        _check_alike(logs[0], log)
    names = [log.name for log in logs]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise InputError(f"{twice}: is given twice, or two logs have this name")


def _check_alike(first: Log, log: Log) -> None:
    """Raise InputError if two logs differ in sensors, in the kinds of streams, or in having reference headings."""
    for sensor in senses(first.rig):
        for one_log, other_log in ((first, log), (log, first)):
            if _has(one_log, sensor) and not _has(other_log, sensor):
                raise InputError(
                    f"{other_log.name}: has no {sensor}, expected it in every log, because {one_log.name} has it"
                )
    for name, stream in log.streams.items():
        if name in first.streams and not are_alike(first.streams[name], stream):
            kinds = f"{type(stream).__name__}, but in {first.name} it is {type(first.streams[name]).__name__}"
            raise InputError(f"{log.name}: the type of {name} is {kinds}: calibrate these logs separately")
    if has_heading(log) != has_heading(first):
        raise InputError(
            f"{log.name} and {first.name}: only one has headings in its reference: calibrate these logs separately"
        )


def _has(log: Log, sensor: str) -> bool:
    """True if a log has measurements of a sensor."""
    return sensor in log.streams and len(log.streams[sensor].t) > 0
