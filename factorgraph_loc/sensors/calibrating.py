"""The interface of sensor packages to :mod:`factorgraph_loc.calibration`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from factorgraph_loc.drawing.pages import Part
from factorgraph_loc.files.models import FileModel
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
from factorgraph_loc.text import Notice
from factors.se2 import Array

BLOCK = 20.0  # s; errors within a block may be correlated


@dataclass(frozen=True)
class Residuals:
    """Residuals of a log for the report.

    ``errors`` (K, D) and their standard deviations ``sigmas`` (K, D), NaN if not measured; timestamps ``t`` (K,) [s] and the
    ``distance`` (K,) [m] that errors may depend on. ``units``: by the names of the D columns.
    """

    log: str
    units: Mapping[str, str]
    t: Array
    distance: Array
    errors: Array
    sigmas: Array


@dataclass(frozen=True)
class SensorKnowledge:
    """The result for a sensor.

    ``sections`` of the rig; the ``constants``; ``notes``: warnings; ``figures``: plain values for the report;
    ``residuals``: of each log; ``details``: the data that its pictures show; ``correlations``: see
    :meth:`~factorgraph_loc.fitting.posterior.Posterior.correlations`.
    """

    sections: Mapping[str, Any] = field(default_factory=dict)
    constants: Sequence[FittedConstant] = ()
    notes: Sequence[Notice] = ()
    figures: Mapping[str, Any] = field(default_factory=dict)
    residuals: Sequence[Residuals] = ()
    details: Any = None
    correlations: Sequence[tuple[str, str, float]] = ()


class Calibrator:
    """The calibration of one sensor.

    ``section``: of the rig; ``channel``: the stream that a log must have; ``senses``: whether the robot can be localized by it;
    ``first``: settings of an unknown sensor. The ``uncertainty`` of a section has the constants that an estimator can learn on
    each run.
    """

    section: str
    channel: str
    senses: bool = True
    first: FileModel | None = None

    def learn(
        self, traced: Sequence[Traced], rig: Rig, first: Rig, grids: Path | None, like: SensorKnowledge | None = None
    ) -> SensorKnowledge:
        """Learn from logs along their trajectories, from the values of ``rig``.

        ``first``: the rig before all turns of smoothing and learning, the same as ``rig`` where logs have references; ``grids``:
        path and name prefix of files that may be written; ``like``: the result from all logs if these are some of them, whose
        choices are kept. InputError if a log is too short.
        """
        raise NotImplementedError

    def with_priors(self, rig: Rig, first: Rig) -> Rig:
        """The rig with the uncertainties of the ``first`` one. Learnt ones are for later runs: in the next turn they would hold
        constants near the values of the last."""
        if not hasattr(rig.section(self.section), "uncertainty"):
            return rig
        uncertainty = first.section(self.section).uncertainty
        settings = rig.section(self.section).model_copy(update={"uncertainty": uncertainty})
        return rig.model_copy(update={self.section: settings})

    def settings(self, rig: Rig) -> Any:
        """The section of a rig, or the initial one."""
        return rig.section(self.section) or self.first

    def is_complete(self, rig: Rig) -> bool:
        """Whether a rig has everything that the sensor needs."""
        return self.channel not in rig.sensors or rig.section(self.section) is not None

    def pictures(self, _knowledge: SensorKnowledge) -> Sequence[Part]:
        """Further pictures of the report."""
        return ()


class OneOfSeveral(Calibrator):
    """The calibration of one of several sensors of a kind, ``name``, as if it was the only one."""

    def __init__(self, calibrator: Calibrator, name: str) -> None:
        self._calibrator = calibrator
        self.section = self.channel = name
        self.senses, self.first = calibrator.senses, calibrator.first

    def learn(
        self, traced: Sequence[Traced], rig: Rig, first: Rig, grids: Path | None, like: SensorKnowledge | None = None
    ) -> SensorKnowledge:
        """See :meth:`Calibrator.learn`."""
        kind, name = self._calibrator.section, self.section
        alone = [
            replace(
                trace,
                log=trace.log.alone(name),
                constants=trace.constants and {key.replace(name, kind, 1): c for key, c in trace.constants.items()},
            )
            for trace in traced
        ]
        grids = grids and grids.with_name(f"{grids.name}.{name}")
        learnt = self._calibrator.learn(alone, rig.alone(name), first.alone(name), grids, like)
        return replace(
            learnt,
            sections={name if section == kind else section: values for section, values in learnt.sections.items()},
            constants=[replace(c, sensor=name if c.sensor == kind else c.sensor) for c in learnt.constants],
        )

    def pictures(self, knowledge: SensorKnowledge) -> Sequence[Part]:
        return self._calibrator.pictures(knowledge)


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

    def finished(self, _parts: Sequence[Any], _rig: Rig, knowledge: SensorKnowledge) -> SensorKnowledge:
        """Complete the result for a rig that has the constants."""
        return knowledge

    def learn(
        self, traced: Sequence[Traced], rig: Rig, first: Rig, _grids: Path | None, _like: SensorKnowledge | None = None
    ) -> SensorKnowledge:
        """See :meth:`Calibrator.learn`."""
        if self.channel not in traced[0].log.streams:
            return SensorKnowledge()
        if traced[0].constants is not None:
            return self._pooled(traced, rig, first)
        data = [self.part(replace(trace.log, rig=rig)) for trace in traced]
        parts, settings, posterior = self.estimated(data, self.settings(rig))
        constants = [] if posterior is None else self._constants(parts, settings, self.settings(rig), posterior)
        if uncertainties := {c.name: c.uncertainty for c in constants if c.uncertainty is not None}:
            settings = settings.model_copy(
                update={"uncertainty": settings.uncertainty.model_copy(update=uncertainties)}
            )
        knowledge = SensorKnowledge(
            {self.section: settings}, constants, correlations=posterior.correlations() if posterior else ()
        )
        return self.finished(parts, rig.model_copy(update=dict(knowledge.sections)), knowledge)

    def estimated(self, parts: Sequence[Any], settings: Any) -> tuple[Sequence[Any], Any, Posterior | None]:
        """Data and settings with constants and noise of maximal posterior density."""
        parameters = self.parameters(parts, settings)
        start = {p.name: p.mean for p in parameters}
        posterior = None
        for _ in range(self.rounds if parameters else 0):
            parts, settings = self.with_noise(parts, settings)
            posterior = maximise(parameters, self._likelihood(parts, settings, parameters), start)
            start = posterior.as_dict()
            settings = settings.model_copy(update=start)
        return *self.with_noise(parts, settings), posterior

    def _likelihood(self, parts: Sequence[Any], settings: Any, parameters: Sequence[Parameter]) -> Likelihood:
        names = [p.name for p in parameters]

        def whitened(values: Array) -> Array:
            changed = settings.model_copy(update=dict(zip(names, values.tolist(), strict=True)))
            return np.concatenate([part.residuals(changed) for part in parts])

        return least_squares(whitened, parameters, blocks([part.t for part in parts], BLOCK))

    def _constants(
        self, parts: Sequence[Any], settings: Any, initial: Any, posterior: Posterior
    ) -> list[FittedConstant]:
        """The constants, with their differences between logs if there are several."""
        values = posterior.as_dict()
        own = centred(posterior.parameters, values)
        alone = [
            maximise(own, self._likelihood([part], settings, own)).values for part in (parts if len(parts) > 1 else ())
        ]
        out = []
        for i, p in enumerate(posterior.parameters):
            error, uncertainty = float(posterior.errors[i]), None
            each = [float(estimate[i]) for estimate in alone]
            if len(alone) > 1:
                between = float(np.sqrt(np.sum((np.array(each) - values[p.name]) ** 2) / (len(each) - 1)))
                error = max(error, between / np.sqrt(len(each)))
                if hasattr(getattr(settings, "uncertainty", None), p.name):
                    uncertainty = max(between, error) / (abs(values[p.name]) if "scale" in p.name else 1.0)
            start, fitted = float(getattr(initial, p.name)), values[p.name]
            out.append(FittedConstant(self.section, p.name, start, fitted, error, p.sigma, tuple(each), uncertainty))
        return out

    def _pooled(self, traced: Sequence[Traced], rig: Rig, first: Rig) -> SensorKnowledge:
        """The means of what the smoother estimated in each log."""
        if not hasattr(rig.section(self.section), "uncertainty"):
            return SensorKnowledge()
        prefix = f"{self.channel}." if self.senses else ""
        settings, initial = rig.section(self.section), first.section(self.section)
        settings, constants = pooled_constants(self.section, prefix, settings, initial, traced)
        return SensorKnowledge({self.section: settings}, constants)
