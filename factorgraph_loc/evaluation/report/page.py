"""One self-contained HTML file of an experiment's results: text, tables, charts, and what is needed to repeat them.

The page loads nothing: style, script and data are included, and its content security policy forbids everything else, so that an
unescaped string could not run. The same results give the same bytes.
"""

import base64
import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

import polars as pl
import tomli_w

from factorgraph_loc.drawing.markup import Html, data, figure, join, table, tag, text
from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.report import charts, tables
from factorgraph_loc.evaluation.report.metrics import DEFAULT, Metric, metric_of
from factorgraph_loc.evaluation.report.results import (
    SWEEP,
    MetricComparison,
    Results,
    RunData,
    RunFiles,
    read_runs,
    score,
)
from factorgraph_loc.evaluation.report.summary import summary
from factorgraph_loc.evaluation.report.tracks import KINDS
from factorgraph_loc.evaluation.warned import by_text
from factorgraph_loc.files.models import write_text
from factorgraph_loc.text import listed, quoted
from factorgraph_loc.version import __version__

SCRIPTS = ("charts.js", "tracks.js", "page.js")  # of charts that can be used
SHOWN = 8  # variants that are visible initially
_SWEPT = 3  # metrics that are plotted over a swept setting


def whole_page(
    title: str, sections: Sequence[tuple[str, str]], body: Iterable[object], data: str = "", scripts: Sequence[str] = ()
) -> str:
    """An HTML page that loads nothing, of ``body``, whose ``sections`` (id and name) are linked at its head, and of ``data`` and
    ``scripts``, by their names among the assets."""
    style = _asset("page.css")
    script = "".join(_asset(name) for name in scripts)
    return Template(_asset("page.html")).substitute(
        title=text(title),
        contents=join(tag("a", name, href=f"#{identity}") for identity, name in sections),
        body=join(body, "\n"),
        data=data,
        style=style,
        style_hash=_digest(style),
        script=script,
        script_hash=_digest(script),
        version=__version__,
    )


def remark(content: str) -> Html:
    """An explanatory paragraph; a number and its percent sign are not separated."""
    return tag("p", content.replace(" %", "\u00a0%"), class_="note")


def _asset(name: str) -> str:
    return resources.files("factorgraph_loc.evaluation.report").joinpath("assets", name).read_text(encoding="utf-8")


def _digest(content: str) -> str:
    return base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()


def write_report(
    rows: pl.DataFrame,
    runs: Callable[[str], RunFiles],
    out: Path,
    *,
    metrics: Sequence[str] = DEFAULT,
    baseline: str | None = None,
    title: str = "Results",
    experiment: Mapping[str, Any] | None = None,
    damaged: Sequence[str] = (),
    versions: Mapping[str, str] | None = None,
) -> None:
    """Write the page ``out``.

    ``rows``: one per run, with key, log, estimator, seed, status (ok, failed), reason, scores, and optionally label, sensors,
    kind (of a failure) and ``sweep.*``. ``runs``: the files of a successful run, by its key. ``metrics``: scores to show.
    ``baseline``: the label that the others are compared with, by default the first. ``experiment``: the experiment file as plain
    values. ``damaged``: descriptions of runs with unusable results. ``versions``: of the software used, by default those in the
    configuration of the first run.

    Raises InputError for no rows, or a baseline that is no label.
    """
    if not len(rows):
        raise InputError(f"there are no runs to report on{f' ({len(damaged)} are damaged)' if damaged else ''}")
    results = Results(rows)
    labels = {variant.label: name for name, variant in reversed(results.variants.items())}
    if baseline is not None and baseline not in labels:
        raise InputError(f"the baseline is {quoted(baseline)}, expected one of {listed(sorted(labels))}")
    page = _Page(
        results, _known(results, metrics), labels[baseline] if baseline else next(iter(results.variants)), runs, damaged
    )
    write_text(out, page.html(title, experiment or {}, versions or {}))


@dataclass
class _Page:
    results: Results
    metrics: Sequence[Metric]
    baseline: str
    runs: Callable[[str], RunFiles]
    damaged: Sequence[str]
    plotted: list[charts.Chart] = field(default_factory=list)
    sections: list[tuple[str, str]] = field(default_factory=list)

    def html(self, title: str, experiment: Mapping[str, Any], versions: Mapping[str, str]) -> str:
        results = self.results
        drawn = read_runs(results, self.metrics[0].key, self.runs)
        best = [results.compare(metric) for metric in self.metrics]
        against = [results.compare(metric, self.baseline) for metric in self.metrics]
        body = [
            tag("section", summary(results, best, drawn.trust, self.damaged), class_="lead", id="summary"),
            self._overview(best),
            self._differences(against),
            self._by_log(),
            self._trajectories(drawn),
            self._distributions(drawn),
            self._sweeps(),
            self._consistency(drawn),
            self._times(),
            self._warnings(),
            self._failures(),
            self._repeat(experiment, versions or drawn.versions, drawn),
            self._method(),
        ]
        content = {
            "variants": list(results.variants),
            "logs": list(results.logs),
            "drawn": drawn.logs,
            "shown": SHOWN,
            "errors": drawn.errors,
            "charts": self.plotted,
        }
        held = join([data("page", content), data("config-texts", drawn.configs), *drawn.tracks])
        return whole_page(title, self.sections, body, held, SCRIPTS)

    def _section(self, identity: str, name: str, *content: object) -> Html:
        self.sections.append((identity, name))
        return tag("section", tag("h2", name), *content, id=identity)

    def _figure(self, chart: charts.Chart, title: str, caption: str = "") -> Html:
        self.plotted.append(chart)
        return figure(title, caption, data_chart=len(self.plotted) - 1)

    def _overview(self, best: Sequence[MetricComparison]) -> Html:
        results = self.results
        several = len(results.logs) > 1
        over = "each log counted once" if several else "over the seeds"
        note = (
            f"RMSEs are pooled as root mean square, the rest is averaged, {over}. Below each figure: its 95 % interval in "
            "brackets, or the range, least … most, where logs or seeds are too few for one. ● best of the column; ○ not "
            "significantly different from the best. Causal estimates use measurements up to their time, final ones the whole "
            "log; do not compare one with the other."
        )
        if len(set(results.logs.values())) < len(results.logs):
            note += " Logs that differ only in a swept setting count as one log."
        return self._section("results", "Results", remark(note), tables.overview(results, best))

    def _differences(self, against: Sequence[MetricComparison]) -> Html | str:
        if len(self.results.variants) < 2:
            return ""
        drawn = [(c, chart) for c in against if (chart := charts.ratios(self.results, c)) is not None]
        figures = [self._figure(chart, c.metric.title) for c, chart in drawn]
        note = (
            f"Each estimator minus {self.baseline}, paired by log and seed: the difference of the pooled figures, its 95 % "
            "interval (or the range over logs), the p value of the signed-rank test after Holm's correction for the number of "
            "estimators in the column, and the effect: −1 if every log is below the baseline, +1 if every log is above. Grey: "
            "not significant, or not tested."
        )
        below = (
            f"Log by log, as a multiple of {self.baseline}: a dot is a log, the bar the median over logs; left of 1 is less. "
            "Grey: not significant."
        )
        return self._section(
            "differences",
            f"Differences from {self.baseline}",
            remark(note),
            tables.differences(self.results, against),
            remark(below),
            tag("div", *figures, class_="charts"),
        )

    def _by_log(self) -> Html:
        parts = [
            tag("div", tag("h3", m.heading), tables.by_log(self.results, m), data_metric=m.heading)
            for m in self.metrics
        ]
        note = "The figure of each log, pooled over its seeds, and below it the range over them. ● best of the row."
        controls = tag("div", class_="controls")
        return self._section("by-log", "Log by log", remark(note), controls, *parts)

    def _trajectories(self, drawn: RunData) -> Html | str:
        if not drawn.tracks:
            return ""
        left = len(self.results.logs) - len(drawn.logs)
        more = f" {left} of {len(self.results.logs)} logs are not drawn, to keep the page small." if left else ""
        note = (
            "Over walls (lines), tags (squares), landmarks (triangles), mapped points (dots) and the reference (broad grey). "
            "Drag to move; click, then scroll to zoom, or pinch; double-click for all. Of several seeds the one with the "
            f"median {self.metrics[0].title} is drawn.{more}"
        )
        below = (
            "Below: position error (line) and twice the stated standard deviation in the direction in which it is largest "
            "(area). A line that is often outside of its area belongs to an overconfident estimator. Drag to select an "
            "interval; double-click for all. Of each short interval the smallest and the largest error are drawn."
        )
        return self._section(
            "trajectories",
            "Trajectories and errors over time",
            remark(note),
            tag("div", class_="controls"),
            tag("div", class_="legend"),
            tag("div", class_="map"),
            remark(below),
            tag("div", class_="strips"),
        )

    def _distributions(self, drawn: RunData) -> Html | str:
        if not any(errors for by_log in drawn.errors.values() for of in by_log for errors in of):
            return ""
        figures = [
            tag("figure", tag("h3", f"{kind} position error"), tag("div", class_="chart", data_kind=kind))
            for kind in KINDS
        ]
        note = (
            "The fraction of times at which the position error is below a value: farther left is better. Only logs that all "
            "shown estimators have are used, with equal weights."
        )
        return self._section(
            "distributions",
            "Distribution of errors",
            remark(note),
            tag("div", class_="controls"),
            tag("div", class_="legend"),
            tag("div", *figures, class_="charts"),
        )

    def _sweeps(self) -> Html | str:
        figures = []
        for column in self.results.sweeps:
            for metric in self.metrics[:_SWEPT]:
                chart = charts.sweep(self.results, column, metric)
                if chart is not None:
                    figures.append(self._figure(chart, f"{metric.title} over {column.removeprefix(SWEEP)}"))
        if not figures:
            return ""
        note = "Pooled over logs and seeds. Whiskers: the 95 % interval, or the range where logs or seeds are too few for one."
        return self._section("sweeps", "Sweeps", remark(note), tag("div", *figures, class_="charts"))

    def _consistency(self, drawn: RunData) -> Html | str:
        chart = charts.consistency(self.results, drawn.trust, drawn.nees)
        if chart is None:
            return ""
        note = (
            "The average normalised estimation error squared (ANEES) tests the stated covariances: 1 per degree of freedom is "
            "ideal, above it an estimator is overconfident, below it underconfident."
        )
        caption = (
            "A dot is a log, the bar the mean over logs. Shaded: the 95 % band of that mean for correct covariances, based on "
            "the effective number of independent values, since errors of successive poses are correlated."
        )
        return self._section("consistency", "Consistency", remark(note), self._figure(chart, "Causal ANEES", caption))

    def _times(self) -> Html | str:
        found = _known(self.results, tables.TIMINGS, whole=False)
        if not found:
            return ""
        note = (
            "Median over runs, and least … most. Wall-clock times of the machine that ran them: take ratios. An update is one "
            "stamp with a measurement of the surroundings; an estimator that waits for the end of the log has none."
        )
        drawn = [(m, chart) for m in found[:1] if (chart := charts.times(self.results, m)) is not None]
        figures = [self._figure(chart, m.title, "A dot is a log, the bar the median over logs.") for m, chart in drawn]
        return self._section("times", "Times", remark(note), tables.timing(self.results, found), *figures)

    def _warnings(self) -> Html | str:
        if not by_text(self.results.rows):
            return ""
        note = "Warnings of the runs about logs, rigs and settings that may affect the results."
        return self._section("warnings", "Warnings", remark(note), tables.warnings(self.results))

    def _failures(self) -> Html | str:
        count = sum(row["status"] != "ok" for row in self.results.rows)
        if not count:
            return ""
        note = f"{count} of {len(self.results.rows)} runs failed, and are excluded from all figures."
        return self._section("failures", "Failures", remark(note), tables.failures(self.results))

    def _repeat(self, experiment: Mapping[str, Any], versions: Mapping[str, str], drawn: RunData) -> Html:
        parts: list[object] = []
        if experiment:
            asked = tag("pre", tomli_w.dumps(_toml(experiment)))
            parts.append(tag("details", tag("summary", "Experiment file"), asked))
        if drawn.configs:
            chosen = tag("div", tag("div", class_="controls"), tag("pre"), id="configs")
            parts.append(tag("details", tag("summary", "Effective configuration of a run"), chosen, open=""))
        if versions:
            lines = table(["", "version"], versions.items())
            parts.append(tag("details", tag("summary", "Versions"), lines, open=""))
        return self._section("repeat", "To repeat it", *parts)

    def _method(self) -> Html:
        return self._section(
            "method",
            "Statistics",
            remark(
                "Runs are paired by log and seed, and logs are the statistical units. With six logs or more intervals are a "
                "percentile bootstrap that draws logs and, within each, seeds; with one log they are over its seeds, if there "
                "are six or more, and hold for this log only. Otherwise figures are listed without a test. The test is "
                "Wilcoxon's signed-rank test, two-sided, on differences by log; p values are corrected by Holm's method "
                "within each column; below 0.05 a difference is called significant. The effect is the matched-pairs "
                "rank-biserial correlation. Proportions have Wilson's interval. Trajectories are scored at the stamps of the "
                "reference, at most ten a second, without alignment; between estimates they are interpolated. There are "
                "estimates ten times a second, but none inside gaps of more than a minute (or what tick_gap says) in which no "
                "sensor measured anything."
            ),
        )


def _known(results: Results, keys: Sequence[str], *, whole: bool = True) -> list[Metric]:
    """The metrics that have any score; with ``whole`` all of them if there is none."""
    found = [metric_of(k) for k in keys if any(score(row, k) is not None for row in results.rows)]
    return found or ([metric_of(k) for k in keys] if whole else [])


def _toml(content: Any) -> Any:
    """Omit null values, which TOML lacks."""
    if isinstance(content, Mapping):
        return {str(key): _toml(value) for key, value in content.items() if value is not None}
    if isinstance(content, list | tuple):
        return [_toml(value) for value in content if value is not None]
    return content if isinstance(content, str | int | float | bool) else str(content)
