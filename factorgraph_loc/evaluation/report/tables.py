"""The tables of the report of an experiment, and cautions about them. A cell has a score and its interval, range or count.

A variant is an estimator with its sensors and swept settings.
"""

from collections.abc import Sequence
from statistics import median

from factorgraph_loc.drawing.pages import Cell, Table
from factorgraph_loc.evaluation.inference import Pooled
from factorgraph_loc.evaluation.metrics import FEWEST_SCORED
from factorgraph_loc.evaluation.report.results import MetricComparison, Results, score
from factorgraph_loc.evaluation.scores import Metric
from factorgraph_loc.evaluation.statistics import ENOUGH_LOGS, average
from factorgraph_loc.evaluation.tables import counted
from factorgraph_loc.evaluation.warned import Row, by_text, label_of
from factorgraph_loc.fitting.shares import wilson
from factorgraph_loc.text import listed, significant

_NONE = "–"


def name(results: Results, variant: str) -> Cell:
    """Return a cell with the name of a variant (an estimator with its settings) and a mark in its colour."""
    return Cell(variant, colour=list(results.variants).index(variant))


def overview(results: Results, comparisons: Sequence[MetricComparison]) -> Table:
    """Return a table of scores pooled over all logs, with a row for each variant and a column for each metric.

    A variant is an estimator with its settings. The best variant of each metric is marked. Further columns have the
    numbers of localized runs, scored poses and successful runs.
    """
    # the number of localized runs is shown only if a run had to be localized first
    is_sought = any(row.get("time_to_localized") for row in results.rows)
    rows = []
    for variant in results.variants:
        cells = [_pooled_cell(c, variant) for c in comparisons]
        runs = results.of(variant)
        if is_sought:
            cells.append(_success_cell([row.get("time_to_localized") is not None for row in runs]))
        cells += [_poses_cell(runs), _success_cell([row["status"] == "ok" for row in runs])]
        rows.append([name(results, variant), *cells])
    shares = ["localized before the end"] * is_sought + ["poses scored in a run", "successful runs"]
    return ["", *(c.metric.heading for c in comparisons), *shares], rows


def differences(results: Results, comparisons: Sequence[MetricComparison]) -> Table:
    """Return a table of differences between each variant and the baseline, an estimator with its settings.

    A cell has the interval, the corrected p value and the effect size. Differences that are not significant are grey.
    """
    baseline = comparisons[0].reference
    rows = []
    for variant in results.variants:
        if variant != baseline:
            rows.append([name(results, variant), *(_difference_cell(c, variant) for c in comparisons)])
    return ["", *(c.metric.heading for c in comparisons)], rows


def by_log(results: Results, metric: Metric) -> Table:
    """Return a table of a score with a row for each log, and a column for each variant (estimator with its settings).
    The best score of each row is marked."""
    rows = []
    for log in results.logs:
        scores = {v: _known(results.runs(v, log), metric) for v in results.variants}
        values = {v: float(average(known, rms=metric.rms)) for v, known in scores.items() if known}
        pick = {"low": min, "high": max}.get(metric.better or "")
        best = pick(values.values()) if pick and len(values) > 1 else None
        cells = [_log_cell(metric, scores[v], len(results.runs(v, log)), best) for v in results.variants]
        rows.append([Cell(log), *cells, _poses_cell([row for v in results.variants for row in results.runs(v, log)])])
    return ["log", *(name(results, v) for v in results.variants), "poses scored"], rows


def timing(results: Results, metrics: Sequence[Metric]) -> Table:
    """Return a table of computing times: for each variant and metric the median over runs, and the range."""
    rows = []
    for variant in results.variants:
        cells = []
        for metric in metrics:
            known = sorted(_known(results.of(variant), metric))
            bounds = [metric.range(known[0], known[-1])] if len(known) > 1 else []
            cells.append(Cell(metric.text(median(known)), bounds) if known else Cell(_NONE))
        rows.append([name(results, variant), *cells])
    return ["", *(m.heading for m in metrics)], rows


def failures(results: Results) -> Table:
    """Return a table of failed runs, grouped by estimator and reason."""
    failed = [row for row in results.rows if row["status"] != "ok"]
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in failed:
        reason = label_of(row), str(row.get("kind") or "error"), str(row.get("reason") or "")
        groups.setdefault(reason, []).append(row)
    rows: list[list[str | int]] = [
        [label, len(some), kind, reason, _first([f"{row['log']}, seed {row['seed']}" for row in some])]
        for (label, kind, reason), some in sorted(groups.items(), key=lambda group: -len(group[1]))
    ]
    return ["estimator", "runs", "kind", "reason", "where"], rows


def warnings(results: Results) -> Table:
    """Return a table of warnings, with the number of runs that have each warning, and the first of these runs."""
    rows: list[list[str | int]] = []
    for text, concerned in by_text(results.rows).items():
        where = dict.fromkeys(f"{row['log']}, {label_of(row)}" for row in concerned)
        rows.append([text, len(concerned), _first(list(where))])
    return ["warning", "runs", "where"], rows


def cautions(results: Results, comparisons: Sequence[MetricComparison]) -> list[str]:
    """Return sentences about logs without scores, and about differences that cannot be significant."""
    said = []
    if poor := results.unscored():
        said.append(
            f"Fewer than {FEWEST_SCORED} poses of {listed(poor)} have a reference, so these logs have no scores."
        )
    contrasts = [c for comparison in comparisons for c in comparison.contrasts.values()]
    if contrasts and all(c.p is None for c in contrasts):
        units = f"{ENOUGH_LOGS} logs, or {ENOUGH_LOGS} seeds of one log"
        said.append(f"With fewer than {units}, no difference is tested. Compare the scores on each log.")
    weak = [c for c in comparisons if not c.has_power and any(p is not None for p in c.p.values())]
    if weak:
        tested = [c for c in weak[0].contrasts.values() if c.p is not None]
        most = max(tested, key=lambda c: c.count)
        few = f"{most.count} {most.units} are too few for {len(tested)} comparisons"
        said.append(f"{few}: no difference, however large, can be significant.")
    if all(score(row, c.metric.key) is None for row in results.rows for c in comparisons):
        said.append("No run has any of the requested scores.")
    return said


def p_value(p: float | None) -> str:
    """Return a p value as text, or a dash if it is None."""
    if p is None:
        return _NONE
    return "< 0.001" if p < 0.001 else f"{p:.3f}" if p < 0.1 else f"{p:.2f}"


def uncertainty(metric: Metric, figure: Pooled) -> str:
    """Return the 95 % interval of a pooled score as text, such as ``[0.1, 0.2]``, or else its range. Returns "" for a
    single log or seed. ``metric``: has the unit and the format. ``figure``: the pooled score."""
    if figure.low is not None and figure.high is not None:
        return f"[{metric.text(figure.low)}, {metric.text(figure.high)}]"
    return metric.range(figure.least, figure.most) if figure.count > 1 else ""


def _pooled_cell(c: MetricComparison, variant: str) -> Cell:
    """Return a cell with the pooled score of a variant. ● marks the best. ○ marks no significant difference from it."""
    figure = c.pooled.get(variant)
    if figure is None:
        return Cell(_NONE)
    mark, kind = "", ""
    if variant == c.best:
        mark, kind = "● ", "best"
    elif c.reference == c.best and variant in c.tied:
        mark = "○ "
    lines = [uncertainty(c.metric, figure)]
    if figure.logs < max(of.logs for of in c.pooled.values()) or figure.logs == 1:
        lines.append(f"{figure.logs} log{'' if figure.logs == 1 else 's'}")
    return Cell(mark + c.metric.text(figure.value), lines, kind)


def _difference_cell(c: MetricComparison, variant: str) -> Cell:
    """Return a cell with the difference of a variant from the reference, its interval or range, and the test."""
    contrast = c.contrasts.get(variant)
    if contrast is None:
        return Cell(_NONE, kind="grey")
    value = c.metric.text(contrast.difference, sign=True)
    if contrast.low is None or contrast.high is None or contrast.effect is None:
        apart = [x - y for x, y in contrast.by_log.values()]
        return Cell(value, [c.metric.range(min(apart), max(apart), sign=True)] if len(apart) > 1 else [], "grey")
    bounds = f"[{c.metric.text(contrast.low, sign=True)}, {c.metric.text(contrast.high, sign=True)}]"
    tested = f"p {p_value(c.p[variant])}, effect {significant(contrast.effect, sign=True)}"
    return Cell(value, [bounds, tested], "" if c.is_significant(variant) else "grey")


def _log_cell(metric: Metric, known: Sequence[float], planned: int, best: float | None) -> Cell:
    """Return a cell of a table with a score on one log. ``known``: the scores of the runs that have one. ``planned``:
    number of all runs. ``best``: best score in the row, which is marked, or None."""
    if not known:
        return Cell(_NONE)
    value = float(average(known, rms=metric.rms))
    lines = [metric.range(min(known), max(known))] if len(known) > 1 else []
    if len(known) < planned:
        lines.append(f"{len(known)} of {planned} runs")
    is_best = value == best
    return Cell(("● " if is_best else "") + metric.text(value), lines, "best" if is_best else "")


def _first(names: Sequence[str]) -> str:
    return "; ".join(names[:4]) + (f"; and {len(names) - 4} more" if len(names) > 4 else "")


def _poses_cell(runs: Sequence[Row]) -> Cell:
    """Return a cell with the number of scored poses, such as "840", or "800 to 840" if it differs between the runs."""
    return Cell(counted(runs) or _NONE)


def _success_cell(outcomes: Sequence[bool]) -> Cell:
    """Return a cell with the number of successes among ``outcomes``, and the 95 % interval of their rate."""
    low, high = wilson(sum(outcomes), len(outcomes))
    return Cell(f"{sum(outcomes)} of {len(outcomes)}", [f"[{100 * low:.0f}, {100 * high:.0f}] %"])


def _known(rows: Sequence[Row], metric: Metric) -> list[float]:
    return [value for row in rows if (value := score(row, metric.key)) is not None]
