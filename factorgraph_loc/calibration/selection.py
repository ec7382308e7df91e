"""Which of the learnt parameters pay: an estimator runs with and without each on stretches that had no part in what was learnt.

The search is greedy. It begins with all that was learnt, or, where that is no better than the input rig, with the input rig and
what is learnt of one sensor after the other. Then the parameters are tried one after another, with and without, those first that
the fits gain least by, and last what depends on them: noise, uncertainty, models of detection, learnt anew for the constants that
remain.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from factorgraph_loc.calibration.held_out import Fold
from factorgraph_loc.calibration.judging import Judgement, Outcome, judged
from factorgraph_loc.calibration.learn import Knowledge, calibrators, has_heading, learn, settled
from factorgraph_loc.errors import InputError, RunFailedError
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.calibrating import State, Unit


def constants_of(knowledge: Knowledge, start: Rig) -> list[Unit]:
    """Of the constants that the fits would keep, those that gain least in the fits first; then what no fit can tell the gain of."""
    units: dict[Unit, float] = {}
    for name, found in knowledge.found.items():
        calibrator = calibrators()[name]
        kept = [c for c in knowledge.constants if c.kept and c.sensor == calibrator.section]
        units |= calibrator.constant_units(found, kept, knowledge.rig, start)
    return sorted(units, key=units.__getitem__)


def dependents_of(knowledge: Knowledge, start: Rig) -> list[Unit]:
    """What is learnt for the constants that remain, without what is tried last."""
    used = [calibrators()[name] for name in knowledge.found]
    units = [unit for one in used for unit in one.noise]
    for one in used:
        old, new = one.settings(start), getattr(knowledge.rig, one.section)
        if one.uncertain and new is not None and new.uncertainty != old.uncertainty:
            units.append(Unit(one.section, ("uncertainty",)))
    return [*units, *(unit for one in used for unit in one.models)]


def mixed(old: Rig, new: Rig, state: State) -> Rig:
    """The rig with what is ``new`` of the parameters in ``state``, and ``old`` of the others."""
    changes: dict[str, Any] = {}
    for calibrator in calibrators().values():
        changes |= calibrator.mixed(old, new, state)
    return old.model_copy(update=changes)


class Learner:
    """What some logs tell, with all parameters free or with some of them held at the values of ``start``.

    ``grids``: see :func:`~factorgraph_loc.calibration.learn.learn`; ``shared``: what all logs tell, also for the uncertainties,
    which a single log does not tell. Learns nothing from logs that are too short.
    """

    def __init__(
        self,
        logs: Sequence[Log],
        start: Rig,
        grids: Path | None,
        knowledge: Knowledge | None = None,
        shared: Knowledge | None = None,
    ) -> None:
        self._logs, self._start = list(logs), start
        # a single log, and one recording without a part of it, do not tell what differs between runs
        self._by_log = shared is None or len(logs) > 1
        self._shared = None if self._by_log else shared
        self._all: Knowledge | None = None
        with suppress(InputError):  # too short
            self._all = knowledge or learn(logs, start, grids, shared, by_log=self._by_log)
        self.knowledge = self._all
        self._change: Callable[[Rig], Rig] = lambda rig: rig

    def settle(self, accepted: Iterable[str]) -> None:
        """Learn anew with these constants alone."""
        if self._all is not None:
            self.knowledge = settled(self._all, self._logs, self._start, frozenset(accepted), by_log=self._by_log)

    def noisy(self, change: Callable[[Rig], Rig]) -> None:
        """From now on with the noise that ``change`` makes of what is learnt."""
        self._change = change

    def rig(self, state: State) -> Rig:
        """The input rig with what was learnt of the parameters in ``state``."""
        if self.knowledge is None:
            return self._start
        new = self.knowledge.rig
        if self._shared is not None:
            new = _with_uncertainty(new, self._shared.rig)
        return mixed(self._start, self._change(new), state)


def _with_uncertainty(rig: Rig, other: Rig) -> Rig:
    changes = {
        one.section: getattr(rig, one.section).model_copy(
            update={"uncertainty": getattr(other, one.section).uncertainty}
        )
        for one in calibrators().values()
        if one.uncertain and getattr(rig, one.section) is not None and getattr(other, one.section) is not None
    }
    return rig.model_copy(update=changes)


class Bench:
    """Runs an estimator on the stretches of ``folds``, each with what its learner tells of some parameters."""

    def __init__(
        self, folds: Sequence[Fold], learners: Sequence[Learner], evaluate: Callable[[Log], Mapping[str, Any]]
    ) -> None:
        self._folds, self.learners, self._evaluate = folds, learners, evaluate
        self._known: dict[State, Outcome] = {}
        self.judgements: dict[Unit, Judgement] = {}

    def forget(self) -> None:
        """What was learnt has changed."""
        self._known = {}

    def outcome(self, state: State) -> Outcome:
        """With the parameters of ``state``."""
        if state not in self._known:
            tests = [
                replace(test, rig=_usable(learner.rig(state), state))
                for fold, learner in zip(self._folds, self.learners, strict=True)
                for test in fold.tests
            ]
            dof = 3 if all(has_heading(test) for test in tests) else 2
            self._known[state] = Outcome.of([self._scores(test) for test in tests], dof)
        return self._known[state]

    def better(self, state: State, others: State) -> bool:
        """Whether the estimator is better with ``state`` than with ``others``."""
        return state != others and judged((), self.outcome(state), self.outcome(others)).accepted

    def tried(self, state: State, unit: Unit) -> State:
        """``state`` with ``unit``, if it pays, else without."""
        with_it, without = state | {unit}, state - {unit}
        found = judged(unit.names, self.outcome(with_it), self.outcome(without))
        self.judgements[unit] = found
        return with_it if found.accepted else without

    def begun(self, everything: State, forced: State) -> State:
        """All parameters, if they pay as a whole, else those of the sensors that do."""
        if self.better(everything, forced):
            return everything
        state = forced
        sections = sorted({unit.section for unit in everything - forced})
        for section in sections if len(sections) > 1 else ():
            more = state | {unit for unit in everything if unit.section == section}
            if self.better(more, state):
                state = more
        return state

    def _scores(self, log: Log) -> Mapping[str, Any] | None:
        try:
            return self._evaluate(log)
        except (InputError, RunFailedError):
            return None


def _usable(rig: Rig, state: State) -> Rig:
    """The rig whose sensors are those that it can use."""
    for calibrator in calibrators().values():
        rig = calibrator.usable(rig, state)
    return rig
