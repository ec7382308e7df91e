"""The picture of docs/smoother-or-filter.md: the error of the smoother, divided by that of each filter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from benchmarking.statistics import Ratio

from factorgraph_loc.drawing.figures import COLOURS, dress, empty, legend
from factorgraph_loc.evaluation.statistics import ENOUGH_LOGS
from smoothing_benchmark.cases import SMOOTHER, Case
from smoothing_benchmark.tables import ALIGNED, shown

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TITLES = {"causal": "causal: on the way", "final": "final: once all is known (without a map: aligned)"}
MARKS = ("o", "s", "D")
APART = 0.22  # vertical distance between the filters of a case; the distance between cases is 1
TICKS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.2, 1.5, 2.0)


def picture(cases: Sequence[Case]) -> Figure:
    """Draw the ratios of position errors, smoother over filter, with 95 % intervals if there are enough logs.

    If the map was estimated, final trajectories are aligned with the reference first, because their frame is that of the start.
    """
    figure = empty(
        2.2 + 0.55 * len(cases),
        "Position error, smoother / filter (left of 1 the smoother is better)",
    )
    axes = dict(zip(TITLES, figure.subplots(1, len(TITLES), sharex=True, sharey=True), strict=True))
    dress(axes.values())
    filters = list(dict.fromkeys(label for case in cases for label in case.filters))
    for kind, axis in axes.items():
        axis.set_title(TITLES[kind])
        axis.axvline(1.0, color="0.3", linewidth=1.0)
        for number, label in enumerate(filters):
            style = {"color": COLOURS[number], "marker": MARKS[number % len(MARKS)], "linestyle": "none"}
            for line, case in enumerate(cases):
                ratio = _ratio(case, label, kind)
                if ratio is None:
                    continue
                place = line + APART * (case.filters.index(label) - (len(case.filters) - 1) / 2.0)
                if len(case.logs) >= ENOUGH_LOGS:
                    axis.plot((ratio.low, ratio.high), (place, place), color=COLOURS[number], linewidth=2.0)
                axis.plot(ratio.value, place, label=f"smoother / {shown(label)}", markersize=8, **style)
        axis.set_xscale("log")
        axis.set_xticks(TICKS, [f"{tick:g}" for tick in TICKS])
        axis.minorticks_off()
    first = axes["causal"]
    first.set_yticks(range(len(cases)), [case.name for case in cases])
    first.set_ylim(len(cases) - 0.5, -0.5)
    legend(figure, axes.values())
    return figure


def _ratio(case: Case, label: str, kind: str) -> Ratio | None:
    if label not in case.filters:
        return None
    aligned = case.ratio((SMOOTHER, ALIGNED), (label, ALIGNED)) if kind == "final" else None
    return aligned or case.ratio((SMOOTHER, kind), (label, kind))
