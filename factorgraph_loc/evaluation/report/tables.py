"""The tables of the page; each figure comes with an interval, a range, or a count."""

from collections import Counter
from collections.abc import Sequence
from statistics import median

from factorgraph_loc.drawing.markup import Html, join, table, tag
from factorgraph_loc.evaluation.inference import Pooled
from factorgraph_loc.evaluation.report.metrics import Metric, number
from factorgraph_loc.evaluation.report.results import MetricComparison, Results, Row, score
from factorgraph_loc.evaluation.tables import counted
from factorgraph_loc.evaluation.warned import by_text, label_of
from factorgraph_loc.fitting.shares import wilson

TIMINGS = (
    "timing.update_ms_median",
    "timing.update_ms_p99",
    "timing.update_ms_max",
    "timing.real_time_factor",
    "timing.final_seconds",
    "timing.peak_memory_mb",
)
_NONE = "–"


def name(results: Results, variant: str) -> Html:
    """The name of a variant, with its colour."""
    place = list(results.variants).index(variant)
    return join((tag("i", class_=f"key c{place % 7}"), variant))


def overview(results: Results, comparisons: Sequence[MetricComparison]) -> Html:
    """All logs together: a row per variant, a column per metric, the best of each marked, and the number of successful runs."""
    # the time to localization is of interest for unknown starts only
    is_sought = any(row.get("time_to_localized") for row in results.rows)
    rows = []
    for variant in results.variants:
        cells: list[object] = [_pooled_cell(c, variant) for c in comparisons]
        runs = results.of(variant)
        if is_sought:
            cells.append(_share([row.get("time_to_localized") is not None for row in runs]))
        cells += [_poses(runs), _share([row["status"] == "ok" for row in runs])]
        rows.append([name(results, variant), *cells])
    shares = ["localized before the end"] * is_sought + ["poses scored in a run", "successful runs"]
    return table(["", *(c.metric.heading for c in comparisons), *shares], rows, class_="figures")


def differences(results: Results, comparisons: Sequence[MetricComparison]) -> Html:
    """Differences of each variant from the baseline with interval, corrected p, and effect; grey if not significant."""
    baseline = comparisons[0].reference
    rows = []
    for variant in results.variants:
        if variant != baseline:
            rows.append([name(results, variant), *(_difference_cell(c, variant) for c in comparisons)])
    return table(["", *(c.metric.heading for c in comparisons)], rows, class_="figures")


def by_log(results: Results, metric: Metric) -> Html:
    """A row per log, a column per variant; the best of each row marked."""
    rows = []
    for log in results.logs:
        found = {v: _known(results.runs(v, log), metric) for v in results.variants}
        values = {v: _average(known, metric) for v, known in found.items() if known}
        pick = {"low": min, "high": max}.get(metric.better or "")
        best = pick(values.values()) if pick and len(values) > 1 else None
        cells = [_log_cell(metric, found[v], len(results.runs(v, log)), best) for v in results.variants]
        rows.append([log, *cells, _poses([row for v in results.variants for row in results.runs(v, log)])])
    return table(["log", *(name(results, v) for v in results.variants), "poses scored"], rows, class_="figures")


def timing(results: Results, metrics: Sequence[Metric]) -> Html:
    """Median over runs, and the range."""
    rows = []
    for variant in results.variants:
        cells = []
        for metric in metrics:
            known = sorted(_known(results.of(variant), metric))
            spread = [_range(metric, known[0], known[-1])] if len(known) > 1 else []
            cells.append(_cell(metric.text(median(known)), *spread) if known else tag("td", _NONE))
        rows.append([name(results, variant), *cells])
    return table(["", *(m.heading for m in metrics)], rows, class_="figures")


def failures(results: Results) -> Html:
    """Failed runs, grouped by reason."""
    failed = [row for row in results.rows if row["status"] != "ok"]
    groups = Counter((label_of(row), str(row.get("kind") or "error"), str(row.get("reason") or "")) for row in failed)
    rows = []
    for (label, kind, reason), count in groups.most_common():
        where = [
            f"{row['log']}, seed {row['seed']}"
            for row in failed
            if (label_of(row), str(row.get("kind") or "error"), str(row.get("reason") or "")) == (label, kind, reason)
        ]
        rows.append([label, count, kind, tag("td", reason, class_="text"), tag("td", _first(where), class_="text")])
    return table(["estimator", "runs", "kind", "reason", "where"], rows)


def warnings(results: Results) -> Html:
    """Warnings, and the runs concerned."""
    rows = []
    for text, concerned in by_text(results.rows).items():
        where = dict.fromkeys(f"{row['log']}, {label_of(row)}" for row in concerned)
        rows.append([tag("td", text, class_="text"), len(concerned), tag("td", _first(list(where)), class_="text")])
    return table(["warning", "runs", "where"], rows)


def uncertainty(metric: Metric, figure: Pooled) -> str:
    """The interval, or else the range: ``[0.1, 0.2]`` or ``0.1 … 0.2``; empty for a single value."""
    if figure.low is not None and figure.high is not None:
        return f"[{metric.text(figure.low)}, {metric.text(figure.high)}]"
    return _range(metric, figure.least, figure.most) if figure.count > 1 else ""


def p_value(p: float | None) -> str:
    """A formatted p value."""
    if p is None:
        return _NONE
    return "< 0.001" if p < 0.001 else f"{p:.3f}" if p < 0.1 else f"{p:.2f}"


def _pooled_cell(c: MetricComparison, variant: str) -> Html:
    figure = c.pooled.get(variant)
    if figure is None:
        return tag("td", _NONE)
    mark, kind = "", None
    if variant == c.best:
        mark, kind = "● ", "best"
    elif c.reference == c.best and _is_tied(c, variant):
        mark, kind = "○ ", "tied"
    lines = [uncertainty(c.metric, figure)]
    if figure.logs < max(of.logs for of in c.pooled.values()) or figure.logs == 1:
        lines.append(f"{figure.logs} log{'' if figure.logs == 1 else 's'}")
    return _cell(mark + c.metric.text(figure.value), *lines, class_=kind)


def _is_tied(c: MetricComparison, variant: str) -> bool:
    return c.can_tell and c.p.get(variant) is not None and not c.is_significant(variant)


def _difference_cell(c: MetricComparison, variant: str) -> Html:
    found = c.contrasts.get(variant)
    if found is None:
        return tag("td", _NONE, class_="grey")
    value = c.metric.text(found.difference, sign=True)
    if found.low is None or found.high is None or found.effect is None:
        apart = [x - y for x, y in found.by_log.values()]
        lines = [_range(c.metric, min(apart), max(apart), sign=True)] if len(apart) > 1 else []
        return _cell(value, *lines, class_="grey")
    bounds = f"[{c.metric.text(found.low, sign=True)}, {c.metric.text(found.high, sign=True)}]"
    tested = f"p {p_value(c.p[variant])}, effect {number(found.effect, sign=True)}"
    return _cell(value, bounds, tested, class_=None if c.is_significant(variant) else "grey")


def _log_cell(metric: Metric, known: Sequence[float], planned: int, best: float | None) -> Html:
    if not known:
        return tag("td", _NONE)
    value = _average(known, metric)
    lines = [_range(metric, min(known), max(known))] if len(known) > 1 else []
    if len(known) < planned:
        lines.append(f"{len(known)} of {planned} runs")
    is_best = value == best
    return _cell(("● " if is_best else "") + metric.text(value), *lines, class_="best" if is_best else None)


def _first(names: Sequence[str]) -> str:
    return "; ".join(names[:4]) + (f"; and {len(names) - 4} more" if len(names) > 4 else "")


def _poses(runs: Sequence[Row]) -> Html:
    """Number of scored poses, as a range over the runs."""
    return tag("td", counted(runs) or _NONE)


def _share(held: Sequence[bool]) -> Html:
    low, high = wilson(sum(held), len(held))
    return _cell(f"{sum(held)} of {len(held)}", f"[{100 * low:.0f}, {100 * high:.0f}] %")


def _cell(value: str, *lines: str, class_: str | None = None) -> Html:
    return tag("td", tag("b", value), *(tag("small", line) for line in lines if line), class_=class_)


def _range(metric: Metric, least: float, most: float, *, sign: bool = False) -> str:
    return f"{metric.text(least, sign=sign)} … {metric.text(most, sign=sign)}"


def _known(rows: Sequence[Row], metric: Metric) -> list[float]:
    return [value for row in rows if (value := score(row, metric.key)) is not None]


def _average(values: Sequence[float], metric: Metric) -> float:
    power = 2.0 if metric.rms else 1.0
    return float((sum(v**power for v in values) / len(values)) ** (1.0 / power))
