"""The charts of the report of an experiment, drawn as SVG. A variant is an estimator with its sensors and swept settings."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np

from factorgraph_loc.drawing.figures import COLOURS, grid, legend, styles, svg
from factorgraph_loc.drawing.pages import Picture
from factorgraph_loc.evaluation.inference import pooled
from factorgraph_loc.evaluation.plots import distribution, same_range
from factorgraph_loc.evaluation.report.results import MetricComparison, Results, score, short_name
from factorgraph_loc.evaluation.scores import Metric
from factorgraph_loc.evaluation.warned import SWEEP
from factorgraph_loc.model.scoring import KINDS
from factorgraph_loc.text import plain
from factors.se2 import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_GREY = "0.6"
_NAME = 40  # maximum length of a name at an axis


@dataclass(frozen=True)
class _Row:
    """A row of a dot plot, with a label ``name`` and a ``colour``. ``values``: the values of a variant (estimator with
    its settings) on each log. ``mark``: their median or mean, which is marked. ``band``: the expected interval of the
    mark, or None."""

    name: str
    colour: str
    values: Sequence[float]
    mark: float
    band: tuple[float, float] | None = None


def ratios(results: Results, comparisons: Sequence[MetricComparison]) -> Picture | None:
    """Return a plot of each variant's score on each log, divided by the score of the reference variant. None without
    ratios.

    A variant is an estimator with its settings. ``results``: all runs. ``comparisons``: one for each metric to plot.
    """
    panels = {}
    for c in comparisons:
        rows = []
        for variant, colour in zip(results.variants, cycle(COLOURS), strict=False):
            contrast = c.contrasts.get(variant)
            values = [a / b for a, b in contrast.by_log.values() if a > 0.0 and b > 0.0] if contrast else []
            if values:
                is_grey = c.p[variant] is not None and not c.is_significant(variant)
                rows.append(_Row(variant, _GREY if is_grey else colour, values, median(values)))
        if rows:
            panels[c.metric.title] = rows
    return _dots(panels, f"times that of {plain(comparisons[0].reference, _NAME)}", "median over logs", ideal=1.0)


def consistency(
    results: Results, trust: Mapping[str, tuple[float, float, float]], nees: Mapping[tuple[str, str], float]
) -> Picture | None:
    """Return a plot of the mean NEES of each variant on each log, with the mean over logs and the expected interval.

    ``results``: all runs. ``trust``: by variant, the mean over logs and the bounds of the 95 % interval for correct
    covariances. ``nees``: by variant and log, the mean NEES. Returns None if there are no values.
    """
    rows = []
    for variant, colour in zip(results.variants, cycle(COLOURS), strict=False):
        if variant in trust:
            mean, *band = trust[variant]
            values = [nees[variant, log] for log in results.logs if (variant, log) in nees]
            rows.append(_Row(variant, colour, values, mean, (band[0], band[1])))
    title = "ANEES of causal poses (ideal: 3, without reference headings 2)"
    return _dots({"": rows} if rows else {}, title, "mean over logs")


def times(results: Results, metric: Metric) -> Picture | None:
    """Return a plot of a computing time of each variant on each log, as the median over seeds. None without times."""
    rows = []
    for variant, colour in zip(results.variants, cycle(COLOURS), strict=False):
        by_log = [
            [v for v in seeds.values() if v is not None] for seeds in results.scores(metric.key, variant).values()
        ]
        values = [metric.factor * median(known) for known in by_log if known]
        if values:
            rows.append(_Row(variant, colour, values, median(values)))
    return _dots({"": rows} if rows else {}, metric.heading, "median over logs")


def distributions(results: Results, errors: Mapping[str, Mapping[tuple[str, str], Array]]) -> Picture | None:
    """Return a plot of the distributions of position errors of causal and final poses, None without errors.

    ``errors``: {"causal" or "final": {(variant, log): quantiles of the position error [m]}}. Only logs with errors of
    every variant are used.
    """
    figure, axes = grid(1, len(KINDS), 5.5)
    for axis, kind in zip(axes[0], KINDS, strict=True):
        met = {variant for variant, _ in errors[kind]}
        common = [log for log in results.logs if all((variant, log) in errors[kind] for variant in met)]
        for variant, style in zip(results.variants, styles(), strict=False):
            if variant in met and common:
                distribution(
                    axis, np.concatenate([errors[kind][variant, log] for log in common]), label=variant, **style
                )
        axis.set(xlabel="position error [m]", ylabel="fraction of smaller errors")
        axis.set_title(f"{kind}, {len(common)} log{'' if len(common) == 1 else 's'}")
    if not any(axis.lines for axis in axes[0]):
        return None
    same_range(axes[0])
    legend(figure, axes[0])
    return svg(figure)


def sweeps(results: Results, metrics: Sequence[Metric]) -> Picture | None:
    """Return a plot of each metric over the values of each swept setting, None if no swept setting is a number."""
    every = {(column, m): sweep(results, column, m) for column in results.sweeps for m in metrics}
    panels = {key: lines for key, lines in every.items() if any(len(points) > 1 for points in lines.values())}
    if not panels:
        return None
    figure, axes = _panels(len(panels), 4.5)
    for axis, ((column, metric), lines) in zip(axes, panels.items(), strict=True):
        for (name, points), style in zip(lines.items(), styles(), strict=False):
            x, y, low, high = np.array(points).T
            axis.plot(x, y, label=name, marker="o", markersize=5, **style)
            axis.vlines(x, low, high, color=style["color"], linewidth=1.0)
        axis.set(xlabel=column.removeprefix(SWEEP), ylabel=metric.heading)
    legend(figure, axes)
    return svg(figure)


def sweep(results: Results, column: str, metric: Metric) -> dict[str, list[tuple[float, float, float, float]]]:
    """Return {name of a line: its points} for a plot of a metric over the swept setting ``column``.

    ``column``: a column of the results, such as "sweep.smoother.lag". There is a line for each label and each
    combination of the other swept settings. A point has four numbers: the value of the setting, the pooled metric, and
    the bounds of its interval. Without an interval these are its minimum and maximum.
    """
    lines: dict[str, dict[float, dict[str, dict[int, float | None]]]] = {}
    for variant in results.variants:
        for row in results.of(variant):
            value = row.get(column)
            if isinstance(value, int | float) and not isinstance(value, bool):
                by_value = lines.setdefault(_line_name(results, variant, row, column), {})
                by_value.setdefault(float(value), {}).setdefault(str(row["log"]), {})[row["seed"]] = score(
                    row, metric.key
                )
    return {name: points for name, by_value in lines.items() if (points := list(_points(metric, by_value)))}


def _points(
    metric: Metric, by_value: Mapping[float, dict[str, dict[int, float | None]]]
) -> Iterator[tuple[float, float, float, float]]:
    """Yield the points of a line of :func:`sweep`. ``by_value``: {value of the setting: {log: {seed: score}}}."""
    for value, scores in sorted(by_value.items()):
        figure = pooled(scores, rms=metric.rms)
        if figure is not None:
            low = figure.least if figure.low is None else figure.low
            high = figure.most if figure.high is None else figure.high
            yield value, metric.factor * figure.value, metric.factor * low, metric.factor * high


def _line_name(results: Results, variant: str, row: Mapping[str, Any], column: str) -> str:
    """Return the name of a line: the label of a run, and its swept settings except ``column``, which is on the axis."""
    columns = [c for c in results.sweeps if c != column and row.get(c) is not None]
    return ", ".join([results.variants[variant], *(f"{short_name(c)} {row[c]}" for c in columns)])


def _panels(count: int, height: float) -> tuple[Figure, list[Axes]]:
    """Return a figure and its ``count`` axes, in two columns if there are several. ``height`` [100 px]: of one row."""
    columns = min(count, 2)
    figure, axes = grid(math.ceil(count / columns), columns, height * math.ceil(count / columns))
    for axis in axes.flat[count:]:
        axis.remove()
    return figure, list(axes.flat[:count])


def _dots(panels: Mapping[str, Sequence[_Row]], title: str, mark: str, *, ideal: float | None = None) -> Picture | None:
    """Return a plot of rows of dots on a logarithmic axis. ``panels``: the rows of each panel by its title.

    ``title``: label of the axis. ``mark``: label of the marks of the rows. ``ideal``: ideal value, drawn as a line.
    Returns None without panels.
    """
    if not panels:
        return None
    figure, axes = _panels(len(panels), 1.6 + 0.4 * max(map(len, panels.values())))
    for axis, (name, rows) in zip(axes, panels.items(), strict=True):
        if ideal is not None:
            axis.axvline(ideal, color="0.4", linestyle=":", zorder=1)
        for y, row in enumerate(rows):
            if row.band is not None:
                low, high = row.band
                axis.barh(y, high - low, 0.7, low, color="0.85", label="95 % band for correct covariances", zorder=1)
            axis.plot(row.values, [y] * len(row.values), "o", color=row.colour, alpha=0.5, label="a log")
            axis.plot([row.mark] * 2, [y - 0.3, y + 0.3], color=row.colour, linewidth=3.0, label=mark)
        axis.set(title=name, xlabel=title, xscale="log", ylim=(len(rows) - 0.5, -0.5))
        axis.set_yticks(range(len(rows)), [plain(row.name, _NAME) for row in rows], parse_math=False)
        _tick(axis)
    legend(figure, axes)
    return svg(figure)


def _tick(axis: Axes) -> None:
    """Label a logarithmic axis with numbers without exponent, also between powers of ten."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator  # noqa: PLC0415

    low, high = axis.get_xlim()
    axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)) if high > 8.0 * low else MaxNLocator(6))
    axis.xaxis.set_minor_locator(NullLocator())
    axis.xaxis.set_major_formatter("{x:g}")
