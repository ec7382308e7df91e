"""A complete rig from logs with reference poses: learn, make consistent, cross-validate."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from factorgraph_loc.calibration.consistency import Consistency, Evaluate, inflated, make_consistent
from factorgraph_loc.calibration.learn import Knowledge, has_heading, learn
from factorgraph_loc.calibration.windows import REFERENCE_GAP
from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.alignment import MAX_REFERENCE_GAP
from factorgraph_loc.log import BearingRangeStream, IncrementStream, Log, VelocityStream
from factorgraph_loc.rig import Rig
from factorgraph_loc.trajectory import Trajectory

Scores = Mapping[str, Any]


@dataclass(frozen=True)
class Calibration:
    """What came out.

    ``before`` and ``after``: scores of the EKF on each log with the input rig and with the new one; ``held_out``: with a rig learnt
    from the other logs, but for the factor on the noise; empty where there are none. ``doubts``: one line each.
    """

    logs: tuple[str, ...]
    input_rig: Rig
    rig: Rig
    knowledge: Knowledge
    consistency: Consistency
    before: tuple[Scores, ...]
    after: tuple[Scores, ...]
    held_out: tuple[Scores, ...]
    doubts: tuple[str, ...]


def calibrate(
    logs: Sequence[Log],
    evaluate: Evaluate,
    rig: Rig | None = None,
    progress: Callable[[float, float], None] | None = None,
) -> Calibration:
    """The rig that ``logs`` tell; what they do not tell is taken from ``rig``, else from the rig of the first log.

    ``evaluate`` runs the EKF on a log and scores it. ``progress`` is given the steps done and all steps.
    Raises InputError if a log lacks a reference, odometry, or sightings, is too short, or is of another type than the rest.
    """
    check(logs)
    report = progress or (lambda _done, _total: None)
    steps = 2 + (len(logs) if len(logs) > 1 else 0)
    start = rig or logs[0].rig
    logs = [_scorable(log) for log in logs]
    before = tuple(evaluate(replace(log, rig=start)) for log in logs)
    report(1, steps)
    knowledge = learn(logs, start)
    consistency = make_consistent(logs, knowledge.rig, evaluate)
    after = consistency.trial.scores if consistency.trial else _scores(logs, consistency.rig, evaluate)
    report(2, steps)
    held_out = []
    # one number is shared: a search in each fold would take longer than all the rest
    factor = consistency.trial.factor if consistency.trial else 1.0
    for i, log in enumerate(logs if len(logs) > 1 else ()):
        others = learn([*logs[:i], *logs[i + 1 :]], start).rig
        held_out.append(evaluate(replace(log, rig=inflated(others, factor))))
        report(3 + i, steps)
    return Calibration(
        logs=tuple(log.name for log in logs),
        input_rig=start,
        rig=consistency.rig,
        knowledge=knowledge,
        consistency=consistency,
        before=before,
        after=after,
        held_out=tuple(held_out),
        doubts=_doubts(knowledge, consistency),
    )


def check(logs: Sequence[Log]) -> None:
    """InputError if these logs cannot be calibrated together."""
    if not logs:
        raise InputError("there is no log to calibrate from")
    for log in logs:
        if log.reference is None or len(log.reference) < 2:
            raise InputError(f"{log.name}: has no reference, expected one to calibrate against")
        for sensor in ("odometry", "bearing_range"):
            if sensor not in log.streams or not len(log.streams[sensor].t):
                raise InputError(f"{log.name}: has no {sensor}, expected one in every log to calibrate from")
        if not isinstance(log.streams["bearing_range"], BearingRangeStream):
            raise InputError(f"{log.name}: its bearing_range holds no sightings of landmarks")
    first = logs[0]
    for log in logs[1:]:
        if type(log.streams["odometry"]) is not type(first.streams["odometry"]):
            kinds = {VelocityStream: "velocities", IncrementStream: "increments"}
            ours, theirs = (kinds.get(type(one.streams["odometry"]), "another kind") for one in (log, first))
            raise InputError(
                f"{log.name}: its odometry has {ours}, that of {first.name} {theirs}; expected logs of one robot type"
            )
        if has_heading(log) != has_heading(first):
            raise InputError(
                f"{log.name} and {first.name}: only one has headings in its reference; calibrate them apart"
            )
    names = [log.name for log in logs]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise InputError(f"{twice}: is given twice, or two logs have this name")


def _scores(logs: Sequence[Log], rig: Rig, evaluate: Evaluate) -> tuple[Scores, ...]:
    return tuple(evaluate(replace(log, rig=rig)) for log in logs)


def _scorable(log: Log) -> Log:
    """The log with a reference dense enough for scoring, where it can be interpolated."""
    reference = log.reference
    assert reference is not None
    if np.median(np.diff(reference.t)) <= MAX_REFERENCE_GAP + 1e-6:
        return log
    t = np.arange(reference.t[0], reference.t[-1], 0.99 * MAX_REFERENCE_GAP)
    poses = reference.at(t, max_gap=REFERENCE_GAP)
    good = np.isfinite(poses[:, 0])
    return replace(log, reference=Trajectory(t[good], poses[good], has_heading=reference.has_heading))


def _doubts(knowledge: Knowledge, consistency: Consistency) -> tuple[str, ...]:
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
    if consistency.trial is None:
        doubts.append("No log has a reference dense enough for scoring: the noise in the rig is the mere scatter.")
    elif not consistency.reached:
        doubts.append(
            f"No factor on the noise makes the EKF consistent: ANEES over its ideal value is {consistency.trial.causal:.2f} "
            f"causal, {consistency.trial.final:.2f} final."
        )
    return tuple(doubts)
