"""The compass of a run: factors on the robot's heading, and on the bias if it is estimated."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from compass.settings import CompassSettings
from compass.stream import Heading
from factorgraph_loc.model.settings import NOTHING
from factorgraph_loc.sensors.base import Binding, ResidualObservation, Sensor, Term, View
from factors import se2
from factors.motion import Increment
from factors.se2 import Array
from factors.update import Correction


@dataclass(frozen=True, slots=True)
class HeadingFactor:
    """``measured`` minus the rig's bias [rad], as a factor on the pose (3,) and, if it ``learns``, on the correction (1,) of the
    bias. ``offset``: the motion from that pose to the measurement, whose variance is added to that of ``sigma``."""

    measured: float
    sigma: float
    offset: Increment | None = None
    learns: bool = False

    def errors(self, headings: Array, biases: Array | float) -> tuple[Array, float]:
        """Residuals, predicted minus measured (N,), in standard deviations, and their number per radian."""
        turn, variance = (0.0, 0.0) if self.offset is None else (self.offset.delta[2], self.offset.covariance[2, 2])
        scale = 1.0 / float(np.hypot(self.sigma, np.sqrt(variance)))
        return scale * se2.wrap(headings + turn + biases - self.measured), scale

    def whitened(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """The residual (1, 1) and its Jacobian (1, 1, d) by each value."""
        error, scale = self.errors(values[0][2:], values[1] if self.learns else 0.0)
        blocks = [scale * np.array([[[0.0, 0.0, 1.0]]]), *([scale * np.ones((1, 1, 1))] if self.learns else [])]
        return error[:, None], blocks

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """The residual (1,) and its Jacobian (1, d) by each value."""
        error, blocks = self.whitened(values)
        return error[0], [block[0] for block in blocks]

    def cost(self, values: Sequence[Array]) -> float:
        """Half the squared residual."""
        return 0.5 * float(self.whitened(values)[0][0, 0]) ** 2

    def weight(self, squared: Array) -> Array:
        """Constant, as there is no robust loss."""
        return np.ones_like(squared)

    def dof(self) -> int:
        """Number of measured values."""
        return 1


@dataclass(frozen=True)
class HeadingObservation(ResidualObservation):
    """One heading; weighs all particles at once."""

    def log_likelihood(self, poses: Array, values: Mapping[str, Array]) -> Array:
        """Log-likelihood (N,) of ``poses`` (N, 3), each with its own bias if given."""
        (factor,) = self.factors
        biases = values[self.blocks[0]][:, 0] if self.blocks and self.blocks[0] in values else 0.0
        return -0.5 * factor.errors(poses[:, 2], biases)[0] ** 2


class CompassSensor(Sensor):
    """The compass of a run."""

    modality = "compass"

    def __init__(self, binding: Binding, settings: CompassSettings) -> None:
        super().__init__(binding.name)
        self.constants = NOTHING if binding.calibration == "none" else settings.estimated()
        self._settings, self._diagnostics = settings, binding.diagnostics

    def observe(self, m: Heading, view: View) -> Iterator[HeadingObservation]:
        """The heading as one factor."""
        learns = bool(self.constants.names)
        factor = HeadingFactor(m.heading - self._settings.bias, self._settings.sigma, view.offset, learns)
        yield HeadingObservation(m.t, (Term(factor, (self.name,) if learns else (), 1),))

    def judge(self, observation: HeadingObservation, correction: Correction, view: View) -> bool:
        """Report the innovation."""
        self._diagnostics.innovation(self.name, observation.t, correction.nis, correction.dof)
        return True

    def evidence(self, m: Heading) -> HeadingObservation:
        """The heading where no pose is known, with the uncertainty of the bias as noise."""
        sigma = float(np.hypot(self._settings.sigma, self._settings.uncertainty.bias))
        return HeadingObservation(m.t, (Term(HeadingFactor(m.heading - self._settings.bias, sigma), (), 1),))


def bind(binding: Binding) -> CompassSensor | None:
    """The sensor of a run, or None if it is not used."""
    settings = binding.setup.rig.find(CompassSettings)
    used = settings is not None and CompassSensor.modality in binding.setup.sensors
    return CompassSensor(binding, settings) if used else None
