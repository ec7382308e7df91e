"""Which of the learnt parameters pay: an estimator runs with and without each on stretches that had no part in what was learnt.

The search is greedy. It begins with all that was learnt, or, where that is no better than the input rig, with the input rig and
what is learnt of one sensor after the other. Then the parameters are tried one after another, with and without, those first that
the fits gain least by, and last what depends on them: noise, uncertainty, models of detection, learnt anew for the constants that
remain.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from factorgraph_loc.calibration.constants import Learnt
from factorgraph_loc.calibration.held_out import Fold
from factorgraph_loc.calibration.judging import Judgement, Outcome, judged
from factorgraph_loc.calibration.learn import (
    FIRST_SENSOR,
    RANGE_KIND,
    Knowledge,
    has_heading,
    learn,
    settled,
)
from factorgraph_loc.errors import InputError, RunFailedError
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.rfid.calibration.choice import Kind
from factorgraph_loc.sensors.rfid.calibration.learn import learn_rfid
from factorgraph_loc.sensors.rfid.settings import RfidSettings

TOGETHER = (("x", "y"), ("delay", "lag"))  # constants that are judged together where both are learnt
SIGMAS = ("range_sigma", "range_sigma_relative", "bearing_sigma")


@dataclass(frozen=True)
class Unit:
    """Parameters that are judged together: a section of the rig, and its fields."""

    section: str
    fields: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The fields with their section."""
        return tuple(f"{self.section}.{field}" for field in self.fields)


State = frozenset[Unit]
NOISE = Unit("odometry", ("noise",))
SCATTER = Unit("bearing_range", SIGMAS)
PLACES, MODEL, STRENGTH = Unit("rfid", ("places",)), Unit("rfid", ("models",)), Unit("rfid", ("rssi",))


def constants_of(knowledge: Knowledge, start: Rig) -> list[Unit]:
    """Of the constants that the fits would keep, those that gain least in the fits first; then the places of tags and antennas."""
    kept = [c for c in knowledge.constants if c.kept]
    units: dict[Unit, float] = {}
    before = start.bearing_range or FIRST_SENSOR
    sensor = knowledge.rig.bearing_range
    if knowledge.sensor is not None and sensor is not None and sensor.range_kind != before.range_kind:
        # constants of another kind of ranges are none of this one
        fields = tuple(c.name for c in kept if c.sensor == "bearing_range")
        units[Unit("bearing_range", (*fields, RANGE_KIND.partition(".")[2]))] = float("inf")
        kept = [c for c in kept if c.sensor != "bearing_range"]
    for section in ("odometry", "bearing_range"):
        for group in _grouped([c for c in kept if c.sensor == section]):
            units[Unit(section, tuple(c.name for c in group))] = sum(c.gain for c in group)
    places = [PLACES] if knowledge.rfid is not None and any(o.kept for o in knowledge.rfid.offsets) else []
    return [*sorted(units, key=units.__getitem__), *places]


def dependents_of(knowledge: Knowledge, start: Rig) -> list[Unit]:
    """What is learnt for the constants that remain, without the strength of reads."""
    units = [NOISE] if knowledge.wheels is not None else []
    units += [SCATTER] if knowledge.sensor is not None else []
    for section in ("odometry", "bearing_range"):
        old, new = getattr(start, section) or FIRST_SENSOR, getattr(knowledge.rig, section)
        if new is not None and new.uncertainty != old.uncertainty:
            units.append(Unit(section, ("uncertainty",)))
    return [*units, *([MODEL] if knowledge.rfid is not None else [])]


def _grouped(kept: Sequence[Learnt]) -> list[list[Learnt]]:
    groups: dict[str, list[Learnt]] = {}
    for c in kept:
        group = next((names[0] for names in TOGETHER if c.name in names), c.name)
        groups.setdefault(group, []).append(c)
    return list(groups.values())


def mixed(old: Rig, new: Rig, state: State) -> Rig:
    """The rig with what is ``new`` of the parameters in ``state``, and ``old`` of the others."""
    changes: dict[str, Any] = {}
    for section in ("odometry", "bearing_range"):
        learnt = getattr(new, section)
        update = {field: getattr(learnt, field) for unit in state if unit.section == section for field in unit.fields}
        if update:
            changes[section] = (getattr(old, section) or FIRST_SENSOR).model_copy(update=update)
    if old.rfid is not None and new.rfid is not None and state & {PLACES, MODEL, STRENGTH}:
        changes["rfid"] = _mixed_rfid(old.rfid, new.rfid, state)
        changes["survey"] = new.survey if PLACES in state else old.survey
    return old.model_copy(update=changes)


def _mixed_rfid(old: RfidSettings, new: RfidSettings, state: State) -> RfidSettings:
    models, places = (new if unit in state else old for unit in (MODEL, PLACES))
    of_model = models.all_antennas()
    antennas = {name: a.model_copy(update={"model": of_model[name].model}) for name, a in places.all_antennas().items()}
    return models.model_copy(
        update={
            "antennas": antennas,
            "preset": None,
            "rssi": new.rssi if STRENGTH in state else old.rssi,
            "phase": new.phase,
        }
    )


class Learner:
    """What some logs tell, with all parameters free or with some of them held at the values of ``start``.

    ``grids`` and ``kind``: see :func:`~factorgraph_loc.calibration.learn.learn`; ``shared``: what all logs tell, for the
    uncertainties, which a single log does not tell. Learns nothing from logs that are too short.
    """

    def __init__(
        self,
        logs: Sequence[Log],
        start: Rig,
        grids: Path | None,
        kind: Kind | None,
        knowledge: Knowledge | None = None,
        shared: Knowledge | None = None,
    ) -> None:
        self._logs, self._start, self._grids, self._kind = list(logs), start, grids, kind
        # a single log, and one recording without a part of it, do not tell what differs between runs
        self._by_log = shared is None or len(logs) > 1
        self._shared = None if self._by_log else shared
        self._all: Knowledge | None = None
        with suppress(InputError):  # too short
            self._all = knowledge or learn(logs, start, grids, kind, by_log=self._by_log)
        self.knowledge = self._all
        self._change: Callable[[Rig], Rig] = lambda rig: rig

    def settle(self, accepted: Iterable[str], *, placed: bool) -> None:
        """Learn anew with these constants alone, and, unless ``placed``, with tags and antennas where the input rig has them."""
        if self._all is None:
            return
        found = settled(self._all, self._logs, self._start, frozenset(accepted), by_log=self._by_log)
        if not placed and self._grids is not None:
            folder = self._grids.parent / f"{self._grids.name}.unplaced"
            folder.mkdir()
            rig = learn_rfid(self._logs, self._start, folder / self._grids.name, self._kind, placed=False)[0]
            found = replace(found, rig=found.rig.model_copy(update={"rfid": rig.rfid, "survey": rig.survey}))
        self.knowledge = found

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
        section: getattr(rig, section).model_copy(update={"uncertainty": getattr(other, section).uncertainty})
        for section in ("odometry", "bearing_range")
        if getattr(rig, section) is not None and getattr(other, section) is not None
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
    """The rig whose sensors are those that it can use; the strength of reads is, where it is judged."""
    sensors = [name for name in rig.sensors if name != "rssi" or (rig.rfid is not None and rig.rfid.rssi is not None)]
    if STRENGTH in state and "rssi" not in sensors:
        sensors.append("rssi")
    return rig.model_copy(update={"sensors": tuple(sensors)})
