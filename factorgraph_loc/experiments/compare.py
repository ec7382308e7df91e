"""Comparison of several estimators on several logs: every pair in its own process, a table, differences, and plots."""

import hashlib
import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import polars as pl

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.figures import Track
from factorgraph_loc.evaluation.inference import DIFFERENCES, differences
from factorgraph_loc.evaluation.plots import plot_log, remove_plots
from factorgraph_loc.evaluation.report import DEFAULT, RunFiles, Scene, write_report
from factorgraph_loc.evaluation.tables import BASELINE, comparison_cells, further_tables, markdown, unscored, verdict
from factorgraph_loc.evaluation.warned import WARNINGS, lines, row_of
from factorgraph_loc.experiments.output import TABLES, reason_of, remove_run, write_run, write_tables
from factorgraph_loc.experiments.preparation import check_prior, columns_of, fill_cache, use_of
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.files.models import file_name, nearest, write_text
from factorgraph_loc.files.temporary import require_free, sweep, writing
from factorgraph_loc.fusion import registry
from factorgraph_loc.io.results import FILES
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.scoring import Alignment, check_max_gap, check_tick_gap
from factorgraph_loc.processes import run_each
from factorgraph_loc.text import quoted

_ERROR = "error.txt"
_BEGUN = "unfinished.txt"  # exists until a comparison is finished, with a digest of its arguments
_PAGE = "report.html"
_WRITTEN = (*TABLES, _PAGE)


@dataclass(frozen=True)
class Comparison:
    """``rows``: one per run, all with the same keys: log, estimator, seed, status (ok, failed), reason, the scalar scores (None
    in a failed run), and ``warnings``, one per line. ``failures``: one line per failed run; ``warnings``: each once."""

    rows: list[dict[str, Any]]
    failures: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def __repr__(self) -> str:
        return told(self.rows)


def told(rows: Sequence[Mapping[str, Any]]) -> str:
    """The table of runs, and what follows from it, as text."""
    best = verdict(rows) if len({row["estimator"] for row in rows}) > 1 else []
    failures = [f"failed: {row['log']}, {row['estimator']}: {row['reason']}" for row in rows if row["status"] != "ok"]
    return "\n".join((markdown(*comparison_cells(rows)), *unscored(rows), *best, *failures))


@dataclass(frozen=True)
class _Job:
    log: Log
    config: RunConfig
    folder: Path
    align: Alignment


@dataclass(frozen=True)
class _Outcome:
    scores: dict[str, Any]
    track: Track


def compare(
    logs: Sequence[Log],
    configs: Sequence[RunConfig],
    out: Path,
    *,
    align: Alignment = "none",
    rpe: bool = False,
    jobs: int | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Comparison:
    """Run every configuration on every log, in ``jobs`` parallel processes (None: one per core).

    Deterministic estimators run with the first of their seeds only. A run that fails, or whose process dies, becomes a row with
    its reason; the others continue. Written into ``out``: ``results.parquet`` and ``results.csv`` (the rows), ``differences.csv``
    (see :func:`~factorgraph_loc.evaluation.inference.differences`), ``table.md``, ``report.html`` (see
    :func:`~factorgraph_loc.evaluation.report.write_report`), ``plots/*.png`` and ``runs/LOG/ESTIMATOR/seedK/`` with the files of
    each run, or ``error.txt`` with the traceback. ``align``: also score after this alignment, see
    :func:`~factorgraph_loc.evaluation.metrics.score`; ``rpe``: also show relative errors. Both are further tables in ``table.md``,
    and further scores in the report. ``progress`` is called with the number of runs done and of all.

    Raises InputError, before anything runs, for no logs, no configurations, two logs of one name, two configurations of one
    estimator and seed, invalid settings or prior, a sensor that no log has, or an ``out`` that contains results without
    ``overwrite``.
    """
    configs = _without_needless_seeds(configs)
    _check(logs, configs)
    _prepare(out, overwrite, _asked(logs, configs))
    work = [_Job(log, config, _folder(out, log.name, config), align) for log in logs for config in configs]
    for log in logs:
        fill_cache(
            use_of(log, c.sensors or log.rig.sensors, c.estimator, registry.settings_of(c.estimator, c.settings))
            for c in configs
        )
    outcomes: dict[int, _Outcome | Exception] = {}
    try:
        for i, outcome in run_each(_execute, work, jobs or os.cpu_count() or 1):
            outcomes[i] = outcome
            if progress is not None:
                progress(len(outcomes), len(work))
    finally:
        for folder in _folders(out):
            sweep(folder)
    rows = [_row(job, outcomes[i]) for i, job in enumerate(work)]
    keys = list(dict.fromkeys(key for row in rows for key in row))
    rows = [{key: row.get(key) for key in keys} for row in rows]
    _write_tables(rows, out, rpe=rpe)
    _write_page(rows, work, out, rpe=rpe)
    for log in logs:
        tracks: dict[str, Track] = {}
        for i, job in enumerate(work):
            outcome = outcomes[i]
            if job.log is log and isinstance(outcome, _Outcome):
                tracks.setdefault(job.config.estimator, outcome.track)  # the first seed represents all
        if tracks:
            plot_log(log, tracks, out / "plots", file_name(log.name))
    (out / _BEGUN).unlink(missing_ok=True)
    failed = [row for row in rows if row["status"] == "failed"]
    failures = [f"{r['log']}, {r['estimator']}, seed {r['seed']}: {r['reason']}" for r in failed]
    return Comparison(rows, failures, lines(rows))


def _execute(job: _Job) -> _Outcome:
    result = run(job.log, job.config)
    scores = write_run(result, job.log, job.folder, align=job.align)
    return _Outcome(scores, Track.of(result))


def _without_needless_seeds(configs: Sequence[RunConfig]) -> list[RunConfig]:
    kept: list[RunConfig] = []
    first: list[RunConfig] = []  # of deterministic estimators
    for config in configs:
        if _is_deterministic(config.estimator):
            if any(replace(one, seed=config.seed) == config for one in first):
                continue
            first.append(config)
        kept.append(config)
    return kept


def _is_deterministic(estimator: str) -> bool:
    return bool(registry.estimator_type(estimator).deterministic)


def _check(logs: Sequence[Log], configs: Sequence[RunConfig]) -> None:
    if not logs or not configs:
        raise InputError("there is nothing to compare, expected at least one log and one estimator")
    streams = list(dict.fromkeys(name for log in logs for name in (*log.streams, *columns_of(log.streams))))
    for config in configs:
        registry.settings_of(config.estimator, config.settings)
        check_prior(config.prior)
        check_max_gap(config.max_gap)
        check_tick_gap(config.tick_gap)
        for sensor in config.sensors or ():
            if sensor not in streams:
                raise InputError(f"no log has a sensor {quoted(sensor)}{nearest(sensor, streams)}")
    names = [file_name(log.name) for log in logs]
    for log, name in zip(logs, names, strict=True):
        if names.count(name) > 1:
            raise InputError(f"two logs are called {log.name}, expected different names")
    pairs = Counter((config.estimator, config.seed) for config in configs)
    if twice := [pair for pair, count in pairs.items() if count > 1]:
        raise InputError(f"{twice[0][0]} with seed {twice[0][1]} is given twice")


def _asked(logs: Sequence[Log], configs: Sequence[RunConfig]) -> str:
    return hashlib.sha256(repr(([log.name for log in logs], configs)).encode()).hexdigest()[:16]


def check_free(out: Path, *, overwrite: bool, asked: str | None = None) -> None:
    """Raise InputError if ``out`` is not a folder, or contains results that must not be replaced. Those of an unfinished
    comparison may be replaced by the same one, identified by ``asked``."""
    try:
        begun = (out / _BEGUN).read_text(encoding="ascii", errors="replace").split()[0]
    except (OSError, IndexError):
        begun = None
    names = (*_WRITTEN, *FILES, *(str(run.relative_to(out)) for run in _runs(out)))
    same = begun is not None and asked in (None, begun)
    require_free(out, names, overwrite=overwrite or same, folders=_folders(out))


def _folders(out: Path) -> list[Path]:
    return [out.parent, out, out / "plots", *out.glob("runs/*/*")]


def _runs(out: Path) -> list[Path]:
    return sorted(out.glob("runs/*/*/seed*"))


def _prepare(out: Path, overwrite: bool, asked: str) -> None:
    """Check ``out``, and remove the files of a previous comparison."""
    check_free(out, overwrite=overwrite, asked=asked)
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        write_text(out / _BEGUN, f"{asked} of an unfinished comparison; the same command starts it again\n")
    for name in _WRITTEN:
        (out / name).unlink(missing_ok=True)
    remove_plots(out / "plots")
    for folder in _runs(out):
        remove_run(folder)
        (folder / _ERROR).unlink(missing_ok=True)
        with suppress(OSError):  # the folder contains other files
            folder.rmdir()


def _folder(out: Path, log: str, config: RunConfig) -> Path:
    return out / "runs" / file_name(log) / config.estimator / f"seed{config.seed}"


def _row(job: _Job, outcome: _Outcome | Exception) -> dict[str, Any]:
    row: dict[str, Any] = {"log": job.log.name, "estimator": job.config.estimator, "seed": job.config.seed}
    if isinstance(outcome, _Outcome):
        return row | {"status": "ok", "reason": None} | row_of(outcome.scores)
    failure = {"status": "failed", "reason": reason_of(outcome, job.folder / _ERROR)}
    return row | failure | row_of({WARNINGS: list(job.log.warnings)})


def _write_tables(rows: Sequence[Mapping[str, Any]], out: Path, *, rpe: bool) -> None:
    text = markdown(*comparison_cells(rows))
    for title, columns in further_tables(rows, rpe=rpe).items():
        text += f"\n{title}\n\n{markdown(*comparison_cells(rows, columns))}"
    compared = pl.DataFrame(differences(rows), schema=DIFFERENCES)
    write_tables(pl.DataFrame(rows, infer_schema_length=None), compared, text, out)


def _write_page(rows: Sequence[Mapping[str, Any]], work: Sequence[_Job], out: Path, *, rpe: bool) -> None:
    keys = [str(i) for i in range(len(work))]
    scenes = {job.log.name: Scene.of(job.log) for job in work}

    def files(key: str) -> RunFiles:
        job = work[int(key)]
        return RunFiles(lambda name: (job.folder / name).read_bytes(), scenes[job.log.name])

    table = pl.DataFrame(rows, infer_schema_length=None).with_columns(key=pl.Series(keys))
    names = list(dict.fromkeys(job.config.estimator for job in work))
    baseline = BASELINE if BASELINE in names else None
    asked = {"logs": list(scenes), "estimators": names}
    further = [key for columns in further_tables(rows, rpe=rpe).values() for key, *_ in columns.values()]
    metrics = (*DEFAULT, *further)
    write_report(table, files, out / _PAGE, metrics=metrics, baseline=baseline, title="Comparison", experiment=asked)
