"""How a sensor is calibrated: what its package brings to the engine in :mod:`factorgraph_loc.calibration`."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from factorgraph_loc.drawing.markup import Rows
from factorgraph_loc.files.models import FileModel
from factorgraph_loc.fitting.constants import Learnt, describe
from factorgraph_loc.fitting.robust import Constant, Fit, blocks, fit, folds, gains, is_worth
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factors.se2 import Array

BLOCK = 20.0  # s; errors in one block may be correlated
BLOCKS = 5  # stretches of time of a single log, each predicted by the others


class Unit(NamedTuple):
    """Parameters that are judged together: a section of the rig, and its fields."""

    section: str
    fields: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The fields with their section."""
        return tuple(f"{self.section}.{name}" for name in self.fields)


State = frozenset[Unit]


@dataclass(frozen=True)
class Settled:
    """What is learnt of a sensor with some of its constants: ``sections`` of the rig, the ``constants``, ``notes`` of one line each
    on what could not be learnt, and ``details`` for its report."""

    sections: Mapping[str, Any] = field(default_factory=dict)
    constants: Sequence[Learnt] = ()
    notes: Sequence[str] = ()
    details: Any = None


@dataclass(frozen=True)
class Told:
    """What a report tells of one sensor: ``found`` and ``details`` of its calibrator, None without; ``learnt``: the rig with all
    that was learnt, ``rig``: with what is accepted; ``trial``: of its noise, None without."""

    logs: tuple[str, ...]
    found: Any
    details: Any
    learnt: Rig
    rig: Rig
    trial: Any
    accepted: State


class Calibrator:
    """How one sensor is calibrated.

    ``section``: of the rig; ``channel``: whose stream a log must have; ``senses``: whether a robot knows its place by it.
    ``noise``: what is learnt for the constants that remain; ``models``: the same, judged after what differs between runs;
    ``uncertain``: the constants that an estimator can learn on each run, with the most that the rig takes; ``together``:
    constants that are judged together where both are learnt; ``units``: of the constants; ``first``: settings of a sensor of
    which nothing is known. ``estimator``: which judges, where it cannot be the EKF; ``folds``: into how many parts a single log
    is cut, and in how many stretches each is judged. ``is_consistent``: whether its noise is made such that the estimator is as
    sure as it may be, and ``judged_unseen``: by runs with what other logs tell, as its models have many parameters.
    """

    section: ClassVar[str]
    channel: ClassVar[str]
    senses: ClassVar[bool] = True
    noise: ClassVar[tuple[Unit, ...]] = ()
    models: ClassVar[tuple[Unit, ...]] = ()
    uncertain: ClassVar[Mapping[str, float]] = {}
    together: ClassVar[tuple[tuple[str, ...], ...]] = ()
    units: ClassVar[Mapping[str, str]] = {}
    first: ClassVar[FileModel | None] = None
    estimator: ClassVar[str] = ""
    folds: ClassVar[tuple[int, int]] = (4, 1)
    is_consistent: ClassVar[bool] = False
    judged_unseen: ClassVar[bool] = False

    def recordings(self, logs: Sequence[Log]) -> list[int]:
        """The number of what each log recorded: of logs that hold the same measurements one is no test of the other."""
        return list(range(len(logs)))

    def check_alike(self, first: Log, log: Log) -> None:
        """InputError if two logs cannot be of one robot."""

    def learn(self, logs: Sequence[Log], rig: Rig, grids: Path | None, like: Any) -> Any:
        """What ``logs`` tell before an estimator runs, None if nothing.

        ``grids``: path and beginning of the names of files that may be written; ``like``: what was found from all logs, where these
        are some of them. InputError if a log is too short.
        """
        raise NotImplementedError

    def settle(
        self, found: Any, logs: Sequence[Log], rig: Rig, accepted: Collection[str] | None, *, by_log: bool
    ) -> Settled:
        """What is learnt with those constants alone that are worth it and ``accepted``, by their names with the section's; None:
        all that are worth it. Unless ``by_log``, no log is looked at alone."""
        raise NotImplementedError

    def constant_units(self, _found: Any, kept: Sequence[Learnt], _learnt: Rig, _start: Rig) -> dict[Unit, float]:
        """What is judged of the constants that were ``kept``, with what the fits gain by it."""
        groups: dict[str, list[Learnt]] = {}
        for c in kept:
            groups.setdefault(next((names[0] for names in self.together if c.name in names), c.name), []).append(c)
        return {Unit(self.section, tuple(c.name for c in some)): sum(c.gain for c in some) for some in groups.values()}

    def optional(self, _learnt: Rig) -> tuple[Unit, ...]:
        """What is tried last, and is not used unless it pays."""
        return ()

    def settings(self, rig: Rig) -> Any:
        """The section of a rig, or the first one."""
        return getattr(rig, self.section) or self.first

    def mixed(self, old: Rig, new: Rig, state: State) -> dict[str, Any]:
        """Sections with what is ``new`` of the parameters in ``state``, and ``old`` of the others."""
        learnt = getattr(new, self.section)
        update = {name: getattr(learnt, name) for unit in state if unit.section == self.section for name in unit.fields}
        return {self.section: self.settings(old).model_copy(update=update)} if update else {}

    def usable(self, rig: Rig, _state: State) -> Rig:
        """The rig whose sensors are those that it can use."""
        return rig

    def is_complete(self, rig: Rig) -> bool:
        """Whether a rig has what the sensor needs, learnt or stated."""
        return self.channel not in rig.sensors or getattr(rig, self.section) is not None

    def guess(self, _found: Any) -> float:
        """Where the search for the factor on the noise begins."""
        return 3.0

    def least(self, _found: Any) -> float | None:
        """Where it ends; None: where that of all does."""
        return None

    def inflated(self, rig: Rig, _factor: float) -> Rig:
        """The rig with the sensor's standard deviations multiplied."""
        return rig

    def as_honest_as(self, rig: Rig, _other: Rig) -> Rig:
        """The rig with what makes up for errors that are alike of another one."""
        return rig

    def honest(self, rig: Rig, factor: float | None, _other: Rig, _learnt: Rig) -> Rig:
        """The rig with the noise that was found: by the ``factor``, as the rig ``_other`` has it; ``_learnt``: from all logs."""
        return rig if factor is None or getattr(rig, self.section) is None else self.inflated(rig, factor)

    def judged(self, found: Any, _judgements: Mapping[str, Any]) -> Any:
        """What was found, with what an estimator says of it, by the parameters' names."""
        return found

    def doubts(self, _found: Any, _details: Any) -> Sequence[str]:
        """What the reader of the report should look at."""
        return ()

    def document(self, _told: Told) -> Mapping[str, Any]:
        """The sensor's part of the document for programs."""
        return {}

    def tables(self, _told: Told) -> Sequence[Rows]:
        """Tables beside those of all sensors."""
        return ()

    def told_noise(self, _told: Told) -> Sequence[str]:
        """HTML of the sensor's noise."""
        return ()

    def told_section(self, _told: Told) -> Sequence[str]:
        """HTML of a section of its own."""
        return ()

    def told_residuals(self, _told: Told) -> Sequence[str]:
        """HTML of what is left over."""
        return ()


@dataclass(frozen=True)
class ConstantsFound:
    """``parts``: the data by log; all constants fitted together (``everything``), from ``start``; ``gain`` (P, K): see
    :func:`~factorgraph_loc.fitting.robust.gains`; ``denied``: names of those that something else denies."""

    parts: tuple[Any, ...]
    everything: Fit
    gain: Array
    start: Mapping[str, float]
    denied: tuple[str, ...] = ()


class ConstantsCalibrator(Calibrator):
    """Of a sensor whose constants are fitted by least squares. The data of a log have stamps ``t`` (K,), ``residuals(settings)``
    (K, D) in standard deviations, and can be cut into two ``halves()``."""

    def part(self, log: Log) -> Any:
        """The data of a log; InputError if they are too few."""
        raise NotImplementedError

    def constants(self, parts: Sequence[Any], settings: Any) -> Sequence[Constant]:
        """What may be fitted; neutral are the values of the rig."""
        raise NotImplementedError

    def learn(self, logs: Sequence[Log], rig: Rig, _grids: Path | None, _like: Any) -> Any:
        """The constants of a sensor that the logs have."""
        if self.channel not in logs[0].streams:
            return None
        parts, settings = tuple(map(self.part, logs)), self.settings(rig)
        constants = self.constants(parts, settings)
        everything = self.fit(None, parts, settings, constants, {c.name: c.neutral for c in constants})
        gain = gains(everything, folds([one.t for one in parts], BLOCKS))
        return ConstantsFound(parts, everything, gain, everything.as_dict())

    def base(self, found: Any, rig: Rig, _accepted: Collection[str] | None) -> Any:
        """What the constants are part of, with neutral ones."""
        return self.changed(self.settings(rig), {c.name: c.neutral for c in found.everything.constants})

    def changed(self, base: Any, values: Mapping[str, float]) -> Any:
        """The same with other constants."""
        return base.model_copy(update=dict(values))

    def fit(
        self, _found: Any, parts: Sequence[Any], base: Any, constants: Sequence[Constant], start: Mapping[str, float]
    ) -> Fit:
        """The ``constants`` fitted to some of the data together, with the other constants and the noise of ``base``."""
        names = [c.name for c in constants]

        def whitened(values: Array) -> Array:
            changed = self.changed(base, dict(zip(names, values.tolist(), strict=True)))
            return np.concatenate([one.residuals(changed) for one in parts])

        return fit(constants, np.array([start[n] for n in names]), whitened, blocks([one.t for one in parts], BLOCK))

    def finished(
        self, _found: Any, _logs: Sequence[Log], _rig: Rig, base: Any, learnt: Sequence[Learnt], *, by_log: bool
    ) -> Settled:
        """With what depends on the constants; unless ``by_log`` without what is told of each log."""
        del by_log
        return Settled({self.section: base}, learnt)

    def settle(
        self, found: Any, logs: Sequence[Log], rig: Rig, accepted: Collection[str] | None, *, by_log: bool
    ) -> Settled:
        """See :meth:`Calibrator.settle`."""
        constants, start, parts = found.everything.constants, found.start, found.parts
        kept = [
            c
            for c, g in zip(constants, found.gain, strict=True)
            if is_worth(g) and (accepted is None or f"{self.section}.{c.name}" in accepted)
        ]
        base = self.base(found, rig, accepted)
        pooled = self.fit(found, parts, base, kept, start) if kept else None
        base = self.changed(base, pooled.as_dict() if pooled else {})
        # to each log alone what is kept with what an estimator could learn on each run, then what is kept, whose values come from
        # the second fit: what is not kept may do the same as what is
        learnable = [c for c in constants if c.name in self.uncertain and c.is_inside(start[c.name]) and c not in kept]
        apart = [some for some in ([*kept, *learnable] if learnable else [], kept) if some]
        alone = [
            {n: v for some in apart for n, v in self.fit(found, [one], base, some, start).as_dict().items()}
            for one in (parts if len(parts) > 1 else parts[0].halves())
            if by_log
        ]
        everything, gain, denied = found.everything, found.gain, found.denied
        learnt = describe(self.section, everything, pooled, alone, gain, len(parts), denied, self.uncertain)
        return self.finished(found, logs, rig, base, learnt, by_log=by_log)
