"""A complete rig from logs with reference poses: learn, make consistent, cross-validate."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from factorgraph_loc.calibration.consistency import Consistency, Evaluate, inflated, make_consistent
from factorgraph_loc.calibration.learn import EXTEROCEPTIVE, Knowledge, has_heading, learn, sensing
from factorgraph_loc.calibration.rfid_rounds import distinct
from factorgraph_loc.calibration.rfid_tempering import tempered
from factorgraph_loc.errors import InputError
from factorgraph_loc.log import BearingRangeStream, IncrementStream, Log, RfidStream, VelocityStream
from factorgraph_loc.rfid_settings import default_models
from factorgraph_loc.rig import Rig

Scores = Mapping[str, Any]
STEPS = 5  # that are told of progress


@dataclass(frozen=True)
class Calibration:
    """What came out.

    ``consistency``: of the landmark sensor with the EKF; ``rfid_consistency``: of the tempering with the smoother, with rigs learnt
    from the other logs where there are any; None without such a sensor. ``before`` and ``after``: scores on each log with the input
    rig and the new one; ``held_out``: with a rig learnt from the other logs, but for the factor on the noise; empty where there are
    none. ``doubts``: one line each.
    """

    logs: tuple[str, ...]
    input_rig: Rig
    rig: Rig
    knowledge: Knowledge
    consistency: Consistency | None
    rfid_consistency: Consistency | None
    before: tuple[Scores, ...]
    after: tuple[Scores, ...]
    held_out: tuple[Scores, ...]
    doubts: tuple[str, ...]


def calibrate(
    logs: Sequence[Log],
    evaluate: Evaluate,
    rig: Rig | None = None,
    progress: Callable[[float, float], None] | None = None,
    *,
    grids: Path | None = None,
) -> Calibration:
    """The rig that ``logs`` tell; what they do not tell is taken from ``rig``, else from the rig of the first log.

    ``evaluate`` runs an estimator on a log, with the sensors of the log's rig, and scores it. ``progress`` is given the steps done
    and all steps. ``grids``: path and beginning of the names of learnt grids, in a folder that lasts; for logs with reads of tags.
    Raises InputError if a log lacks a reference, odometry, or sightings and reads, is too short, or is of another type than the
    rest.
    """
    check(logs)
    report = progress or (lambda _done, _total: None)
    start = sensing(rig or logs[0].rig, logs[0])
    before = _scores(logs, start, evaluate) if _is_complete(start) else ()
    report(1, STEPS)
    knowledge = learn(logs, start, grids)
    folds = _folds(logs, start, knowledge, grids) if len(set(_parts(logs))) > 1 else []
    report(2, STEPS)
    rig, consistency, of_rfid = _consistent(logs, knowledge, folds, evaluate)
    # numbers that are searched with an estimator are shared: a search in each fold would take longer than all the rest
    folds = [_with_noise(fold, rig, consistency) for fold in folds]
    report(3, STEPS)
    searches = [one for one in (consistency, of_rfid) if one is not None]
    known = searches[0].trial.scores if len(searches) == 1 and searches[0].trial else None
    of_folds = of_rfid is not None and bool(folds)
    after = known if known and not of_folds else _scores(logs, rig, evaluate)
    report(4, STEPS)
    held_out = (
        known
        if known and of_folds
        else tuple(evaluate(replace(log, rig=fold)) for log, fold in zip(logs, folds, strict=False))
    )
    report(5, STEPS)
    return Calibration(
        logs=tuple(log.name for log in logs),
        input_rig=start,
        rig=rig,
        knowledge=knowledge,
        consistency=consistency,
        rfid_consistency=of_rfid,
        before=before,
        after=after,
        held_out=held_out,
        doubts=_doubts(knowledge, searches),
    )


def _consistent(
    logs: Sequence[Log], knowledge: Knowledge, folds: Sequence[Rig], evaluate: Evaluate
) -> tuple[Rig, Consistency | None, Consistency | None]:
    """Each sensor with honest noise, by runs without the other one. That of RFID, whose models have many parameters, is honest
    only on logs that these were not fitted to: with the rig of ``folds``, if there are any, that had no part of a log."""
    rig, sensors = knowledge.rig, knowledge.rig.sensors

    def alone(rig: Rig, sensor: str) -> Rig:
        kept = tuple(name for name in sensors if name == sensor or name not in EXTEROCEPTIVE)
        return rig.model_copy(update={"sensors": kept})

    of_landmarks = of_rfid = None
    if "bearing_range" in sensors:
        of_landmarks = make_consistent(logs, alone(rig, "bearing_range"), evaluate)
        rig = rig.model_copy(update={"bearing_range": of_landmarks.rig.bearing_range})
    if knowledge.rfid is not None:
        unseen = {log.name: alone(fold, "rfid") for log, fold in zip(logs, folds, strict=False)}

        def held_out(log: Log) -> Scores:
            return evaluate(replace(log, rig=_tempered_as(unseen[log.name], log.rig)))

        guess = knowledge.rfid.share**-0.5
        # reads are not less alike than their scatter says, even if this estimator on these logs would bear it
        of_rfid = make_consistent(
            logs, alone(rig, "rfid"), held_out if unseen else evaluate, guess, tempered, least=guess
        )
        rig = rig.model_copy(update={"rfid": of_rfid.rig.rfid})
    return rig, of_landmarks, of_rfid


def _with_noise(fold: Rig, rig: Rig, of_landmarks: Consistency | None) -> Rig:
    """The rig of a fold with what was searched for with all logs."""
    if of_landmarks is not None and of_landmarks.trial:
        fold = inflated(fold, of_landmarks.trial.factor)
    return _tempered_as(fold, rig)


def _tempered_as(rig: Rig, other: Rig) -> Rig:
    if rig.rfid is None or other.rfid is None:
        return rig
    return tempered(rig, other.rfid.tempering**-0.5)


def _folds(logs: Sequence[Log], start: Rig, knowledge: Knowledge, grids: Path | None) -> list[Rig]:
    """For each log the rig that the others tell; RFID's models are fitted in the way that was chosen with all."""
    parts = _parts(logs)
    out = []
    for i, part in enumerate(parts):
        others = [log for log, p in zip(logs, parts, strict=True) if p != part]
        if knowledge.rfid is None or grids is None:
            out.append(learn(others, start).rig)
            continue
        folder = grids.parent / f"{grids.name}.fold{i}"
        folder.mkdir()
        out.append(learn(others, start, folder / grids.name, knowledge.rfid.choice.kind).rig)
    return out


def _parts(logs: Sequence[Log]) -> list[int]:
    """The number of what each log recorded: of logs that hold the same reads one is no test of the other."""
    return distinct(logs) if "rfid" in logs[0].streams else list(range(len(logs)))


def _is_complete(rig: Rig) -> bool:
    """Whether a rig has what its sensors need, learnt or stated: with the default model of detection a run tells nothing."""
    given = rig.rfid is None or rig.rfid.models != default_models()
    return given and all(getattr(rig, name) is not None for name in EXTEROCEPTIVE if name in rig.sensors)


def check(logs: Sequence[Log]) -> None:
    """InputError if these logs cannot be calibrated together."""
    if not logs:
        raise InputError("there is no log to calibrate from")
    for log in logs:
        if log.reference is None or len(log.reference) < 2:
            raise InputError(f"{log.name}: has no reference, expected one to calibrate against")
        if not _has(log, "odometry"):
            raise InputError(f"{log.name}: has no odometry, expected one in every log to calibrate from")
        if not any(_has(log, sensor) for sensor in EXTEROCEPTIVE):
            raise InputError(f"{log.name}: has no bearing_range and no rfid, expected one of them to calibrate from")
        for sensor, kind in (("bearing_range", BearingRangeStream), ("rfid", RfidStream)):
            if sensor in log.streams and not isinstance(log.streams[sensor], kind):
                raise InputError(f"{log.name}: its {sensor} is of another kind than that sensor's")
    first = logs[0]
    for log in logs[1:]:
        _check_alike(first, log)
    names = [log.name for log in logs]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise InputError(f"{twice}: is given twice, or two logs have this name")


def _check_alike(first: Log, log: Log) -> None:
    for sensor in EXTEROCEPTIVE:
        for one, other in ((first, log), (log, first)):
            if _has(one, sensor) and not _has(other, sensor):
                raise InputError(f"{other.name}: has no {sensor}, expected one in every log to calibrate from")
    if type(log.streams["odometry"]) is not type(first.streams["odometry"]):
        kinds = {VelocityStream: "velocities", IncrementStream: "increments"}
        ours, theirs = (kinds.get(type(one.streams["odometry"]), "another kind") for one in (log, first))
        raise InputError(
            f"{log.name}: its odometry has {ours}, that of {first.name} {theirs}; expected logs of one robot type"
        )
    if has_heading(log) != has_heading(first):
        raise InputError(f"{log.name} and {first.name}: only one has headings in its reference; calibrate them apart")


def _has(log: Log, sensor: str) -> bool:
    return sensor in log.streams and len(log.streams[sensor].t) > 0


def _scores(logs: Sequence[Log], rig: Rig, evaluate: Evaluate) -> tuple[Scores, ...]:
    return tuple(evaluate(replace(log, rig=rig)) for log in logs)


def _doubts(knowledge: Knowledge, searches: Sequence[Consistency]) -> tuple[str, ...]:
    """What the reader of the report should look at."""
    doubts = list(knowledge.notes)
    noise = knowledge.noise
    if noise is not None and noise.outliers > 0.05:
        doubts.append(
            f"{100.0 * noise.outliers:.0f} % of the odometry windows are outliers: slip, collisions, or gaps in the reference?"
        )
    if noise is not None and noise.floored:
        doubts.append(
            f"The fitted noise of the odometry ({', '.join(noise.floored)}) is below what wheels can do and was raised: the "
            "reference is probably not independent of the odometry."
        )
    for one in searches:
        if one.trial is None:
            doubts.append("No log has enough poses of a reference to score: the noise in the rig is the mere scatter.")
        elif not one.reached:
            doubts.append(
                "No factor on the noise makes the estimator consistent: ANEES over its ideal value is "
                f"{one.trial.causal:.2f} causal, {one.trial.final:.2f} final."
            )
    if knowledge.rfid is not None:
        for tag in knowledge.rfid.doubts:
            doubts.append(f"Tag {tag.name} seems to be {tag.distance:.1f} m from where the map has it.")
        if silent := knowledge.rfid.dead.tags:
            believed = knowledge.rfid.dead.believed
            names = f"; believed dead, as they should have been: {', '.join(believed)}" if believed else ""
            doubts.append(f"{len(silent)} tags of the map are never read{names}.")
    return tuple(doubts)
