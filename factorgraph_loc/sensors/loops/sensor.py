"""The loops of a run, for estimators that keep earlier poses."""

from collections.abc import Iterator, Sequence
from typing import cast

import numpy as np

from factorgraph_loc.sensors.base import Binding, Link, Sensor, View
from factorgraph_loc.sensors.loops.measurement import Loops
from factorgraph_loc.sensors.loops.settings import LoopSettings
from factors.graph import Factor
from factors.loops.factor import LoopFactor
from factors.se2 import Array

UNKNOWN = "loops: the earlier pose is not kept"
LEAST_SCORE = 0.01  # scores below count as this


class LoopSensor(Sensor):
    """Loops that another program found, each a robust factor on two poses. Those whose earlier pose the estimator does not have,
    as no filter has, are counted as ignored."""

    modality = "loops"
    links = True

    def __init__(self, binding: Binding, settings: LoopSettings) -> None:
        self._settings, self._diagnostics = settings, binding.diagnostics

    def observe(self, m: Loops, view: View) -> Iterator[Link]:
        """A link for each loop."""
        settings = self._settings
        scores = np.where(np.isnan(m.score), 1.0, m.score)
        for age, x, y, heading, score in zip(m.age, m.x, m.y, m.heading, scores.tolist(), strict=True):
            if score < settings.least_score:
                self._diagnostics.ignore("loops: lower score than the rig's least_score")
                continue
            earlier = view.earlier(m.t - float(age))
            if earlier is None:
                self._diagnostics.ignore(UNKNOWN)
                continue
            wider, measured = 1.0 / max(score, LEAST_SCORE), None
            sigmas = np.array((settings.sigma_place,))
            if np.isfinite(x):
                measured = np.array((x, y, heading))
                sigmas = np.array((settings.sigma_position, settings.sigma_position, settings.sigma_heading))
            # whitened by wider deviations, a distance of sqrt(score) is score^1.5
            given_up = settings.robust * wider**-1.5
            factor = LoopFactor(measured, wider * sigmas, view.offset, earlier.offset, given_up)
            yield Link(m.t, earlier.t, factor, factor.rows)

    def at_end(self, factor: Factor, width: float) -> Factor:
        """The loop with a loss ``width`` times as wide."""
        return cast(LoopFactor, factor).widened(width)

    def convex_width(self, factor: Factor, values: Sequence[Array]) -> float:
        return cast(LoopFactor, factor).convex_width(values)


def bind(binding: Binding) -> LoopSensor | None:
    """The sensor of a run, or None if it is not used."""
    if LoopSensor.modality not in binding.setup.sensors:
        return None
    return LoopSensor(binding, binding.setup.rig.find(LoopSettings) or LoopSettings())
