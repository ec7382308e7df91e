"""Selection of the learnt parameters that improve an estimator, in runs with and without each on held-out stretches.

The search is greedy. It begins with all that was learnt or, if that is no better than the input rig, with the input rig, to which
sensors are added one after the other. Then the parameters are tested one by one, with and without, first those with the least
gain in the fits, last those that depend on them: noise, uncertainty and detection models, learnt again for the remaining
constants.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from factorgraph_loc.calibration.held_out import Fold
from factorgraph_loc.calibration.judging import Judgement, StretchErrors, judged
from factorgraph_loc.calibration.learn import Knowledge, calibrators, has_heading, learn, settled
from factorgraph_loc.errors import InputError, RunFailedError
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.calibrating import State, Unit


def constants_of(knowledge: Knowledge, start: Rig) -> list[Unit]:
    """The constants that the fits would keep, by increasing gain in the fits; then those whose gain no fit can determine."""
    units: dict[Unit, float] = {}
    for name, found in knowledge.found.items():
        calibrator = calibrators()[name]
        kept = [c for c in knowledge.constants if c.kept and c.sensor == calibrator.section]
        units |= calibrator.constant_units(found, kept, knowledge.rig, start)
    return sorted(units, key=units.__getitem__)


def dependents_of(knowledge: Knowledge, start: Rig) -> list[Unit]:
    """What is learnt for the remaining constants, except what is tested last."""
    used = [calibrators()[name] for name in knowledge.found]
    units = [unit for one in used for unit in one.noise]
    for one in used:
        old, new = one.settings(start), getattr(knowledge.rig, one.section)
        if one.uncertain and new is not None and new.uncertainty != old.uncertainty:
            units.append(Unit(one.section, ("uncertainty",)))
    return [*units, *(unit for one in used for unit in one.models)]


def mixed(old: Rig, new: Rig, state: State) -> Rig:
    """The rig with the parameters in ``state`` from ``new``, and the others from ``old``."""
    changes: dict[str, Any] = {}
    for calibrator in calibrators().values():
        changes |= calibrator.mixed(old, new, state)
    return old.model_copy(update=changes)


class Learner:
    """What is learnt from some logs, with all parameters free or with some of them held at the values of ``start``.

    ``grids``: see :func:`~factorgraph_loc.calibration.learn.learn`; ``shared``: learnt from all logs, used for the uncertainties
    too, which a single log does not determine. Nothing is learnt from logs that are too short.
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
        # a single log, and one recording without a part of it, do not determine differences between runs
        self._by_log = shared is None or len(logs) > 1
        self._shared = None if self._by_log else shared
        self._all: Knowledge | None = None
        with suppress(InputError):  # too short
            self._all = knowledge or learn(logs, start, grids, shared, by_log=self._by_log)
        self.knowledge = self._all
        self._change: Callable[[Rig], Rig] = lambda rig: rig

    def settle(self, accepted: Iterable[str]) -> None:
        """Learn again with only these constants."""
        if self._all is not None:
            self.knowledge = settled(self._all, self._logs, self._start, frozenset(accepted), by_log=self._by_log)

    def noisy(self, change: Callable[[Rig], Rig]) -> None:
        """Use the noise changed by ``change`` from now on."""
        self._change = change

    def rig(self, state: State) -> Rig:
        """The input rig with the learnt values of the parameters in ``state``."""
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
    """Runs an estimator on the stretches of ``folds``, each with the parameters of its learner."""

    def __init__(
        self, folds: Sequence[Fold], learners: Sequence[Learner], evaluate: Callable[[Log], Mapping[str, Any]]
    ) -> None:
        self._folds, self.learners, self._evaluate = folds, learners, evaluate
        self._known: dict[tuple[int, str], Mapping[str, Any] | None] = {}
        self.judgements: dict[Unit, Judgement] = {}

    def forget(self) -> None:
        """Discard outcomes after a change of what was learnt."""
        self._known = {}

    def outcome(self, state: State) -> StretchErrors:
        """The outcome with the parameters of ``state``."""
        tests = [
            replace(test, rig=_usable(learner.rig(state), state))
            for fold, learner in zip(self._folds, self.learners, strict=True)
            for test in fold.tests
        ]
        dof = 3 if all(has_heading(test) for test in tests) else 2
        return StretchErrors.of([self._scores(i, test) for i, test in enumerate(tests)], dof)

    def better(self, state: State, others: State) -> bool:
        """Whether the estimator is better with ``state`` than with ``others``."""
        return state != others and judged((), self.outcome(state), self.outcome(others)).accepted

    def tried(self, state: State, unit: Unit) -> State:
        """``state`` with ``unit`` if that is better, else without."""
        with_it, without = state | {unit}, state - {unit}
        found = judged(unit.names, self.outcome(with_it), self.outcome(without))
        self.judgements[unit] = found
        return with_it if found.accepted else without

    def begun(self, everything: State, forced: State) -> State:
        """All parameters if they are better together, else those of the sensors that are."""
        if self.better(everything, forced):
            return everything
        state = forced
        sections = sorted({unit.section for unit in everything - forced})
        for section in sections if len(sections) > 1 else ():
            more = state | {unit for unit in everything if unit.section == section}
            if self.better(more, state):
                state = more
        return state

    def _scores(self, number: int, log: Log) -> Mapping[str, Any] | None:
        """Those of a stretch, which is run once with each rig: many states give a fold the same one."""
        key = number, log.rig.model_dump_json()
        if key not in self._known:
            self._known[key] = None
            with suppress(InputError, RunFailedError):
                self._known[key] = self._evaluate(log)
        return self._known[key]


def _usable(rig: Rig, state: State) -> Rig:
    """The rig with only the sensors that it can use."""
    for calibrator in calibrators().values():
        rig = calibrator.usable(rig, state)
    return rig
