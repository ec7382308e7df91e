"""The data of the page's charts, as plain values for its script."""

from collections.abc import Mapping, Sequence
from typing import Any

from factorgraph_loc.evaluation.inference import pooled
from factorgraph_loc.evaluation.report.metrics import Metric
from factorgraph_loc.evaluation.report.results import SWEEP, MetricComparison, Results, score
from factorgraph_loc.evaluation.statistics import quantile

Chart = dict[str, Any]
Trust = Mapping[str, tuple[float, float, float]]
_Dot = tuple[float, str]  # a value, and its label


def ratios(results: Results, c: MetricComparison) -> Chart | None:
    """Ratios of each variant to the baseline, with a dot per log and a mark at the median; None if there are none."""
    rows: list[dict[str, Any]] = []
    for place, variant in enumerate(results.variants):
        found = c.contrasts.get(variant)
        if found is None:
            continue
        dots: list[_Dot] = [(_short(a / b), log) for log, (a, b) in found.by_log.items() if a > 0.0 and b > 0.0]
        if dots:
            grey = c.p[variant] is not None and not c.is_significant(variant)
            rows.append({"v": place, "dots": dots, "mark": _median(dots), "grey": grey})
    if not rows:
        return None
    title = f"times that of {c.reference}"
    return {
        "rows": rows,
        "x": {"title": title, "log": True, "ref": 1, "unit": " times"},
        "markTitle": "median over logs",
    }


def consistency(results: Results, trust: Trust, by_log: Mapping[tuple[str, str], float]) -> Chart | None:
    """Mean NEES per degree of freedom: a dot per log, the mean over logs, and its 95 % band around 1."""
    rows: list[dict[str, Any]] = []
    for place, variant in enumerate(results.variants):
        if variant in trust:
            mean, low, high = trust[variant]
            dots = [[_short(by_log[variant, log]), log] for log in results.logs if (variant, log) in by_log]
            rows.append({"v": place, "dots": dots, "mark": _short(mean), "band": [_short(low), _short(high)]})
    if not rows:
        return None
    x = {"title": "ANEES of causal poses, per degree of freedom", "log": True, "ref": 1, "unit": ""}
    return {"rows": rows, "x": x, "markTitle": "mean over logs"}


def times(results: Results, metric: Metric) -> Chart | None:
    """A dot per log, and a mark at the median over logs."""
    rows: list[dict[str, Any]] = []
    for place, variant in enumerate(results.variants):
        by_log = results.scores(metric.key, variant)
        dots: list[_Dot] = []
        for log, seeds in by_log.items():
            known = [v for v in seeds.values() if v is not None]
            if known:
                dots.append((_short(metric.factor * quantile(known, 0.5)), log))
        if dots:
            rows.append({"v": place, "dots": dots, "mark": _median(dots)})
    if not rows:
        return None
    x = {"title": metric.heading, "log": True, "unit": f" {metric.unit}"}
    return {"rows": rows, "x": x, "markTitle": "median over logs"}


def sweep(results: Results, column: str, metric: Metric) -> Chart | None:
    """A metric over the values of a swept setting: a line per label and combination of the other swept settings, with intervals
    where there are enough logs or seeds. None if the setting is not numeric, or there is no score."""
    lines: dict[str, dict[float, dict[str, dict[int, float | None]]]] = {}
    variants: dict[str, int] = {}
    for place, variant in enumerate(results.variants):
        for log in results.logs:
            for row in results.runs(variant, log):
                value = row.get(column)
                if not isinstance(value, int | float) or isinstance(value, bool):
                    continue
                name = _without(results, variant, row, column)
                variants.setdefault(name, place)
                seeds = lines.setdefault(name, {}).setdefault(float(value), {}).setdefault(str(row["log"]), {})
                seeds[row["seed"]] = score(row, metric.key)
    series: list[dict[str, Any]] = []
    for name, by_value in lines.items():
        points = [_point(metric, value, scores) for value, scores in sorted(by_value.items())]
        if any(p[1] is not None for p in points):
            series.append({"v": variants[name], "name": name, "points": points})
    if not any(len(s["points"]) > 1 for s in series):
        return None
    return {
        "series": series,
        "dots": True,
        "all": True,
        "x": {"title": column.removeprefix(SWEEP)},
        "y": {"title": metric.heading},
    }


def _point(metric: Metric, value: float, scores: dict[str, dict[int, float | None]]) -> list[float | None]:
    found = pooled(scores, rms=metric.rms)
    if found is None:
        return [value, None]
    point = [value, _short(metric.factor * found.value)]
    bounds = (found.low, found.high) if found.low is not None else (found.least, found.most)
    return [*point, *(_short(metric.factor * b) for b in bounds if b is not None)] if found.count > 1 else [*point]


def _without(results: Results, variant: str, row: Mapping[str, Any], column: str) -> str:
    """The name of a line: the label and the swept settings other than that of the axis."""
    others = [c for c in results.sweeps if c != column and row.get(c) is not None]
    label = results.variants[variant].label
    return ", ".join([label, *(f"{c.rpartition('.')[2].replace('_', ' ')} {row[c]}" for c in others)])


def _median(dots: Sequence[_Dot]) -> float:
    return quantile([value for value, _ in dots], 0.5)


def _short(value: float) -> float:
    """A value with five digits, for drawing."""
    return float(f"{value:.5g}")
