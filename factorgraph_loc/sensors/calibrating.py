"""The interface by which sensor packages take part in :mod:`factorgraph_loc.calibration`."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from factorgraph_loc.drawing.pages import Part, Rows
from factorgraph_loc.files.models import FileModel, bounds
from factorgraph_loc.fitting.constants import FittedConstant, describe
from factorgraph_loc.fitting.robust import Constant, Fit, blocks, fit, folds, gains, is_worth
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.smoothed import Smoothed, pooled_constants
from factors.se2 import Array

BLOCK = 20.0  # s; errors within a block may be correlated
BLOCKS = 5  # folds of a single log in cross-validation


class Unit(NamedTuple):
    """Parameters that are accepted or rejected together: fields of one section of the rig."""

    section: str
    fields: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The fields, prefixed by their section."""
        return tuple(f"{self.section}.{name}" for name in self.fields)


State = frozenset[Unit]


def upper_bounds(kind: type[FileModel]) -> dict[str, float]:
    """The upper bound of each number of a model."""
    return {name: bounds(field.metadata)[1] for name, field in kind.model_fields.items()}


@dataclass(frozen=True)
class Settled:
    """The result for a sensor with a given set of constants: ``sections`` of the rig, the ``constants``, ``notes`` (one line
    each) on what could not be learnt, and ``details`` for its report."""

    sections: Mapping[str, Any] = field(default_factory=dict)
    constants: Sequence[FittedConstant] = ()
    notes: Sequence[str] = ()
    details: Any = None


@dataclass(frozen=True)
class Told:
    """The input of a sensor's report: ``found`` and ``details`` of its calibrator, or None; ``learnt``: the rig with all learnt
    values, ``rig``: with the accepted ones; ``trial``: of its noise, or None."""

    logs: tuple[str, ...]
    found: Any
    details: Any
    learnt: Rig
    rig: Rig
    trial: Any
    accepted: State


class Calibrator:
    """The calibration of one sensor.

    ``section``: of the rig; ``channel``: the stream that a log must have; ``senses``: whether the robot can be localized by it.
    ``noise``: parameters learnt after the constants; ``models``: parameters judged after those that differ between runs;
    ``uncertain``: the constants that an estimator can learn on each run, with the rig's upper bounds; ``together``: constants
    that are judged together; ``first``: settings of an unknown sensor. ``estimator``: used for
    judging if the EKF cannot be; ``folds``: number of parts of a single log, and of segments of each. ``is_consistent``: whether
    the noise is scaled to a consistent estimator, on held-out logs only if there are ``models``.
    """

    section: ClassVar[str]
    channel: ClassVar[str]
    senses: ClassVar[bool] = True
    noise: ClassVar[tuple[Unit, ...]] = ()
    models: ClassVar[tuple[Unit, ...]] = ()
    uncertain: ClassVar[Mapping[str, float]] = {}
    together: ClassVar[tuple[tuple[str, ...], ...]] = ()
    first: ClassVar[FileModel | None] = None
    estimator: ClassVar[str] = ""
    folds: ClassVar[tuple[int, int]] = (4, 1)
    is_consistent: ClassVar[bool] = False

    def recordings(self, logs: Sequence[Log]) -> list[int]:
        """An identifier of the recording of each log; logs with the same measurements cannot validate each other."""
        return list(range(len(logs)))

    def check_alike(self, first: Log, log: Log) -> None:
        """InputError if two logs cannot be of the same robot."""

    def learn(self, logs: Sequence[Log], rig: Rig, grids: Path | None, like: Any) -> Any:
        """Learn from ``logs`` what needs no estimator; None if there is nothing to learn.

        ``grids``: path and name prefix of files that may be written; ``like``: the result from all logs if these are some of
        them. InputError if a log is too short.
        """
        raise NotImplementedError

    def settle(
        self, found: Any, logs: Sequence[Log], rig: Rig, accepted: Collection[str] | None, *, by_log: bool
    ) -> Settled:
        """The result with only those worthwhile constants that are in ``accepted`` (names with the section); None: all worthwhile
        ones. Without ``by_log``, individual logs are not examined."""
        raise NotImplementedError

    def relearn(self, smoothed: Sequence[Smoothed], rig: Rig, first: Rig, _grids: Path | None) -> Settled:
        """Learn from logs without a reference, smoothed with ``rig``: by default the constants that estimators learn on each run.

        ``first``: the rig before all turns, see :meth:`widened`; ``_grids``: as in :meth:`learn`. InputError if a log does not
        tell enough.
        """
        if getattr(rig, self.section) is None or not self.uncertain:
            return Settled()
        prefix = f"{self.channel}." if self.senses else ""
        now, before = getattr(rig, self.section), getattr(first, self.section)
        settings, constants = pooled_constants(self.section, prefix, now, before, self.uncertain, smoothed)
        return Settled({self.section: settings}, constants)

    def widened(self, rig: Rig, first: Rig) -> Rig:
        """The rig with the uncertainties of the ``first`` one: those that are learnt hold for later runs, and would bind the next
        turn to what the last one found."""
        if getattr(rig, self.section) is None or not self.uncertain:
            return rig
        uncertainty = getattr(first, self.section).uncertainty
        settings = getattr(rig, self.section).model_copy(update={"uncertainty": uncertainty})
        return rig.model_copy(update={self.section: settings})

    def constant_units(
        self, _found: Any, kept: Sequence[FittedConstant], _learnt: Rig, _start: Rig
    ) -> dict[Unit, float]:
        """The units of the constants that were ``kept``, with the gain of the fits by each."""
        groups: dict[str, list[FittedConstant]] = {}
        for c in kept:
            groups.setdefault(next((names[0] for names in self.together if c.name in names), c.name), []).append(c)
        return {Unit(self.section, tuple(c.name for c in some)): sum(c.gain for c in some) for some in groups.values()}

    def optional(self, _learnt: Rig) -> tuple[Unit, ...]:
        """Units that are tried last and used only if they improve the result."""
        return ()

    def settings(self, rig: Rig) -> Any:
        """The section of a rig, or the initial one."""
        return getattr(rig, self.section) or self.first

    def mixed(self, old: Rig, new: Rig, state: State) -> dict[str, Any]:
        """Sections with the ``new`` values of the parameters in ``state`` and the ``old`` values of the others."""
        learnt = getattr(new, self.section)
        update = {name: getattr(learnt, name) for unit in state if unit.section == self.section for name in unit.fields}
        return {self.section: self.settings(old).model_copy(update=update)} if update else {}

    def usable(self, rig: Rig, _state: State) -> Rig:
        """The rig with the sensors that this calibrator can use."""
        return rig

    def is_complete(self, rig: Rig) -> bool:
        """Whether a rig has everything that the sensor needs."""
        return self.channel not in rig.sensors or getattr(rig, self.section) is not None

    def least(self, _found: Any) -> float | None:
        """Lower bound of the noise factor, and its initial guess; None for the common ones."""
        return None

    def inflated(self, rig: Rig, _factor: float) -> Rig:
        """The rig with the sensor's standard deviations multiplied by a factor."""
        return rig

    def honest(self, rig: Rig, factor: float | None, _other: Rig, _learnt: Rig) -> Rig:
        """The rig with the final noise: scaled by ``factor``, or with what accounts for correlated errors in the rig ``_other``;
        ``_learnt``: the rig learnt from all logs."""
        return rig if factor is None or getattr(rig, self.section) is None else self.inflated(rig, factor)

    def judged(self, found: Any, _judgements: Mapping[str, Any]) -> Any:
        """The result with the estimator's judgement of each parameter."""
        return found

    def doubts(self, _found: Any, _details: Any) -> Sequence[str]:
        """Warnings for the reader of the report."""
        return ()

    def document(self, _told: Told) -> Mapping[str, Any]:
        """The sensor's part of the machine-readable document."""
        return {}

    def tables(self, _told: Told) -> Sequence[Rows]:
        """Additional tables."""
        return ()

    def report(self, _told: Told) -> Mapping[str, Sequence[Part]]:
        """Parts of the report by the title of their section, such as ``Noise``."""
        return {}


@dataclass(frozen=True)
class ConstantsFound:
    """The fit of a sensor's constants. ``parts``: data per log; ``everything``: all constants fitted together, from ``start``;
    ``gain`` (P, K): see :func:`~factorgraph_loc.fitting.robust.gains`; ``denied``: names of constants rejected for other
    reasons."""

    parts: tuple[Any, ...]
    everything: Fit
    gain: Array
    start: Mapping[str, float]
    denied: tuple[str, ...] = ()


class ConstantsCalibrator(Calibrator):
    """Base class for constants fitted by least squares. The data of a log have timestamps ``t`` (K,), ``residuals(settings)`` (K,
    D) in standard deviations, and can be split into ``halves()``."""

    def part(self, log: Log) -> Any:
        """The data of a log; InputError if there are too few."""
        raise NotImplementedError

    def constants(self, parts: Sequence[Any], settings: Any) -> Sequence[Constant]:
        """The constants that may be fitted; their neutral values are the rig's."""
        raise NotImplementedError

    def learn(self, logs: Sequence[Log], rig: Rig, _grids: Path | None, _like: Any) -> Any:
        """Fit the constants to the logs that have the sensor."""
        if self.channel not in logs[0].streams:
            return None
        parts, settings = tuple(map(self.part, logs)), self.settings(rig)
        constants = self.constants(parts, settings)
        everything = self.fit(None, parts, settings, constants, {c.name: c.neutral for c in constants})
        gain = gains(everything, folds([one.t for one in parts], BLOCKS))
        return ConstantsFound(parts, everything, gain, everything.as_dict())

    def base(self, found: Any, rig: Rig, _accepted: Collection[str] | None) -> Any:
        """The object that the constants belong to, with neutral values."""
        return self.changed(self.settings(rig), {c.name: c.neutral for c in found.everything.constants})

    def changed(self, base: Any, values: Mapping[str, float]) -> Any:
        """A copy with changed constants."""
        return base.model_copy(update=dict(values))

    def fit(
        self, _found: Any, parts: Sequence[Any], base: Any, constants: Sequence[Constant], start: Mapping[str, float]
    ) -> Fit:
        """Fit ``constants`` to some of the data jointly, with the other constants and the noise of ``base``."""
        names = [c.name for c in constants]

        def whitened(values: Array) -> Array:
            changed = self.changed(base, dict(zip(names, values.tolist(), strict=True)))
            return np.concatenate([one.residuals(changed) for one in parts])

        return fit(constants, np.array([start[n] for n in names]), whitened, blocks([one.t for one in parts], BLOCK))

    def finished(
        self, _found: Any, _logs: Sequence[Log], _rig: Rig, base: Any, learnt: Sequence[FittedConstant], *, by_log: bool
    ) -> Settled:
        """Complete the result with what depends on the constants; without ``by_log``, omit the results of individual logs."""
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
        # individual logs: kept constants plus those that an estimator could learn on each run; then the kept ones with the values
        # of
        # the second fit, because a rejected constant may have explained the same residuals
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
