"""The sensor of loop closures in a run, for estimators that keep earlier poses."""

from collections.abc import Iterator, Sequence
from typing import cast

import numpy as np

from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.base import Binding, Link, Sensor, View
from factorgraph_loc.sensors.interfaces import Paragraph, Summary
from factorgraph_loc.sensors.loops.measurement import Loops, LoopSettings, LoopStream
from factors.graph import Factor
from factors.loops.factor import LoopFactor
from factors.se2 import Array

UNKNOWN = "the earlier pose is not kept"
LEAST_SCORE = 0.01  # smaller scores are raised to this


class LoopSensor(Sensor):
    """A sensor that uses loop closures of another program. Each loop closure becomes a robust factor on two poses.
    Limitation: a loop closure is ignored if the estimator's state does not contain the earlier pose, as in all
    filters."""

    modality = "loops"
    links = True

    def __init__(self, binding: Binding, settings: LoopSettings) -> None:
        super().__init__(binding.name)
        self._settings, self._diagnostics = settings, binding.diagnostics

    def observe(self, m: Loops, view: View) -> Iterator[Link]:
        """Yield a factor on two poses for each loop closure in ``m``. A loop closure is ignored if its score is too low
        or if ``view`` has no earlier pose."""
        settings = self._settings
        scores = np.where(np.isnan(m.score), 1.0, m.score)
        for age, x, y, heading, score in zip(m.age, m.x, m.y, m.heading, scores.tolist(), strict=True):
            if score < settings.least_score:
                self._diagnostics.ignore(f"{self.name}: lower score than the rig's least_score")
                continue
            earlier = view.earlier(m.t - float(age))
            if earlier is None:
                self._diagnostics.ignore(f"{self.name}: {UNKNOWN}")
                continue
            wider, measured = 1.0 / max(score, LEAST_SCORE), None
            sigmas = np.array((settings.sigma_place,))
            if np.isfinite(x):
                measured = np.array((x, y, heading))
                sigmas = np.array((settings.sigma_position, settings.sigma_position, settings.sigma_heading))
            # the rejected residual is proportional to sqrt(score), sigma to 1/score: their ratio to score^1.5
            scale = settings.robust * wider**-1.5
            factor = LoopFactor(measured, wider * sigmas, view.offset, earlier.offset, scale)
            yield Link(m.t, earlier.t, factor, factor.rows)

    def at_end(self, factor: Factor, width: float) -> Factor:
        """Return a copy of ``factor`` with the scale of its robust loss multiplied by ``width``. The copy is used when
        the whole graph is solved after a run."""
        return cast(LoopFactor, factor).widened(width)

    def convex_width(self, factor: Factor, values: Sequence[Array]) -> float:
        return cast(LoopFactor, factor).convex_width(values)


def bind(binding: Binding) -> LoopSensor | None:
    """Return the loop sensor of a run, or None if the run does not use it. ``binding``: the arguments of the sensor."""
    if LoopSensor.modality not in binding.setup.sensors:
        return None
    return LoopSensor(binding, binding.setup.rig.find(LoopSettings) or LoopSettings())


NEAR = 1.0  # m; a loop is correct if the distance of its two poses differs from the reference by less than this
GAP = 5.0  # s; longest interpolated gap between poses of the reference


def summarize(log: Log) -> Summary:
    """Return the summary of the loop closures in a log: the numbers of all loops, of loops with a relative pose, and of
    loops that agree with the reference."""
    stream = log.streams.get("loops")
    if not isinstance(stream, LoopStream) or not len(stream.t):
        return Summary()
    placed = int(np.count_nonzero(np.isfinite(stream.x)))
    entries: dict[str, float] = {"count": len(stream.t), "with_pose": placed}
    line = f"{len(stream.t)} loops, {placed} of them with a relative pose"
    if log.reference is not None:
        t = stream.t + log.rig.time_offset("loops")
        later, earlier = (log.reference.at(at, max_gap=GAP)[:, :2] for at in (t, t - stream.age))
        apart = np.linalg.norm(later - earlier, axis=1)
        distance = np.hypot(np.nan_to_num(stream.x), np.nan_to_num(stream.y))
        known = np.isfinite(apart)
        near = np.abs(apart[known] - distance[known]) < NEAR
        entries |= {"compared": int(np.count_nonzero(known)), "near": int(np.count_nonzero(near))}
        if known.any():
            line += f"; of {len(near)} within the reference {np.mean(near):.0%} are correct to {NEAR:g} m"
    return Summary({"loops": entries}, text=[Paragraph(line)])
