"""Titles and units of scores, and which direction is better."""

import math
from dataclasses import dataclass
from typing import Literal

from factorgraph_loc.evaluation.inference import Pooled
from factorgraph_loc.text import significant

DEFAULT = (
    "causal.position_rmse",
    "final.position_rmse",
    "causal.heading_rmse",
    "final.heading_rmse",
    "timing.update_ms_median",
)
_DEGREES = 180.0 / math.pi


@dataclass(frozen=True)
class Metric:
    """A score by its ``key``; shown times ``factor`` in ``unit``. ``rms``: pooled as root mean square, else as the mean."""

    key: str
    title: str
    unit: str = ""
    factor: float = 1.0
    rms: bool = False
    better: Literal["low", "high"] | None = "low"

    @property
    def heading(self) -> str:
        """Title and unit."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title

    def text(self, value: float, *, sign: bool = False) -> str:
        """A formatted value without the unit."""
        return significant(self.factor * value, sign=sign)

    def range(self, least: float, most: float, *, sign: bool = False) -> str:
        """A formatted range."""
        return f"{self.text(least, sign=sign)} … {self.text(most, sign=sign)}"

    def uncertainty(self, figure: Pooled) -> str:
        """The interval, or else the range: ``[0.1, 0.2]`` or ``0.1 … 0.2``; empty for a single value."""
        if figure.low is not None and figure.high is not None:
            return f"[{self.text(figure.low)}, {self.text(figure.high)}]"
        return self.range(figure.least, figure.most) if figure.count > 1 else ""


def metric_of(key: str) -> Metric:
    """The metric of a key of the scores; for an unknown one neither direction is better."""
    kind, _, what = key.partition(".")
    if kind in ("causal", "final", "aligned"):
        return _of_trajectory(key, kind, what)
    if key in _OTHERS:
        return _OTHERS[key]
    return Metric(key, key.replace("_", " "), better=None)


def _of_trajectory(key: str, kind: str, what: str) -> Metric:
    sort, _, how = what.rpartition("_")
    if sort in ("position", "aligned_position"):
        return Metric(key, f"{kind} {sort.replace('_', ' ')} {_HOW.get(how, how)}", "m", rms=how == "rmse")
    if sort in ("heading", "aligned_rotation"):
        title = f"{kind} {sort.replace('_', ' ')} {_HOW.get(how, how)}"
        return Metric(key, title, "°", _DEGREES, rms=how == "rmse")
    if what in _DRIFTS:
        return Metric(key, f"{kind} {_DRIFTS[what][0]}", *_DRIFTS[what][1:], rms=True)
    if what == "coverage_95":
        return Metric(key, f"{kind} truth in the 95 % ellipse", "%", 100.0, better=None)
    return Metric(key, f"{kind} {'ANEES' if what == 'anees' else what.replace('_', ' ')}", better=None)


_HOW = {"rmse": "RMSE", "p95": "error at 95 %", "max": "largest error", "median": "median error"}
_DRIFTS = {
    "rpe_position_per_m": ("drift", "m per m", 1.0),
    "rpe_heading_per_m": ("turn drift", "° per m", _DEGREES),
    "rpe_position_per_s": ("drift per second", "m per s", 1.0),
    "rpe_heading_per_s": ("turn drift per second", "° per s", _DEGREES),
}
_OTHERS = {
    m.key: m
    for m in (
        Metric("timing.update_ms_median", "update, median", "ms"),
        Metric("timing.update_ms_p99", "update, 99 %", "ms"),
        Metric("timing.update_ms_max", "update, slowest", "ms"),
        Metric("timing.real_time_factor", "times real time", better="high"),
        Metric("timing.final_seconds", "final trajectory", "s"),
        Metric("timing.peak_memory_mb", "peak memory", "MB"),
        Metric("time_to_localized", "localized after", "s"),
    )
}
TIMINGS = tuple(key for key in _OTHERS if key.startswith("timing."))
