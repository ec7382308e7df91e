"""The position sensor of a run, which turns measured positions into observations."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np

from factorgraph_loc.sensors.base import Binding, ResidualObservation, Sensor, Term, View
from factorgraph_loc.sensors.positions.finder import PositionFinder
from factorgraph_loc.sensors.positions.measurement import Position, PositionSettings
from factors.graph import Factor
from factors.motion import Increment
from factors.positions.factor import PositionFactor
from factors.se2 import Array
from factors.update import Correction


@dataclass(frozen=True)
class PositionObservation(ResidualObservation):
    """The observation of one measured position. The method ``log_likelihood`` is vectorised over all poses."""

    @property
    def factor(self) -> PositionFactor:
        """The only factor of the observation."""
        return cast(PositionFactor, self.terms[0].factor)

    def log_likelihood(self, poses: Array, values: Mapping[str, Array]) -> Array:
        return -self.factor.losses(poses)


class PositionSensor(Sensor):
    """A sensor that uses measured positions of the robot. A position that exactly equals the previous one is ignored,
    because the positioning system only repeats its last result."""

    modality = "position"

    def __init__(self, binding: Binding, settings: PositionSettings) -> None:
        super().__init__(binding.name)
        self._settings, self._diagnostics = settings, binding.diagnostics
        self._arm = np.array((settings.x, settings.y))
        self._last: tuple[float, float, float] | None = None
        self.finder = self._finder = PositionFinder(self.observation, binding.motion)

    def observation(self, m: Position, offset: Increment | None = None) -> PositionObservation:
        """Return the observation of the measurement ``m`` as a constraint on one pose. ``offset``: the motion from this
        pose to the time of ``m``, or None if the times are equal."""
        position, covariance = np.array((m.x, m.y)), self._settings.covariance(m)
        factor = PositionFactor(position, covariance, self._arm, self._settings.robust, offset)
        return PositionObservation(m.t, (Term(factor, (), 2),))

    def observe(self, m: Position, view: View) -> Iterator[PositionObservation]:
        """Yield the observation of a position, unless it repeats the previous one."""
        last, self._last = self._last, (m.t, m.x, m.y)
        if last is not None and last[0] < m.t and last[1:] == self._last[1:]:
            self._diagnostics.ignore(f"{self.name}: repeats the previous position")
            return
        yield self.observation(m, view.offset)

    def judge(self, observation: PositionObservation, correction: Correction, view: View) -> bool:
        """Return True, because no position is rejected. Record innovation and residuals [m] in the diagnostics.
        ``correction``: the result of ``observation.correct``. ``view``: the estimate before the correction."""
        self._diagnostics.innovation(self.name, observation.t, correction.nis, correction.dof)
        (error,) = -observation.factor.errors(view.pose[None])
        self._diagnostics.add_residuals(f"{self.name}.x", [float(error[0])])
        self._diagnostics.add_residuals(f"{self.name}.y", [float(error[1])])
        return True

    def evidence(self, m: Position) -> PositionObservation:
        return self.observation(m)

    @property
    def suspicious_since(self) -> float | None:
        return self._finder.suspicious_since

    def accept(self) -> None:
        self._finder.clear()

    def at_end(self, factor: Factor, width: float) -> Factor:
        return cast(PositionFactor, factor).widened(width)

    def rewind(self, t: float) -> None:
        if self._last is not None and self._last[0] > t:
            self._last = None


def bind(binding: Binding) -> PositionSensor | None:
    """Return the position sensor of a run, or None if the run does not use it. ``binding``: the arguments of the
    sensor."""
    settings = binding.setup.rig.find(PositionSettings)
    if settings is None or PositionSensor.modality not in binding.setup.sensors:
        return None
    return PositionSensor(binding, settings)
