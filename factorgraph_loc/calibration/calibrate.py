"""Calibration of a complete rig: learn, make consistent, select by cross-validation."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from factorgraph_loc.calibration.consistency import FACTORS, Consistency, Evaluate, make_consistent
from factorgraph_loc.calibration.held_out import folds_of, recordings
from factorgraph_loc.calibration.judging import Judgement
from factorgraph_loc.calibration.learn import Knowledge, calibrators, has_heading, learn, senses, sensing
from factorgraph_loc.calibration.selection import Bench, Learner, constants_of, dependents_of
from factorgraph_loc.calibration.turns import Smooth, learn_by_turns
from factorgraph_loc.errors import InputError
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.plugins import load
from factorgraph_loc.sensors.calibrating import Calibrator, State, Told
from factorgraph_loc.sensors.registry import channels, moving

Scores = Mapping[str, Any]
GUESS = 3.0  # initial noise factor
STEPS = 6  # steps of which progress is reported


@dataclass(frozen=True)
class Calibration:
    """Result of a calibration.

    ``judgements``: the estimator's verdict on each learnt parameter; ``accepted``: those that the rig contains. ``knowledge``:
    what was learnt, with the accepted constants only. ``consistency``: of each sensor's noise, by sensor (landmarks with the
    EKF, the tempering of RFID with the smoother), from rigs learnt from the other logs where there are any. ``before`` and
    ``after``: scores on each log with the input rig and the new rig; ``held_out``: with a rig learnt from the other logs,
    except for the factor on the noise; empty for a single log. ``doubts``: warnings, one line each. ``turns``: for logs without
    a reference, by how many standard errors each turn changed what was learnt; nothing is judged and scored then.
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
    turns: tuple[float, ...] = ()

    def judgement(self, name: str) -> Judgement | None:
        """The judgement of a parameter, named ``section.parameter``; None if it was not judged."""
        return next((one for one in self.judgements if name in one.names), None)

    def told(self) -> Iterator[tuple[Calibrator, Told]]:
        """The results of each sensor, for the report."""
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
    smooth: Smooth | None = None,
    grids: Path | None = None,
) -> Calibration:
    """Calibrate a rig from ``logs``. Values that the logs do not determine, or that do not improve the estimator, come from
    ``rig``, by default that of the first log.

    ``evaluate`` runs an estimator on a log, with the sensors of the log's rig, and returns its scores. ``smooth`` runs the
    smoother: if no log has a reference, smoothing and learning take turns. ``progress`` is called
    with the number of steps done and of all steps. ``grids``: path prefix of the files of learnt detection grids; needed for
    logs with tag reads. Raises InputError if a log lacks a reference or odometry, has neither exteroceptive measurements nor a
    reference with headings, is too short, or differs in kind from the others.
    """
    if smooth is not None and logs and all(log.reference is None for log in logs):
        return _by_turns(logs, rig, smooth, progress, grids)
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


def _by_turns(
    logs: Sequence[Log],
    rig: Rig | None,
    smooth: Smooth,
    progress: Callable[[float, float], None] | None,
    grids: Path | None,
) -> Calibration:
    """Calibrate from logs without a reference."""
    check_together(logs)
    start = sensing(rig or logs[0].rig, logs[0])
    turns = learn_by_turns(logs, start, smooth, grids, progress)
    return Calibration(
        logs=tuple(log.name for log in logs),
        input_rig=start,
        rig=turns.knowledge.rig,
        knowledge=turns.knowledge,
        judgements=(),
        accepted=frozenset(),
        consistency={},
        before=(),
        after=(),
        held_out=(),
        doubts=turns.doubts,
        turns=turns.changed,
    )


class _Search:
    """What is learnt from all logs and from each fold, and which parameters the estimator accepts."""

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
        """What is learnt from all logs with the accepted constants."""
        assert self.everyone.knowledge is not None
        return self.everyone.knowledge

    @property
    def judges(self) -> bool:
        """Whether any fold could be learnt from, as is needed to judge parameters."""
        return any(
            one.knowledge is not None and fold.tests for one, fold in zip(self.bench.learners, self._folds, strict=True)
        )

    def make_consistent(self, names: Collection[str] | None = None) -> None:
        """Adjust the noise of each sensor, or of ``names``, for consistency, in runs without the other sensors.

        Where a sensor's models have many parameters, this uses rigs that were learnt without the log they are run on, if there
        are any. The result is used for all folds, since a search in each would dominate the run time.
        """
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

        others = self._learners_of_others() if one.models else []
        unseen = {log.name: alone(o.knowledge.rig) for log, o in others if o.knowledge is not None}

        def held_out(log: Log) -> Scores:
            return self._evaluate(replace(log, rig=one.honest(unseen[log.name], None, log.rig, unseen[log.name])))

        before = self.consistent.get(name)
        least = one.least(found)
        guess = GUESS if least is None else least
        if least is None and before is not None and before.trial is not None:
            guess = before.trial.factor
        evaluate = held_out if len(unseen) == len(self.logs) else self._evaluate
        return make_consistent(
            self.logs, alone(rig), evaluate, guess, one.inflated, FACTORS[0] if least is None else least
        )

    def choose(self) -> State:
        """Select the parameters that improve the estimator."""
        bench = self.bench
        constants, dependents = constants_of(self.learnt, self.start), dependents_of(self.learnt, self.start)
        # a sensor that the input rig lacks cannot be used without them
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
            # together they do not improve the input rig, but some of them may
            left, state = state - forced, forced
            for unit in [*constants, *dependents]:
                if unit in left:
                    state = bench.tried(state, unit)
        for unit in (unit for one in calibrators().values() for unit in one.optional(self.knowledge.rig)):
            state = bench.tried(state, unit)
        return state

    def unseen(self, state: State) -> dict[str, Rig]:
        """For each log, the rig learnt from the other logs; empty for a single log."""
        return {log.name: learner.rig(state) for log, learner in self._learners_of_others()}

    def _learners_of_others(self) -> list[tuple[Log, Learner]]:
        parts = recordings(self.logs)
        if len(set(parts)) < 2:
            return []
        learners = {fold.part: one for fold, one in zip(self._folds, self.bench.learners, strict=True)}
        return [(log, learners[part]) for log, part in zip(self.logs, parts, strict=True)]

    def _honest(self, rig: Rig) -> Rig:
        """``rig`` with the adjusted noise."""
        for name, found in self.consistent.items():
            factor = None if found.trial is None else found.trial.factor
            rig = calibrators()[name].honest(rig, factor, found.rig, self.learnt.rig)
        return rig


def _folder(grids: Path | None, fold: int) -> Path | None:
    """The path prefix of a fold's grids."""
    if grids is None:
        return None
    folder = grids.parent / f"{grids.name}.fold{fold}"
    folder.mkdir()
    return folder / grids.name


def _judged(knowledge: Knowledge, learnt: Knowledge, judgements: Sequence[Judgement]) -> Knowledge:
    """``knowledge`` of what is accepted, listing all constants that were ``learnt`` with the verdict on each."""
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
    """Whether a rig has all settings that its sensors need."""
    return all(one.is_complete(rig) for one in calibrators().values())


def estimator_for(rig: Rig) -> str:
    """The name of the estimator that judges what is learnt for a rig."""
    named = [one.estimator for one in calibrators().values() if one.estimator and one.channel in rig.sensors]
    return named[0] if named else "ekf"


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


def _scores(logs: Sequence[Log], rig: Rig, evaluate: Evaluate) -> tuple[Scores, ...]:
    return tuple(evaluate(replace(log, rig=rig)) for log in logs)


def _doubts(knowledge: Knowledge, search: _Search, found: State) -> tuple[str, ...]:
    """Warnings for the reader of the report."""
    doubts = list(knowledge.notes)
    if not search.judges:
        doubts.append("The logs are too short to hold out parts for judging what was learnt: nothing is changed.")
    for name, calibrator in calibrators().items():
        one = search.consistent.get(name)
        if one is not None and found.intersection(calibrator.noise + calibrator.models):
            if one.trial is None:
                doubts.append(
                    "No log has enough poses of a reference to score: the noise in the rig is the scatter of the residuals."
                )
            elif not one.reached:
                doubts.append(
                    "No factor on the noise makes the estimator consistent: ANEES over its ideal value is "
                    f"{one.trial.causal:.2f} causal, {one.trial.final:.2f} final."
                )
        doubts += calibrator.doubts(knowledge.found.get(name), knowledge.details.get(name))
    return tuple(doubts)
