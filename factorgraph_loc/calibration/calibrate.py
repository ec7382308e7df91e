"""A complete rig from logs with reference poses: learn, make consistent, keep what pays, cross-validate."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from factorgraph_loc.calibration.consistency import FACTORS, Consistency, Evaluate, make_consistent
from factorgraph_loc.calibration.held_out import folds_of, recordings
from factorgraph_loc.calibration.judging import Judgement
from factorgraph_loc.calibration.learn import Knowledge, calibrators, has_heading, learn, senses, sensing
from factorgraph_loc.calibration.selection import Bench, Learner, constants_of, dependents_of
from factorgraph_loc.errors import InputError
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.plugins import load
from factorgraph_loc.sensors.calibrating import Calibrator, State, Told
from factorgraph_loc.sensors.registry import channels, moving

Scores = Mapping[str, Any]
STEPS = 6  # that are told of progress


@dataclass(frozen=True)
class Calibration:
    """What came out.

    ``judgements``: what an estimator says of each learnt parameter; ``accepted``: what the rig has of it. ``knowledge``: what is
    learnt with those constants that it accepts. ``consistency``: of the noise of sensors, by their names: of landmarks with the
    EKF, of the tempering of RFID with the smoother, with rigs learnt from the other logs where there are any. ``before`` and
    ``after``: scores on each log with the input rig and the new one; ``held_out``: with a rig learnt from the other logs, but
    for the factor on the noise; empty where there are none. ``doubts``: one line each.
    """

    logs: tuple[str, ...]
    input_rig: Rig
    rig: Rig
    knowledge: Knowledge
    judgements: tuple[Judgement, ...]
    accepted: State
    consistency: Mapping[str, Consistency]
    before: tuple[Scores, ...]
    after: tuple[Scores, ...]
    held_out: tuple[Scores, ...]
    doubts: tuple[str, ...]

    def judgement(self, name: str) -> Judgement | None:
        """That of a parameter, by its name with the section's."""
        return next((one for one in self.judgements if name in one.names), None)

    def told(self) -> Iterator[tuple[Calibrator, Told]]:
        """What is told of each sensor."""
        for name, calibrator in calibrators().items():
            found, details = (part.get(name) for part in (self.knowledge.found, self.knowledge.details))
            consistency = self.consistency.get(name)
            trial = consistency.trial if consistency is not None else None
            yield calibrator, Told(self.logs, found, details, self.knowledge.rig, self.rig, trial, self.accepted)


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
        consistency=search.consistent,
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
        self.everyone = Learner(logs, start, grids, self.learnt)
        self._folds = folds_of(logs)
        learners = [
            Learner(fold.train, start, _folder(grids, i), shared=self.learnt) for i, fold in enumerate(self._folds)
        ]
        self.bench = Bench(self._folds, learners, evaluate)
        self.consistent: dict[str, Consistency] = {}

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

    def make_consistent(self, names: Collection[str] | None = None) -> None:
        """Each sensor, or those of ``names``, with honest noise, by runs without the others. That of one whose models have many
        parameters is honest only on logs that these were not fitted to: with rigs that had no part of a log, if there are any.
        What is found holds for all folds: a search in each would take longer than all the rest."""
        for name, found in self.knowledge.found.items():
            if calibrators()[name].is_consistent and (names is None or name in names):
                self.consistent[name] = self._made_consistent(name, found)
        for learner in (self.everyone, *self.bench.learners):
            learner.noisy(self._honest)
        self.bench.forget()

    def _made_consistent(self, name: str, found: Any) -> Consistency:
        one, rig = calibrators()[name], self.knowledge.rig

        def alone(rig: Rig) -> Rig:
            kept = tuple(n for n in self.knowledge.rig.sensors if n == one.channel or n not in senses())
            return rig.model_copy(update={"sensors": kept})

        others = self._learners_of_others() if one.judged_unseen else []
        unseen = {log.name: alone(o.knowledge.rig) for log, o in others if o.knowledge is not None}

        def held_out(log: Log) -> Scores:
            return self._evaluate(replace(log, rig=one.as_honest_as(unseen[log.name], log.rig)))

        before = self.consistent.get(name)
        guess, least = one.guess(found), one.least(found)
        if least is None:
            guess = before.trial.factor if before is not None and before.trial is not None else guess
        evaluate = held_out if len(unseen) == len(self.logs) else self._evaluate
        return make_consistent(
            self.logs, alone(rig), evaluate, guess, one.inflated, FACTORS[0] if least is None else least
        )

    def choose(self) -> State:
        """The parameters that pay."""
        bench = self.bench
        constants, dependents = constants_of(self.learnt, self.start), dependents_of(self.learnt, self.start)
        # without them a sensor that the input rig does not know cannot be used at all
        needed = [one for one in calibrators().values() if getattr(self.start, one.section) is None]
        forced = frozenset({unit for one in needed for unit in one.noise} & {*dependents})
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
                learner.settle(accepted)
            sections = {unit.section for unit in refused}
            self.make_consistent([name for name, one in calibrators().items() if one.section in sections])
        for unit in dependents:
            state = bench.tried(state, unit)
        if not bench.better(state, forced):
            # together they are no better than the input rig: some of them may be
            left, state = state - forced, forced
            for unit in [*constants, *dependents]:
                if unit in left:
                    state = bench.tried(state, unit)
        for unit in (unit for one in calibrators().values() for unit in one.optional(self.knowledge.rig)):
            state = bench.tried(state, unit)
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
        """A rig with the noise that was found."""
        for name, found in self.consistent.items():
            factor = None if found.trial is None else found.trial.factor
            rig = calibrators()[name].honest(rig, factor, found.rig, self.learnt.rig)
        return rig


def _folder(grids: Path | None, fold: int) -> Path | None:
    """The place of the grids of a fold."""
    if grids is None:
        return None
    folder = grids.parent / f"{grids.name}.fold{fold}"
    folder.mkdir()
    return folder / grids.name


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
    parts = {name: calibrators()[name].judged(one, found) for name, one in knowledge.found.items()}
    return replace(knowledge, constants=tuple(constants), found=parts)


def _is_complete(rig: Rig) -> bool:
    """Whether a rig has what its sensors need, learnt or stated."""
    return all(one.is_complete(rig) for one in calibrators().values())


def estimator_for(rig: Rig) -> str:
    """The estimator that judges what is learnt of the sensors of a rig."""
    named = [one.estimator for one in calibrators().values() if one.estimator and one.channel in rig.sensors]
    return named[0] if named else "ekf"


def check(logs: Sequence[Log]) -> None:
    """InputError if these logs cannot be calibrated together."""
    if not logs:
        raise InputError("there is no log to calibrate from")
    for log in logs:
        if log.reference is None or len(log.reference) < 2:
            raise InputError(f"{log.name}: has no reference, expected one to calibrate against")
        if not any(_has(log, name) for name in moving(log.streams, "floor")):
            raise InputError(f"{log.name}: has no odometry, expected one in every log to calibrate from")
        if not any(_has(log, sensor) for sensor in senses()):
            lacking = " and ".join(f"no {sensor}" for sensor in senses())
            raise InputError(f"{log.name}: has {lacking}, expected one of them to calibrate from")
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
    for name, calibrator in calibrators().items():
        one = search.consistent.get(name)
        if one is not None and found.intersection(calibrator.noise + calibrator.models):
            if one.trial is None:
                doubts.append(
                    "No log has enough poses of a reference to score: the noise in the rig is the mere scatter."
                )
            elif not one.reached:
                doubts.append(
                    "No factor on the noise makes the estimator consistent: ANEES over its ideal value is "
                    f"{one.trial.causal:.2f} causal, {one.trial.final:.2f} final."
                )
        doubts += calibrator.doubts(knowledge.found.get(name), knowledge.details.get(name))
    return tuple(doubts)
