"""The scores of a run: their names, titles, units and digits, and which direction is better. It imports no numerical library."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from factorgraph_loc.model.scoring import KINDS
from factorgraph_loc.text import significant

_DEGREES = 180.0 / math.pi


@dataclass(frozen=True)
class Metric:
    """How a score of runs is displayed and pooled.

    ``key``: key of the score, such as "final.position_rmse". ``title``: name in an HTML report. There the value is
    multiplied by ``factor`` and has the unit ``unit``. ``column``: header in a table of text, with the unit of the
    value itself. ``digits``: decimals in such a table. ``rms``: whether values are pooled by the root mean square
    instead of the mean. ``better``: "low" if low values are better, "high" if high values are, else None.
    """

    title: str
    unit: str = ""
    factor: float = 1.0
    column: str = ""
    digits: int = 3
    rms: bool = False
    better: Literal["low", "high"] | None = "low"
    key: str = ""

    @property
    def heading(self) -> str:
        """The title with the unit in brackets, such as "position RMSE [m]"."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title

    def text(self, value: float, *, sign: bool = False) -> str:
        """Return a value as text for a report, without the unit. ``sign``: whether a positive value has a plus sign."""
        return significant(self.factor * value, sign=sign)

    def range(self, least: float, most: float, *, sign: bool = False) -> str:
        """Return the range from ``least`` to ``most`` as text for a report. ``sign``: whether positive values have a
        plus sign."""
        return f"{self.text(least, sign=sign)} … {self.text(most, sign=sign)}"


# scores of a trajectory; their keys start with ``causal.`` or ``final.``
ACCURACY = {
    "position_rmse": Metric("position RMSE", "m", column="pos [m]", rms=True),
    "position_median": Metric("position median error", "m"),
    "position_p95": Metric("position error at 95 %", "m"),
    "position_max": Metric("position largest error", "m"),
    "heading_rmse": Metric("heading RMSE", "°", _DEGREES, "head [rad]", 4, rms=True),
    "heading_median": Metric("heading median error", "°", _DEGREES),
    "heading_p95": Metric("heading error at 95 %", "°", _DEGREES),
    "heading_max": Metric("heading largest error", "°", _DEGREES),
    "rpe_position_per_m": Metric("drift", "m per m", column="pos [m/m]", digits=4, rms=True),
    "rpe_heading_per_m": Metric("turn drift", "° per m", _DEGREES, "head [rad/m]", 4, rms=True),
    "rpe_pieces": Metric("rpe pieces", better=None),
    "rpe_position_per_s": Metric("drift per second", "m per s", column="pos [m/s]", digits=4, rms=True),
    "rpe_heading_per_s": Metric("turn drift per second", "° per s", _DEGREES, "head [rad/s]", 4, rms=True),
    "anees": Metric("ANEES", column="ANEES", digits=2, better=None),
    "nees_bounds": Metric("nees bounds", better=None),
    "coverage_95": Metric("truth in the 95 % ellipse", "%", 100.0, better=None),
    "invalid_covariances": Metric("invalid covariances", better=None),
    "scored": Metric("scored", digits=0, better=None),
}
# scores of a trajectory after an alignment with the reference
ALIGNED = {
    "aligned_position_rmse": Metric("aligned position RMSE", "m", column="pos [m]", rms=True),
    "aligned_rotation_rmse": Metric("aligned rotation RMSE", "°", _DEGREES, "rot [rad]", 4, rms=True),
}
# scores of a run that estimated its map
OF_FREE_MAP = ("landmarks.count", "landmarks.rmse", "landmarks.anees")
TIMINGS = {
    "timing.update_ms_median": Metric("update, median", "ms", column="update [ms]", digits=2),
    "timing.update_ms_p99": Metric("update, 99 %", "ms"),
    "timing.update_ms_max": Metric("update, slowest", "ms"),
    "timing.real_time_factor": Metric("times real time", column="x real time", digits=0, better="high"),
    "timing.final_seconds": Metric("final trajectory", "s"),
    "timing.peak_memory_mb": Metric("peak memory", "MB"),
}
LOCALIZED = {"time_to_localized": Metric("localized after", "s", column="localized after [s]", digits=1)}

COMPARED = tuple(f"{kind}.{what}_rmse" for kind in KINDS for what in ("position", "heading"))
TABLE = (  # scores in the table of a comparison
    *(f"{kind}.{name}" for kind in KINDS for name in ("position_rmse", "heading_rmse", "anees")),
    *("timing.update_ms_median", "timing.real_time_factor"),
)
SUMMARY = TABLE[:5]  # scores that an experiment prints, unless its file names others
REPORT = (*(f"{kind}.{what}_rmse" for what in ("position", "heading") for kind in KINDS), "timing.update_ms_median")


def metric_of(key: str) -> Metric:
    """Return the metric of a score by its key. For an unknown key, the title is the key and ``better`` is None."""
    kind, _, name = key.partition(".")
    of_trajectory = ACCURACY | ALIGNED
    if kind in KINDS and name in of_trajectory:
        metric = of_trajectory[name]
        column = metric.column and f"{kind} {metric.column}"
        return replace(metric, key=key, title=f"{kind} {metric.title}", column=column)
    further = TIMINGS | LOCALIZED
    return replace(further.get(key, Metric(key.replace("_", " "), better=None)), key=key)
