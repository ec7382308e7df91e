"""The table of a comparison: a row for each log and estimator, then each estimator over all logs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from factorgraph_loc.evaluation.statistics import average, pooled_rms
from factorgraph_loc.io.results import KINDS
from factorgraph_loc.text import MESSAGE, plain

if TYPE_CHECKING:
    from rich.table import Table

# column: key of the score, digits, whether it is pooled as a root mean square (else averaged)
COLUMNS = {
    "causal pos [m]": ("causal.position_rmse", 3, True),
    "causal head [rad]": ("causal.heading_rmse", 4, True),
    "causal ANEES": ("causal.anees", 2, False),
    "final pos [m]": ("final.position_rmse", 3, True),
    "final head [rad]": ("final.heading_rmse", 4, True),
    "final ANEES": ("final.anees", 2, False),
    "update [ms]": ("timing.update_ms_median", 2, False),
    "x real time": ("timing.real_time_factor", 0, False),
}
# after an unknown start
SINCE_THE_START = {"localized after [s]": ("time_to_localized", 1, False)}
ALL = "(all logs)"
ALIGNED = {
    f"{kind} {what}": (f"{kind}.aligned_{key}_rmse", digits, True)
    for kind in KINDS
    for what, key, digits in (("pos [m]", "position", 3), ("rot [rad]", "rotation", 4))
}
RELATIVE = {
    f"{kind} {what} [{unit}/{per}]": (f"{kind}.rpe_{key}_per_{per}", 4, True)
    for kind in KINDS
    for per in ("m", "s")
    for what, unit, key in (("pos", "m", "position"), ("head", "rad", "heading"))
}
SCORED = "poses scored"
BASELINE = "dead_reckoning"
ALIKE = 0.01  # relative difference of errors within which estimators are equally good

Row = Mapping[str, Any]
Columns = Mapping[str, tuple[str, int, bool]]


def further_tables(rows: Sequence[Row], *, rpe: bool) -> dict[str, Columns]:
    """The columns of each table that not all comparisons have, by its title: errors after an alignment, if the runs have one, and
    relative errors, if they are asked for."""
    found: dict[str, Columns] = {}
    aligned = dict.fromkeys(row["scoring.align"] for row in rows if row.get("scoring.align"))
    if aligned:
        found[f"errors after alignment by {', '.join(aligned)}"] = ALIGNED
    if rpe:
        found["relative errors over a metre of path, and over a second"] = RELATIVE
    return found


def comparison_cells(rows: Sequence[Row], shown: Columns | None = None) -> tuple[list[str], list[list[str]]]:
    """Header and rows of the table, from the rows of a comparison. ``shown``: other columns than :data:`COLUMNS`.

    RMSEs are pooled over seeds (root mean square), the rest is averaged; with several seeds the standard deviation follows after
    ±. The last rows pool each estimator over the logs with equal weights; ``runs`` is the number of successful runs of all, and a
    pooled row with failures is not comparable with the others. ``scored``: number of scored poses, as a range over runs, and
    summed over logs. The time to localization is a column if it is not 0 throughout.
    """
    logs = list(dict.fromkeys(row["log"] for row in rows))
    names = list(dict.fromkeys(row["estimator"] for row in rows))
    columns: Columns = shown or COLUMNS
    if shown is None and any(row.get("time_to_localized") for row in rows):
        columns = {**SINCE_THE_START, **COLUMNS}
    lines = []
    for log in logs:
        for name in names:
            runs = [r for r in rows if r["log"] == log and r["estimator"] == name]
            if runs:
                cells = [_cell([_figure(r, key) for r in runs], digits, rms) for key, digits, rms in columns.values()]
                lines.append([log, name, *cells, counted(runs) or "-", _went_well(runs)])
    if len(logs) > 1:
        for name in names:
            runs = [r for r in rows if r["estimator"] == name]
            by_log = [[r for r in runs if r["log"] == log] for log in logs]
            cells = [_pooled(key, digits, rms, by_log) for key, digits, rms in columns.values()]
            lines.append([ALL, name, *cells, counted(*by_log) or "-", _went_well(runs)])
    return ["log", "estimator", *columns, SCORED, "runs"], lines


def comparison_table(rows: Sequence[Row], shown: Columns | None = None) -> Table:
    """The same as a table for the terminal."""
    from rich import box  # noqa: PLC0415 - only a terminal needs it
    from rich.table import Table  # noqa: PLC0415
    from rich.text import Text  # noqa: PLC0415

    header, lines = comparison_cells(rows, shown)
    table = Table(box=box.SIMPLE_HEAD, header_style="bold")
    for i, name in enumerate(header):
        # wrap words to keep the table narrow; folded or truncated numbers would be worse
        table.add_column(Text(name.replace(" ", "\n")), justify="left" if i < 2 else "right", no_wrap=True)
    for line, after in zip(lines, [*lines[1:], None], strict=True):
        table.add_row(*(plain(cell, MESSAGE) for cell in line), end_section=after is None or after[0] != line[0])
    return table


def unscored(rows: Sequence[Row]) -> list[str]:
    """In words: why successful runs have no errors, a line for each log with such runs."""
    lines = []
    for log in dict.fromkeys(row["log"] for row in rows):
        runs = [row for row in rows if row["log"] == log and row["status"] == "ok"]
        without = [row for row in runs if not _is_known(row, "position_rmse")]
        if without and (count := max(scored_of(row) or 0 for row in without)):
            lines.append(f"{log}: too little of the reference to score against: {count:.0f} poses")
        elif without and all(scored_of(row) is None for row in runs):
            lines.append(f"{log}: there is no reference to score against, so there are no errors")
    return lines


def verdict(rows: Sequence[Row]) -> list[str]:
    """In words: the estimator with the least position error, causal and final, compared with dead reckoning if that ran.

    Pooled over logs and seeds; those nearly as good are named too. Estimators with a failed run or a missing score are excluded.
    """
    logs = list(dict.fromkeys(row["log"] for row in rows))
    names = list(dict.fromkeys(row["estimator"] for row in rows))
    lines = []
    for kind in KINDS:
        found: dict[str, float] = {}
        for name in names:
            scores = {
                log: [r.get(f"{kind}.position_rmse") for r in rows if (r["log"], r["estimator"]) == (log, name)]
                for log in logs
            }
            known = [[v for v in values if v is not None] for values in scores.values()]
            if all(known) and sum(map(len, known)) == sum(map(len, scores.values())):
                found[name] = pooled_rms([pooled_rms(values) for values in known])
        if found:
            best = min(found, key=found.__getitem__)
            line = f"least {kind} position error: {best}, {found[best]:.3f} m"
            near = [name for name in found if name != best and found[name] <= (1.0 + ALIKE) * found[best]]
            if near:
                line += f", within {ALIKE:.0%} of it {', '.join(near)}"
            if BASELINE in found and best != BASELINE:
                line += f" ({BASELINE}: {found[BASELINE]:.3f} m)"
            lines.append(line)
    return lines


def markdown(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A Markdown table that is aligned as plain text."""
    texts = [list(header), *map(list, lines)]
    widths = [max(len(text[i]) for text in texts) for i in range(len(header))]
    padded = [
        [cell.ljust(w) if i < 2 else cell.rjust(w) for i, (cell, w) in enumerate(zip(text, widths, strict=True))]
        for text in texts
    ]
    rule = ["-" * w if i < 2 else "-" * (w - 1) + ":" for i, w in enumerate(widths)]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in (padded[0], rule, *padded[1:]))


def scored_of(row: Row) -> float | None:
    """Number of scored poses of a run's causal trajectory, else of the final one; None without a reference."""
    found = (row.get(f"{kind}.scored") for kind in KINDS)
    return next((count for count in found if count is not None), None)


def _is_known(row: Row, figure: str) -> bool:
    return any(row.get(f"{kind}.{figure}") is not None for kind in KINDS)


def _figure(row: Row, key: str) -> float | None:
    # an offline estimator (never localized before the end) only collects: its update times mean nothing
    offline = row.get("time_to_localized") is None
    return None if offline and key.startswith("timing.") else row.get(key)


def _cell(values: Sequence[float | None], digits: int, rms: bool) -> str:
    known = [v for v in values if v is not None]
    if not known:
        return "-"
    text = f"{average(known, rms=rms):.{digits}f}"
    return text if len(known) == 1 else f"{text} ±{np.std(known, ddof=1):.{digits}f}"


def _pooled(key: str, digits: int, rms: bool, by_log: Sequence[Sequence[Row]]) -> str:
    known = [[v for v in (_figure(r, key) for r in runs) if v is not None] for runs in by_log]
    averages = [average(values, rms=rms) for values in known if values]
    return f"{average(averages, rms=rms):.{digits}f}" if averages else "-"


def counted(*by_log: Sequence[Row]) -> str:
    """Number of scored poses, as a range over the runs of a log, summed over logs; empty without a reference."""
    counts = [[c for row in runs if (c := scored_of(row)) is not None] for runs in by_log]
    known = [of_log for of_log in counts if of_log]
    least, most = sum(map(min, known)), sum(map(max, known))
    return (f"{least:.0f}" if least == most else f"{least:.0f} to {most:.0f}") if known else ""


def _went_well(runs: Sequence[Row]) -> str:
    return f"{sum(r['status'] == 'ok' for r in runs)}/{len(runs)}"
