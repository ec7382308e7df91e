"""A complete rig from logs with reference poses: learn, make consistent, keep what pays, cross-validate."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from factorgraph_loc.calibration.consistency import Consistency, Evaluate, inflated, make_consistent
from factorgraph_loc.calibration.held_out import folds_of, recordings
from factorgraph_loc.calibration.judging import Judgement
from factorgraph_loc.calibration.learn import EXTEROCEPTIVE, Knowledge, has_heading, learn, sensing
from factorgraph_loc.calibration.selection import (
    MODEL,
    PLACES,
    SCATTER,
    STRENGTH,
    Bench,
    Learner,
    State,
    Unit,
    constants_of,
    dependents_of,
)
from factorgraph_loc.errors import InputError
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.landmarks.stream import BearingRangeStream
from factorgraph_loc.sensors.odometry.stream import IncrementStream, VelocityStream
from factorgraph_loc.sensors.rfid.calibration.learn import RfidKnowledge
from factorgraph_loc.sensors.rfid.calibration.tempering import tempered
from factorgraph_loc.sensors.rfid.settings import default_models
from factorgraph_loc.sensors.rfid.stream import RfidStream

Scores = Mapping[str, Any]
STEPS = 6  # that are told of progress


@dataclass(frozen=True)
class Calibration:
    """What came out.

    ``judgements``: what an estimator says of each learnt parameter; ``accepted``: what the rig has of it. ``knowledge``: what is
    learnt with those constants that it accepts. ``consistency``: of the landmark sensor with the EKF; ``rfid_consistency``: of the
    tempering with the smoother, with rigs learnt from the other logs where there are any; None without such a sensor. ``before``
    and ``after``: scores on each log with the input rig and the new one; ``held_out``: with a rig learnt from the other logs, but
    for the factor on the noise; empty where there are none. ``doubts``: one line each.
    """

    logs: tuple[str, ...]
    input_rig: Rig
    rig: Rig
    knowledge: Knowledge
    judgements: tuple[Judgement, ...]
    accepted: State
    consistency: Consistency | None
    rfid_consistency: Consistency | None
    before: tuple[Scores, ...]
    after: tuple[Scores, ...]
    held_out: tuple[Scores, ...]
    doubts: tuple[str, ...]

    def judgement(self, name: str) -> Judgement | None:
        """That of a parameter, by its name with the section's."""
        return next((one for one in self.judgements if name in one.names), None)

    def accepts(self, unit: Unit) -> bool:
        """Whether the rig has what was learnt of these parameters."""
        return unit in self.accepted


def calibrate(
    logs: Sequence[Log],
    evaluate: Evaluate,
    rig: Rig | None = None,
    progress: Callable[[float, float], None] | None = None,
    *,
    grids: Path | None = None,
) -> Calibration:
    """The rig that ``logs`` tell; what they do not tell, and what does not pay, is taken from ``rig``, else from that of the first
    log.

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
    search = _Search(logs, start, evaluate, grids)
    report(2, STEPS)
    search.make_consistent()
    report(3, STEPS)
    found = search.choose()
    report(4, STEPS)
    rig, knowledge = search.everyone.rig(found), search.knowledge
    unseen = search.unseen(found)
    held_out = tuple(evaluate(replace(log, rig=unseen[log.name])) for log in logs) if unseen else ()
    report(5, STEPS)
    after = before if before and rig == start else _scores(logs, rig, evaluate)
    report(6, STEPS)
    judgements = tuple(search.bench.judgements.values())
    return Calibration(
        logs=tuple(log.name for log in logs),
        input_rig=start,
        rig=rig,
        knowledge=_judged(knowledge, search.learnt, judgements),
        judgements=judgements,
        accepted=found,
        consistency=search.of_landmarks,
        rfid_consistency=search.of_rfid,
        before=before,
        after=after,
        held_out=held_out,
        doubts=_doubts(knowledge, search, found),
    )


class _Search:
    """What all logs tell, what each fold of them tells, and which of it an estimator accepts."""

    def __init__(self, logs: Sequence[Log], start: Rig, evaluate: Evaluate, grids: Path | None) -> None:
        self.logs, self.start, self._evaluate = logs, start, evaluate
        self.learnt = learn(logs, start, grids)
        kind = self.learnt.rfid.choice.kind if self.learnt.rfid is not None else None
        self.everyone = Learner(logs, start, grids, kind, self.learnt)
        self._folds = folds_of(logs)
        learners = [
            Learner(fold.train, start, _folder(grids, i), kind, shared=self.learnt)
            for i, fold in enumerate(self._folds)
        ]
        self.bench = Bench(self._folds, learners, evaluate)
        self.of_landmarks: Consistency | None = None
        self.of_rfid: Consistency | None = None

    @property
    def knowledge(self) -> Knowledge:
        """What all logs tell with the constants that are accepted."""
        assert self.everyone.knowledge is not None
        return self.everyone.knowledge

    @property
    def judges(self) -> bool:
        """Whether any fold could be learnt from: else nothing can be judged."""
        return any(
            one.knowledge is not None and fold.tests for one, fold in zip(self.bench.learners, self._folds, strict=True)
        )

    def make_consistent(self, *, landmarks: bool = True, rfid: bool = True) -> None:
        """Each sensor with honest noise, by runs without the other one. That of RFID, whose models have many parameters, is honest
        only on logs that these were not fitted to: with rigs that had no part of a log, if there are any. What is found holds for
        all folds: a search in each would take longer than all the rest."""
        rig, sensors = self.knowledge.rig, self.knowledge.rig.sensors

        def alone(rig: Rig, sensor: str) -> Rig:
            kept = tuple(name for name in sensors if name == sensor or name not in EXTEROCEPTIVE)
            return rig.model_copy(update={"sensors": kept})

        if "bearing_range" in sensors and landmarks:
            known = self.of_landmarks.trial.factor if self.of_landmarks and self.of_landmarks.trial else 3.0
            self.of_landmarks = make_consistent(self.logs, alone(rig, "bearing_range"), self._evaluate, known)
        if self.knowledge.rfid is not None and rfid:
            unseen = {
                log.name: alone(one.knowledge.rig, "rfid")
                for log, one in self._learners_of_others()
                if one.knowledge is not None
            }

            def held_out(log: Log) -> Scores:
                return self._evaluate(replace(log, rig=_tempered_as(unseen[log.name], log.rig)))

            guess = self.knowledge.rfid.share**-0.5
            # reads are not less alike than their scatter says, even if this estimator on these logs would bear it
            self.of_rfid = make_consistent(
                self.logs,
                alone(rig, "rfid"),
                held_out if len(unseen) == len(self.logs) else self._evaluate,
                guess,
                tempered,
                least=guess,
            )
        for learner in (self.everyone, *self.bench.learners):
            learner.noisy(self._honest)
        self.bench.forget()

    def choose(self) -> State:
        """The parameters that pay."""
        bench = self.bench
        constants, dependents = constants_of(self.learnt, self.start), dependents_of(self.learnt, self.start)
        # without them a sensor that the input rig does not know cannot be used at all
        forced = frozenset({SCATTER} & {*dependents} if self.start.bearing_range is None else ())
        dependents = [unit for unit in dependents if unit not in forced]
        if not self.judges:
            return forced
        state = bench.begun(frozenset(constants) | frozenset(dependents) | forced, forced)
        for unit in constants:
            state = bench.tried(state, unit)
        refused = frozenset(constants) - state
        if refused:
            accepted = [name for unit in state & frozenset(constants) for name in unit.names]
            for learner in (self.everyone, *bench.learners):
                learner.settle(accepted, placed=PLACES not in refused)
            self.make_consistent(
                landmarks=any(unit.section == "bearing_range" for unit in refused), rfid=PLACES in refused
            )
        for unit in dependents:
            state = bench.tried(state, unit)
        if not bench.better(state, forced):
            # together they are no better than the input rig: some of them may be
            left, state = state - forced, forced
            for unit in [*constants, *dependents]:
                if unit in left:
                    state = bench.tried(state, unit)
        rfid = self.knowledge.rig.rfid
        if rfid is not None and rfid.rssi is not None:
            state = bench.tried(state, STRENGTH)
        return state

    def unseen(self, state: State) -> dict[str, Rig]:
        """For each log the rig that other logs tell; empty if there are none."""
        return {log.name: learner.rig(state) for log, learner in self._learners_of_others()}

    def _learners_of_others(self) -> list[tuple[Log, Learner]]:
        parts = recordings(self.logs)
        if len(set(parts)) < 2:
            return []
        learners = {fold.part: one for fold, one in zip(self._folds, self.bench.learners, strict=True)}
        return [(log, learners[part]) for log, part in zip(self.logs, parts, strict=True)]

    def _honest(self, rig: Rig) -> Rig:
        """A rig with the factor, the tempering and the share of dead tags that were found."""
        if self.of_landmarks is not None and self.of_landmarks.trial and rig.bearing_range is not None:
            rig = inflated(rig, self.of_landmarks.trial.factor)
        if self.of_rfid is None or rig.rfid is None or self.learnt.rig.rfid is None:
            return rig
        share = {"dead_tags": self.learnt.rig.rfid.dead_tags}
        return _tempered_as(rig.model_copy(update={"rfid": rig.rfid.model_copy(update=share)}), self.of_rfid.rig)


def _folder(grids: Path | None, fold: int) -> Path | None:
    """The place of the grids of a fold."""
    if grids is None:
        return None
    folder = grids.parent / f"{grids.name}.fold{fold}"
    folder.mkdir()
    return folder / grids.name


def _tempered_as(rig: Rig, other: Rig) -> Rig:
    if rig.rfid is None or other.rfid is None:
        return rig
    return tempered(rig, other.rfid.tempering**-0.5)


def _judged(knowledge: Knowledge, learnt: Knowledge, judgements: Sequence[Judgement]) -> Knowledge:
    """``knowledge`` of what is accepted, with all constants that were ``learnt`` and what became of them."""
    found = {name: one for one in judgements for name in one.names}
    settled = {(c.sensor, c.name): c for c in knowledge.constants}
    constants = []
    for c in learnt.constants:
        judgement = found.get(f"{c.sensor}.{c.name}")
        if judgement is None:
            constants.append(replace(c, kept=False, why="refused: the logs are too short to judge it") if c.kept else c)
        elif judgement.accepted:
            constants.append(replace(settled[c.sensor, c.name], why=judgement.why))
        else:
            constants.append(replace(c, kept=False, why=judgement.why))
    return replace(knowledge, constants=tuple(constants), rfid=_judged_places(knowledge.rfid, found))


def _judged_places(rfid: RfidKnowledge | None, found: Mapping[str, Judgement]) -> RfidKnowledge | None:
    if rfid is None:
        return None
    (name,) = PLACES.names
    judgement = found.get(name)
    accepted = judgement is not None and judgement.accepted
    why = judgement.why if judgement is not None else "refused: the logs are too short to judge it"
    offsets = tuple(replace(o, kept=accepted, why=why) if o.kept else o for o in rfid.offsets)
    return replace(rfid, offsets=offsets)


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


def _doubts(knowledge: Knowledge, search: _Search, found: State) -> tuple[str, ...]:
    """What the reader of the report should look at."""
    doubts = list(knowledge.notes)
    if not search.judges:
        doubts.append(
            "The logs are too short to judge what was learnt on parts that had no part in it: nothing is changed."
        )
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
    for unit, one in ((SCATTER, search.of_landmarks), (MODEL, search.of_rfid)):
        if one is None or unit not in found:
            continue
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
