"""Calibration of the bias of a compass from the headings of a reference."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from compass.settings import CompassSettings
from factorgraph_loc.fitting.posterior import Parameter
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.calibrating import ConstantsCalibrator
from factors import se2
from factors.se2 import Array


@dataclass(frozen=True)
class Headings:
    """Measured minus true headings, ``errors`` (K,) [rad], at ``t`` (K,)."""

    t: Array
    errors: Array

    def residuals(self, settings: CompassSettings) -> Array:
        """Residuals in standard deviations (K, 1)."""
        return se2.wrap(settings.bias - self.errors)[:, None] / settings.sigma


class CompassCalibrator(ConstantsCalibrator):
    """The calibrator of the bias."""

    section, channel, senses = "compass", "compass", False
    first = CompassSettings()

    def part(self, log: Log) -> Headings:
        """The headings within the reference."""
        stream = log.streams["compass"]
        t = stream.t + log.rig.time_offset("compass")
        errors = se2.wrap(stream.heading - log.reference.at(t, max_gap=0.5)[:, 2])
        known = np.isfinite(errors)
        return Headings(t[known], errors[known])

    def parameters(self, _parts: object, settings: CompassSettings) -> tuple[Parameter, ...]:
        """The bias."""
        return (Parameter("bias", settings.bias, 0.3, -np.pi, np.pi),)


CALIBRATOR = CompassCalibrator()
