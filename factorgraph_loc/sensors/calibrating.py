"""Base classes of the calibration of sensors, which :mod:`factorgraph_loc.calibration` runs."""

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

BLOCK = 20.0  # s; errors in the same block of time may be correlated, errors in different blocks are independent


@dataclass(frozen=True)
class Residuals:
    """Residuals of a sensor in one log, for plots of the calibration report.

    ``log``: the name of the log. ``t`` (K,): timestamps [s]. ``errors`` (K, D): residuals, NaN if not measured.
    ``sigmas`` (K, D): their standard deviations. ``distance`` (K,): the measured or driven distance [m], the abscissa
    of a plot. ``units``: the unit of each of the D columns, by the name of the column.
    """

    log: str
    units: Mapping[str, str]
    t: Array
    distance: Array
    errors: Array
    sigmas: Array


@dataclass(frozen=True)
class SensorKnowledge:
    """The result of the calibration of a sensor.

    ``sections``: the new sections of the rig by name.
    ``constants``: the fitted constants.
    ``notes``: warnings.
    ``figures``: numbers and texts of the calibration report by name, as JSON types.
    ``residuals``: the residuals of each log.
    ``details``: data for :meth:`Calibrator.pictures`, of a type that the subclass defines.
    ``correlations``: a tuple for each pair of strongly correlated constants: both names and the correlation.
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

    ``section``: the section of the rig that is calibrated.
    ``channel``: the stream that a log must have.
    ``senses``: True for exteroceptive sensors, False for odometry.
    ``first``: initial settings for rigs without the section.
    """

    section: str
    channel: str
    senses: bool = True
    first: FileModel | None = None

    def learn(
        self, traced: Sequence[Traced], rig: Rig, first: Rig, grids: Path | None, like: SensorKnowledge | None = None
    ) -> SensorKnowledge:
        """Return the sensor's constants and noise, estimated from logs with trajectories.

        ``traced``: the logs. ``rig``: the rig with initial values. ``first``: the rig before the first iteration, if
        smoothing of logs and calibration alternate. ``grids``: path and name prefix of files that may be written, or
        None. ``like``: an earlier result with more logs, or None. Its discrete choices, such as the type of the sensor
        model, are used again. Raises InputError if a log is too short.
        """
        raise NotImplementedError

    def with_priors(self, rig: Rig, first: Rig) -> Rig:
        """Return a copy of ``rig`` with the standard deviations of the sensor's constants from ``first``. Use this if
        smoothing and calibration of logs alternate. With the smaller values of ``rig``, the constants would stay near
        their last values."""
        if not hasattr(rig.section(self.section), "uncertainty"):
            return rig
        uncertainty = first.section(self.section).uncertainty
        settings = rig.section(self.section).model_copy(update={"uncertainty": uncertainty})
        return rig.model_copy(update={self.section: settings})

    def settings(self, rig: Rig) -> Any:
        """Return the sensor's section of ``rig``, or the initial settings ``first`` if the rig lacks the section."""
        return rig.section(self.section) or self.first

    def is_complete(self, rig: Rig) -> bool:
        """Return False if ``rig`` uses the sensor but has no section for it, otherwise True."""
        return self.channel not in rig.sensors or rig.section(self.section) is not None

    def pictures(self, _knowledge: SensorKnowledge) -> Sequence[Part]:
        """Return additional plots for the calibration report. ``_knowledge``: the result of :meth:`learn`."""
        return ()


class OneOfSeveral(Calibrator):
    """The calibration of one sensor of a rig with several sensors of its type. The other sensors are ignored.
    ``calibrator``: the calibration of this type of sensor. ``name``: the name of the sensor in the rig."""

    def __init__(self, calibrator: Calibrator, name: str) -> None:
        self._calibrator = calibrator
        self.section = self.channel = name
        self.senses, self.first = calibrator.senses, calibrator.first

    def learn(
        self, traced: Sequence[Traced], rig: Rig, first: Rig, grids: Path | None, like: SensorKnowledge | None = None
    ) -> SensorKnowledge:
        """Return the sensor's constants and noise, estimated from the logs ``traced``. ``rig``: the rig with initial
        values. Other arguments: see :meth:`Calibrator.learn`."""
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
    """Base class of calibrations by least squares. Constants and noise are estimated alternately, ``rounds`` times.

    :meth:`part` returns the data of one log: an object with timestamps ``t`` (K,) [s] and a method
    ``residuals(settings)``, which returns residuals (K, D) in standard deviations.
    """

    rounds: ClassVar[int] = 2

    def part(self, log: Log) -> Any:
        """Return the measurements of a log as an object with timestamps ``t`` (K,) [s] and a method
        ``residuals(settings)``. Raises InputError if the log has too few measurements."""
        raise NotImplementedError

    def parameters(self, parts: Sequence[Any], settings: Any) -> Sequence[Parameter]:
        """Return the constants to estimate, with priors around their values in ``settings``. ``parts``: the result of
        :meth:`part` for each log."""
        raise NotImplementedError

    def with_noise(self, parts: Sequence[Any], settings: Any) -> tuple[Sequence[Any], Any]:
        """Return ``parts`` and ``settings``, both updated with noise that is estimated from the residuals. ``parts``:
        the result of :meth:`part` for each log. ``settings``: the constants with which residuals are computed."""
        return parts, settings

    def finished(self, _parts: Sequence[Any], _rig: Rig, knowledge: SensorKnowledge) -> SensorKnowledge:
        """Return the result of the calibration. Subclasses add noise or plots to ``knowledge``, the fitted constants.
        ``_parts``: the result of :meth:`part` for each log. ``_rig``: the rig with the fitted constants."""
        return knowledge

    def learn(
        self, traced: Sequence[Traced], rig: Rig, first: Rig, _grids: Path | None, _like: SensorKnowledge | None = None
    ) -> SensorKnowledge:
        """Return the sensor's constants and noise, estimated by least squares from the logs ``traced``. ``rig``: the
        rig with initial values. Other arguments: see :meth:`Calibrator.learn`."""
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
        """Return maximum a posteriori estimates of constants and noise. ``parts``: the result of :meth:`part` for each
        log. ``settings``: initial values. Returns ``parts`` and ``settings``, both updated with the estimates, and the
        posterior of the constants. The posterior is None if no constants are estimated."""
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
        """Return the fitted constants of ``posterior``. With several logs, the uncertainty of a constant comes from the
        differences between fits of single logs. ``initial``: the settings before the fit. ``parts``, ``settings``: the
        results of :meth:`estimated`."""
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
        """Return the result for the logs ``traced`` with smoothed trajectories. Each constant is the mean of the
        smoother's estimates over the logs. ``first``: the rig before the first iteration of smoothing and
        calibration."""
        if not hasattr(rig.section(self.section), "uncertainty"):
            return SensorKnowledge()
        prefix = f"{self.channel}." if self.senses else ""
        settings, initial = rig.section(self.section), first.section(self.section)
        settings, constants = pooled_constants(self.section, prefix, settings, initial, traced)
        return SensorKnowledge({self.section: settings}, constants)
