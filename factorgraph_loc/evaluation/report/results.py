"""The results of an experiment for its report: scores of runs, and the trajectories, errors and configurations in their files.

A variant is an estimator with its sensors and the swept settings of the estimator.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import polars as pl

from factorgraph_loc.evaluation.inference import (
    SIGNIFICANT,
    ByLog,
    Contrast,
    Pooled,
    contrast,
    holm,
    least_p,
    mean_nees_band,
    pooled,
)
from factorgraph_loc.evaluation.metrics import FEWEST_SCORED
from factorgraph_loc.evaluation.report import tracks
from factorgraph_loc.evaluation.report.tracks import Scene
from factorgraph_loc.evaluation.scores import Metric
from factorgraph_loc.evaluation.warned import SIMULATION, SWEEP, Row, label_of
from factorgraph_loc.io.results import CONFIG, Estimates, ResultFiles
from factorgraph_loc.model.scoring import KINDS
from factors.se2 import Array

POSES = 120_000  # maximum number of poses on the page, which all trajectories share
FEWEST, MOST = 60, 1000  # minimum and maximum number of poses of one trajectory
TRACKS = 1000  # maximum number of runs with trajectories; logs of further runs are in tables only


Runs = Callable[[str], tuple[ResultFiles, Scene | None]]
"""Returns the files of a successful run, and the map of its log or None, by the key of the run."""


@dataclass
class RunData:
    """The data of a report that are read from the files of all runs.

    ``tracks``: by log, its map and trajectories with a reduced number of poses. ``errors``: by kind of trajectory
    (causal, final), then by variant and log, quantiles of the position error [m]. ``nees``: by variant and log, the
    mean NEES of the causal poses. ``trust``: by variant, the mean of ``nees`` over logs and the bounds of its 95 %
    interval for correct covariances. ``configs``: {variant, log and seed as text: content of the run's config file}.
    """

    tracks: dict[str, dict[str, Any]] = field(default_factory=dict)
    errors: dict[str, dict[tuple[str, str], Array]] = field(default_factory=lambda: {kind: {} for kind in KINDS})
    nees: dict[tuple[str, str], float] = field(default_factory=dict)
    trust: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    configs: dict[str, str] = field(default_factory=dict)


def read_runs(results: Results, metric: str, runs: Runs) -> RunData:
    """Return the data that a report needs from the files of all successful runs. ``results``: the runs. ``runs``: a
    function that returns the files of a run by its key. ``metric``: key of a score. If a variant ran with several seeds
    on a log, the trajectory with the median of this score is used."""
    data = RunData()
    chosen = {
        (variant, log): row
        for log in results.logs
        for variant in results.variants
        if (row := results.representative(variant, log, metric)) is not None
    }
    poses = min(MOST, max(FEWEST, POSES // (len(KINDS) * max(1, min(len(chosen), TRACKS)))))
    counts: dict[str, list[tuple[float, float, int]]] = {}
    left = TRACKS
    for log in results.logs:
        drawn: list[dict[str, Any]] = []
        scene: Scene | None = None
        for place, variant in enumerate(results.variants):
            row = chosen.get((variant, log))
            if row is None:
                continue
            files, background = runs(str(row["key"]))
            scene = scene or background
            series = _series(files)
            if left > 0:
                plain = {kind: tracks.thinned(s, poses) for kind, s in series.items()}
                drawn.append({"v": place, "seed": row["seed"], **plain})
                data.configs[f"{variant}, {log}, seed {row['seed']}"] = files.read(CONFIG).decode()
            trust = tracks.consistency(series["causal"]) if "causal" in series else None
            if trust is not None and score(row, "causal.position_rmse") is not None:
                counts.setdefault(variant, []).append(trust)
                data.nees[variant, log] = trust[0]
            well = [run for run in results.runs(variant, log) if run["status"] == "ok"]
            every = [(run, series if run is row else _series(runs(str(run["key"]))[0])) for run in well]
            for kind in KINDS:
                scored = [
                    s[kind].errors["error_position"]
                    for run, s in every
                    if kind in s and score(run, f"{kind}.position_rmse") is not None
                ]
                if len(quantiles := tracks.quantiles(scored)):
                    data.errors[kind][variant, log] = quantiles
        if drawn:
            data.tracks[log] = {"scene": scene.model_dump() if scene else None, "runs": drawn}
            left -= len(drawn)
    for variant, values in counts.items():
        means, independent, dofs = zip(*values, strict=True)
        band = mean_nees_band(independent, dofs)
        data.trust[variant] = (sum(means) / len(means), *band)
    return data


def _series(files: ResultFiles) -> dict[str, Estimates]:
    """Return the estimates of a run as {"causal" or "final": estimates}, without trajectories that have no poses."""
    return {kind: estimates for kind, estimates in files.estimates().items() if len(estimates.trajectory)}


@dataclass(frozen=True)
class MetricComparison:
    """Comparison of the variants (estimators with certain settings and sensors) by one metric.

    ``pooled``: by variant, the pooled score; variants without scores are missing. ``best``: the best of the variants
    that have a score on every log, None if there is none. ``reference``: the variant with which the others are
    compared. ``contrasts``: by variant, the difference from the reference. ``p``: by variant, the p value, corrected
    for the number of comparisons.
    """

    metric: Metric
    pooled: dict[str, Pooled]
    best: str | None
    reference: str
    contrasts: dict[str, Contrast]
    p: dict[str, float | None]

    @property
    def tied(self) -> list[str]:
        """The variants without a significant difference from the reference. Empty if none could be significant."""
        return [v for v, p in self.p.items() if self.has_power and p is not None and not self.is_significant(v)]

    @property
    def different(self) -> list[str]:
        """The variants that differ significantly from the reference."""
        return [v for v in self.contrasts if self.is_significant(v)]

    @property
    def incomplete(self) -> list[str]:
        """The variants that lack a score on some of the logs that the best variant has."""
        assert self.best is not None
        return [v for v, c in self.contrasts.items() if c.count < self.pooled[self.best].count]

    @property
    def has_power(self) -> bool:
        """True if a difference can be significant, which requires enough logs for the number of comparisons."""
        tested = [c.count for name, c in self.contrasts.items() if self.p[name] is not None]
        return bool(tested) and least_p(max(tested)) * len(tested) < SIGNIFICANT

    def is_significant(self, variant: str) -> bool:
        """True if a variant differs significantly from the reference."""
        p = self.p.get(variant)
        return p is not None and p < SIGNIFICANT


class Results:
    """The runs of an experiment by variant and log. A variant is an estimator with certain settings and sensors.

    ``variants``: {name of a variant on the page: its label}. ``logs``: {name of a log on the page: its name}. A log
    with a swept setting of the simulation has several names on the page, but counts as one log in tests. ``rows``: all
    runs as dictionaries. ``sweeps``: columns of the swept settings that vary.
    """

    def __init__(self, rows: pl.DataFrame) -> None:
        self.rows: Sequence[Row] = rows.to_dicts()
        self.sweeps = [c for c in rows.columns if c.startswith(SWEEP) and rows[c].drop_nulls().n_unique() > 1]
        several = _labels_with_several_sensors(self.rows)
        self.variants: dict[str, str] = {}
        self.logs: dict[str, str] = {}
        self._runs: dict[tuple[str, str], list[Row]] = {}
        self._pooled: dict[tuple[str, str], Pooled | None] = {}
        for row in self.rows:
            variant, log = self._variant(row, several), self._log(row)
            self.variants.setdefault(variant, label_of(row))
            self.logs.setdefault(log, str(row["log"]))
            self._runs.setdefault((variant, log), []).append(row)

    def runs(self, variant: str, log: str) -> list[Row]:
        """Return the runs of the variant with this name on a log, as rows with the seed and the scores."""
        return self._runs.get((variant, log), [])

    def of(self, variant: str) -> list[Row]:
        """Return the runs of the variant with this name on all logs, as rows with the seed and the scores."""
        return [row for log in self.logs for row in self.runs(variant, log)]

    def scores(self, metric: str, variant: str) -> dict[str, dict[int, float | None]]:
        """Return the score ``metric`` of a variant as {log: {seed: value}}. Failed runs and missing scores are None."""
        by_log = {log: {row["seed"]: score(row, metric) for row in self.runs(variant, log)} for log in self.logs}
        return {log: seeds for log, seeds in by_log.items() if seeds}

    def representative(self, variant: str, log: str, metric: str) -> Row | None:
        """Return the run of a variant on a log with the median of the score ``metric``. Without scores, return the
        first successful run, or None if there is none."""
        well = [row for row in self.runs(variant, log) if row["status"] == "ok"]
        ranked = sorted((s, i) for i, row in enumerate(well) if (s := score(row, metric)) is not None)
        return well[ranked[(len(ranked) - 1) // 2][1]] if ranked else next(iter(well), None)

    def compare(self, metric: Metric, reference: str | None = None) -> MetricComparison:
        """Return a comparison of all variants with the variant ``reference`` by the score ``metric``. If ``reference``
        is None, the best variant is the reference, and intervals are not computed."""
        scores = {name: self.scores(metric.key, name) for name in self.variants}
        figures = {name: p for name in scores if (p := self._pool(metric, name, scores[name])) is not None}
        best = _best(metric, scores, figures)
        against = reference or best or next(iter(self.variants))
        compared = {
            name: contrast(
                scores[name], scores[against], rms=metric.rms, interval=reference is not None, alike=self.logs
            )
            for name in scores
            if name != against
        }
        contrasts = {name: c for name, c in compared.items() if c is not None}
        corrected = holm([c.p for c in contrasts.values()])
        return MetricComparison(metric, figures, best, against, contrasts, dict(zip(contrasts, corrected, strict=True)))

    def unscored(self) -> list[str]:
        """Return the logs with a run that has some poses to compare with the reference, but too few for scores."""
        kinds = [f"{kind}.scored" for kind in KINDS]
        return [
            log
            for log in self.logs
            if any(
                0 < (row.get(kind) or 0) < FEWEST_SCORED
                for name in self.variants
                for row in self.runs(name, log)
                for kind in kinds
            )
        ]

    def _pool(self, metric: Metric, variant: str, scores: ByLog) -> Pooled | None:
        """Return the pooled score of a variant, from a cache if possible. Return None if there are no scores."""
        key = (metric.key, variant)
        if key not in self._pooled:
            self._pooled[key] = pooled(scores, rms=metric.rms, alike=self.logs)
        return self._pooled[key]

    def _variant(self, row: Row, several: set[str]) -> str:
        """Return the name of the variant of a run. ``several``: labels that ran with several sets of sensors."""
        label = label_of(row)
        sensors = [(row["sensors"] or "the rig's sensors").replace(",", ", ")] if label in several else []
        return _named(label, [*sensors, *self._swept(row, of_log=False)])

    def _log(self, row: Row) -> str:
        """Return the name of the log of a run on the page, with the swept settings of the simulation."""
        return _named(str(row["log"]), self._swept(row, of_log=True))

    def _swept(self, row: Row, *, of_log: bool) -> list[str]:
        """Return the swept settings of a run as texts "name value". ``of_log``: settings of the simulation if true,
        else of the estimator."""
        known = [c for c in self.sweeps if row.get(c) is not None and of_log == c.startswith(f"{SWEEP}{SIMULATION}.")]
        return [f"{short_name(c)} {f'{row[c]:g}' if isinstance(row[c], float) else row[c]}" for c in known]


def _named(name: str, parts: Sequence[str]) -> str:
    return f"{name} ({'; '.join(parts)})" if parts else name


def short_name(key: str) -> str:
    """Return the last part of a dotted name with blanks for underscores: "final.position_rmse" becomes "position
    rmse"."""
    return key.rpartition(".")[2].replace("_", " ")


def score(row: Row, metric: str) -> float | None:
    """Return the score ``metric`` of a run. None if the run failed, has no such score, or has too few scored poses.

    Update times of batch estimators are None, because their updates only collect measurements.
    """
    kind = metric.partition(".")[0]
    if metric.startswith("timing.update") and row.get("time_to_localized") is None:
        return None
    scored = row.get(f"{kind}.scored")
    value = row.get(metric)
    if row["status"] != "ok" or value is None or (scored is not None and scored < FEWEST_SCORED):
        return None
    return float(value)


def _best(metric: Metric, scores: Mapping[str, ByLog], figures: Mapping[str, Pooled]) -> str | None:
    """Return the variant with the best pooled score, or None. Only variants with a score on all logs are compared.
    ``scores``: by variant, {log: {seed: score}}. ``figures``: by variant, the pooled score."""
    if metric.better is None or not figures:
        return None
    complete = {
        name: {log for log, seeds in scores[name].items() if any(v is not None for v in seeds.values())}
        for name in figures
    }
    every = set().union(*complete.values())
    whole = [name for name in figures if complete[name] == every]
    pick = min if metric.better == "low" else max
    return pick(whole, key=lambda name: figures[name].value) if whole else None


def _labels_with_several_sensors(rows: Sequence[Row]) -> set[str]:
    """Return the labels that ran with several sets of sensors."""
    met: dict[str, set[str | None]] = {}
    for row in rows:
        met.setdefault(label_of(row), set()).add(row.get("sensors"))
    return {label for label, sensors in met.items() if len(sensors) > 1}
