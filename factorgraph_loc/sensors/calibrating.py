"""The interface by which sensor packages take part in :mod:`factorgraph_loc.calibration`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from factorgraph_loc.drawing.pages import Part
from factorgraph_loc.files.models import FileModel, bounds
from factorgraph_loc.fitting.posterior import (
    FittedConstant,
    Likelihood,
    Parameter,
    Posterior,
    blocks,
    centred,
    least_squares,
    maximise,
)
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.smoothed import Traced, pooled_constants
from factors.se2 import Array

BLOCK = 20.0  # s; errors within a block may be correlated


def upper_bounds(kind: type[FileModel]) -> dict[str, float]:
    """The upper bound of each number of a model."""
    return {name: bounds(field.metadata)[1] for name, field in kind.model_fields.items()}


@dataclass(frozen=True)
class SensorKnowledge:
    """The result for a sensor: ``sections`` of the rig, the ``constants`` with their ``correlations`` (see
    :meth:`~factorgraph_loc.fitting.posterior.Posterior.correlations`), ``notes`` (one line each) on what could not be learnt, and
    ``details`` for its report."""

    sections: Mapping[str, Any] = field(default_factory=dict)
    constants: Sequence[FittedConstant] = ()
    notes: Sequence[str] = ()
    details: Any = None
    correlations: Sequence[tuple[str, str, float]] = ()


class Calibrator:
    """The calibration of one sensor.

    ``section``: of the rig; ``channel``: the stream that a log must have; ``senses``: whether the robot can be localized by it.
    ``uncertain``: the constants that an estimator can learn on each run, with the rig's upper bounds; ``first``: settings of an
    unknown sensor.
    """

    section: ClassVar[str]
    channel: ClassVar[str]
    senses: ClassVar[bool] = True
    uncertain: ClassVar[Mapping[str, float]] = {}
    first: ClassVar[FileModel | None] = None

    def recordings(self, logs: Sequence[Log]) -> list[int]:
        """An identifier of the recording of each log; logs with the same measurements cannot validate each other."""
        return list(range(len(logs)))

    def check_alike(self, first: Log, log: Log) -> None:
        """InputError if two logs cannot be of the same robot."""

    def learn(
        self, traced: Sequence[Traced], rig: Rig, first: Rig, grids: Path | None, like: SensorKnowledge | None = None
    ) -> SensorKnowledge:
        """Learn from logs along their trajectories, from the values of ``rig``.

        ``first``: the rig before all turns of smoothing and learning, the same as ``rig`` where logs have references; ``grids``:
        path and name prefix of files that may be written; ``like``: the result from all logs if these are some of them, whose
        choices are kept. InputError if a log is too short.
        """
        raise NotImplementedError

    def widened(self, rig: Rig, first: Rig) -> Rig:
        """The rig with the uncertainties of the ``first`` one: those that are learnt hold for later runs, and would bind the next
        turn to what the last one found."""
        if getattr(rig, self.section) is None or not self.uncertain:
            return rig
        uncertainty = getattr(first, self.section).uncertainty
        settings = getattr(rig, self.section).model_copy(update={"uncertainty": uncertainty})
        return rig.model_copy(update={self.section: settings})

    def settings(self, rig: Rig) -> Any:
        """The section of a rig, or the initial one."""
        return getattr(rig, self.section) or self.first

    def is_complete(self, rig: Rig) -> bool:
        """Whether a rig has everything that the sensor needs."""
        return self.channel not in rig.sensors or getattr(rig, self.section) is not None

    def doubts(self, _found: SensorKnowledge) -> Sequence[str]:
        """Warnings for the reader of the report."""
        return ()

    def document(self, _found: SensorKnowledge, _rig: Rig) -> Mapping[str, Any]:
        """The sensor's part of the machine-readable document; ``rig``: the one that is written."""
        return {}

    def report(self, _found: SensorKnowledge, _rig: Rig) -> Mapping[str, Sequence[Part]]:
        """Parts of the report by the title of their section, such as ``Noise``."""
        return {}


class ConstantsCalibrator(Calibrator):
    """Base class for constants with least squares. The data of a log have timestamps ``t`` (K,), and ``residuals(settings)`` (K, D)
    in standard deviations. Constants and noise are estimated in ``rounds``, in turn."""

    rounds: ClassVar[int] = 2

    def part(self, log: Log) -> Any:
        """The data of a log; InputError if there are too few."""
        raise NotImplementedError

    def parameters(self, parts: Sequence[Any], settings: Any) -> Sequence[Parameter]:
        """The constants, with priors about the rig's values."""
        raise NotImplementedError

    def with_noise(self, parts: Sequence[Any], settings: Any) -> tuple[Sequence[Any], Any]:
        """Data and settings with the noise that the residuals have with these constants."""
        return parts, settings

    def finished(
        self, _logs: Sequence[Log], _parts: Sequence[Any], rig: Rig, learnt: SensorKnowledge
    ) -> SensorKnowledge:
        """Complete the result for a ``rig`` that has the constants."""
        del rig
        return learnt

    def learn(
        self, traced: Sequence[Traced], rig: Rig, first: Rig, _grids: Path | None, _like: SensorKnowledge | None = None
    ) -> SensorKnowledge:
        """See :meth:`Calibrator.learn`."""
        if self.channel not in traced[0].log.streams:
            return SensorKnowledge()
        if traced[0].constants is not None:
            return self._pooled(traced, rig, first)
        logs = [replace(one.log, rig=rig) for one in traced]
        parts, settings, found = self.estimated([self.part(log) for log in logs], self.settings(rig))
        constants = [] if found is None else self._constants(parts, settings, self.settings(rig), found)
        if self.uncertain and len(parts) > 1:
            spreads = {
                c.name: min(c.uncertainty, self.uncertain[c.name]) for c in constants if c.uncertainty is not None
            }
            settings = settings.model_copy(update={"uncertainty": settings.uncertainty.model_copy(update=spreads)})
        learnt = SensorKnowledge(
            {self.section: settings}, constants, correlations=found.correlations() if found else ()
        )
        return self.finished(logs, parts, rig.model_copy(update=dict(learnt.sections)), learnt)

    def estimated(self, parts: Sequence[Any], settings: Any) -> tuple[Sequence[Any], Any, Posterior | None]:
        """Data and settings with constants and noise of maximal posterior density."""
        parameters = self.parameters(parts, settings)
        start = {p.name: p.mean for p in parameters}
        found = None
        for _ in range(self.rounds if parameters else 0):
            parts, settings = self.with_noise(parts, settings)
            found = maximise(parameters, self._likelihood(parts, settings, parameters), start)
            start = found.as_dict()
            settings = settings.model_copy(update=start)
        return *self.with_noise(parts, settings), found

    def _likelihood(self, parts: Sequence[Any], settings: Any, parameters: Sequence[Parameter]) -> Likelihood:
        names = [p.name for p in parameters]

        def whitened(values: Array) -> Array:
            changed = settings.model_copy(update=dict(zip(names, values.tolist(), strict=True)))
            return np.concatenate([one.residuals(changed) for one in parts])

        return least_squares(whitened, parameters, blocks([one.t for one in parts], BLOCK))

    def _constants(self, parts: Sequence[Any], settings: Any, before: Any, found: Posterior) -> list[FittedConstant]:
        """The constants, with their differences between logs if there are several."""
        values = found.as_dict()
        own = centred(found.parameters, values)
        alone = [
            maximise(own, self._likelihood([one], settings, own)).values for one in (parts if len(parts) > 1 else ())
        ]
        out = []
        for i, p in enumerate(found.parameters):
            error, uncertainty = float(found.errors[i]), None
            each = [float(one[i]) for one in alone]
            if len(alone) > 1:
                between = float(np.sqrt(np.sum((np.array(each) - values[p.name]) ** 2) / (len(each) - 1)))
                error = max(error, between / np.sqrt(len(each)))
                if p.name in self.uncertain:
                    uncertainty = max(between, error) / (abs(values[p.name]) if "scale" in p.name else 1.0)
            known = float(getattr(before, p.name))
            out.append(
                FittedConstant(self.section, p.name, known, values[p.name], error, p.sigma, tuple(each), uncertainty)
            )
        return out

    def _pooled(self, traced: Sequence[Traced], rig: Rig, first: Rig) -> SensorKnowledge:
        """The means of what the smoother estimated in each log."""
        if getattr(rig, self.section) is None or not self.uncertain:
            return SensorKnowledge()
        prefix = f"{self.channel}." if self.senses else ""
        now, before = getattr(rig, self.section), getattr(first, self.section)
        settings, constants = pooled_constants(self.section, prefix, now, before, self.uncertain, traced)
        return SensorKnowledge({self.section: settings}, constants)
