"""The table of a comparison of estimators, and sentences about it. The table has a row for each log and estimator, and then a row
for each estimator over all logs. ``rows`` are the runs: dictionaries with log, estimator, seed, status and scores."""

from collections.abc import Sequence

import numpy as np

from factorgraph_loc.evaluation.scores import ACCURACY, ALIGNED, TABLE, Metric, metric_of
from factorgraph_loc.evaluation.statistics import average, pooled_rms
from factorgraph_loc.evaluation.warned import Row
from factorgraph_loc.model.scoring import KINDS
from factorgraph_loc.text import number

ALL = "(all logs)"
SCORED = "poses scored"
BASELINE = "dead_reckoning"
EQUIVALENCE = 0.01  # relative difference of errors within which estimators are equally good


def further_tables(rows: Sequence[Row], *, rpe: bool) -> dict[str, tuple[str, ...]]:
    """Return {title of an additional table: keys of the scores that are its columns}. There is a table of errors after
    alignment if ``rows``, the runs, have them. There is a table of relative errors if ``rpe`` is true."""
    tables: dict[str, tuple[str, ...]] = {}
    aligned = dict.fromkeys(row["scoring.align"] for row in rows if row.get("scoring.align"))
    if aligned:
        tables[f"errors after alignment by {', '.join(aligned)}"] = tuple(
            f"{kind}.{name}" for kind in KINDS for name in ALIGNED
        )
    if rpe:
        tables["relative errors over a metre of path, and over a second"] = tuple(
            f"{kind}.{name}" for kind in KINDS for name in ACCURACY if name.startswith("rpe_") and name != "rpe_pieces"
        )
    return tables


def comparison_cells(rows: Sequence[Row], shown: Sequence[str] = ()) -> tuple[list[str], list[list[str]]]:
    """Return the header and the rows of a table that compares estimators.

    ``shown``: keys of the scores in the table, :data:`TABLE` if empty. RMSEs are pooled over seeds by the root mean
    square, and other scores by the mean. With several seeds a cell has the standard deviation after ±. The last rows
    pool each estimator over the logs with equal weights. The column "runs" has the number of successful runs. The
    column "poses scored" has the numbers of scored poses (see :func:`counted`).
    """
    logs = list(dict.fromkeys(row["log"] for row in rows))
    names = list(dict.fromkeys(row["estimator"] for row in rows))
    metrics = [metric_of(key) for key in shown or TABLE]
    if not shown and any(row.get("time_to_localized") for row in rows):
        metrics.insert(0, metric_of("time_to_localized"))
    lines = []
    for log in logs:
        for name in names:
            runs = [r for r in rows if r["log"] == log and r["estimator"] == name]
            if runs:
                cells = [_cell(metric, [_figure(r, metric.key) for r in runs]) for metric in metrics]
                lines.append([log, name, *cells, counted(runs) or "-", _success_count(runs)])
    if len(logs) > 1:
        for name in names:
            runs = [r for r in rows if r["estimator"] == name]
            by_log = [[r for r in runs if r["log"] == log] for log in logs]
            cells = [_pooled(metric, by_log) for metric in metrics]
            lines.append([ALL, name, *cells, counted(*by_log) or "-", _success_count(runs)])
    return ["log", "estimator", *(metric.column for metric in metrics), SCORED, "runs"], lines


def unscored(rows: Sequence[Row]) -> list[str]:
    """Return a sentence for each log that has no errors in any successful run. It states the reason."""
    lines = []
    for log in dict.fromkeys(row["log"] for row in rows):
        runs = [row for row in rows if row["log"] == log and row["status"] == "ok"]
        without = [row for row in runs if not _is_known(row, "position_rmse")]
        if without and (count := max(scored_of(row) or 0 for row in without)):
            lines.append(f"{log}: no errors, because the reference covers only {count:.0f} poses")
        elif without and all(scored_of(row) is None for row in runs):
            lines.append(f"{log}: no errors, because the log has no reference")
    return lines


def verdict(rows: Sequence[Row]) -> list[str]:
    """Return a sentence about the estimator with the smallest position error, for causal and for final trajectories.

    Errors are pooled over logs and seeds. The sentence also names estimators that are nearly as good, and the error of
    dead reckoning. Estimators with a failed run or a missing score are excluded.
    """
    logs = list(dict.fromkeys(row["log"] for row in rows))
    names = list(dict.fromkeys(row["estimator"] for row in rows))
    lines = []
    for kind in KINDS:
        errors: dict[str, float] = {}
        for name in names:
            scores = {
                log: [r.get(f"{kind}.position_rmse") for r in rows if (r["log"], r["estimator"]) == (log, name)]
                for log in logs
            }
            known = [[v for v in values if v is not None] for values in scores.values()]
            if all(known) and sum(map(len, known)) == sum(map(len, scores.values())):
                errors[name] = pooled_rms([pooled_rms(values) for values in known])
        if errors:
            best = min(errors, key=errors.__getitem__)
            line = f"least {kind} position error: {best}, {errors[best]:.3f} m"
            near = [name for name in errors if name != best and errors[name] <= (1.0 + EQUIVALENCE) * errors[best]]
            if near:
                line += f", within {EQUIVALENCE:.0%} of it {', '.join(near)}"
            if BASELINE in errors and best != BASELINE:
                line += f" ({BASELINE}: {errors[BASELINE]:.3f} m)"
            lines.append(line)
    return lines


def markdown(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown, with columns that are aligned in the plain text."""
    texts = [list(header), *map(list, lines)]
    widths = [max(len(text[i]) for text in texts) for i in range(len(header))]
    padded = [
        [cell.ljust(w) if i < 2 else cell.rjust(w) for i, (cell, w) in enumerate(zip(text, widths, strict=True))]
        for text in texts
    ]
    rule = ["-" * w if i < 2 else "-" * (w - 1) + ":" for i, w in enumerate(widths)]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in (padded[0], rule, *padded[1:]))


def scored_of(row: Row) -> float | None:
    """Return the number of scored poses of a run's causal trajectory, or of the final one if there is no causal one.

    Return None if there is no reference.
    """
    counts = (row.get(f"{kind}.scored") for kind in KINDS)
    return next((count for count in counts if count is not None), None)


def _is_known(row: Row, figure: str) -> bool:
    """True if the causal or the final trajectory of a run has the score ``figure``, such as "position_rmse"."""
    return any(row.get(f"{kind}.{figure}") is not None for kind in KINDS)


def _figure(row: Row, key: str) -> float | None:
    """Return the score ``key`` of a run, or None if it has none."""
    # the update times of a batch estimator are meaningless, because its updates only collect measurements
    offline = row.get("time_to_localized") is None
    return None if offline and key.startswith("timing.") else row.get(key)


def _cell(metric: Metric, values: Sequence[float | None]) -> str:
    """Return a cell with a score pooled over seeds. Several values have a standard deviation, such as "0.12 ±0.01".

    ``values``: the score of each run, None for a run without it.
    """
    known = [v for v in values if v is not None]
    if not known:
        return "-"
    text = number(float(average(known, rms=metric.rms)), metric.digits)
    return text if len(known) == 1 else f"{text} ±{np.std(known, ddof=1):.{metric.digits}f}"


def _pooled(metric: Metric, by_log: Sequence[Sequence[Row]]) -> str:
    """Return a cell with a score pooled over seeds and logs. ``by_log``: the runs on each log."""
    known = [[v for v in (_figure(r, metric.key) for r in runs) if v is not None] for runs in by_log]
    averages = [average(values, rms=metric.rms) for values in known if values]
    return number(float(average(averages, rms=metric.rms)) if averages else None, metric.digits)


def counted(*by_log: Sequence[Row]) -> str:
    """Return the number of scored poses on all logs as text, such as "840". "" if no log has a reference.

    ``by_log``: the runs on each log. If the runs of a log differ, the text is a range such as "800 to 840". Its ends
    are the sums over logs of the smallest and of the largest numbers.
    """
    counts = [[c for row in runs if (c := scored_of(row)) is not None] for runs in by_log]
    known = [of_log for of_log in counts if of_log]
    least, most = sum(map(min, known)), sum(map(max, known))
    return (f"{least:.0f}" if least == most else f"{least:.0f} to {most:.0f}") if known else ""


def _success_count(runs: Sequence[Row]) -> str:
    """Return the number of successful runs and of all runs: "4/5"."""
    return f"{sum(r['status'] == 'ok' for r in runs)}/{len(runs)}"
