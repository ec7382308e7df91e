"""Experiments with active localization: worlds, policies and estimators on the same seeds, in parallel processes.

Finished parts are stored meanwhile, so that an interrupted experiment can be resumed.
"""

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.figures import write_picture
from factorgraph_loc.evaluation.tables import markdown
from factorgraph_loc.experiments import output
from factorgraph_loc.experiments.active_results import (
    DIFFERENCES,
    comparison,
    difference_cells,
    differences,
    run_picture,
    summary_cells,
)
from factorgraph_loc.files.models import file_name, nearest, write_toml
from factorgraph_loc.files.tables import read_parquet, write_parquet
from factorgraph_loc.files.temporary import require_free, writing
from factorgraph_loc.planning.closed_loop import ActiveRun, run_active
from factorgraph_loc.planning.settings import ActiveSettings
from factorgraph_loc.plugins import ACTIVE_ESTIMATORS, POLICIES
from factorgraph_loc.processes import run_each
from factorgraph_loc.simulation.settings import SimulationSettings
from factorgraph_loc.text import quoted
from factorgraph_loc.version import __version__

CHUNK = 10  # seeds that run with all policies before the next ones do
FILES = (*output.TABLES, "config.toml")
PARTS, PLOTS = "parts", "plots"
ROW: dict[str, Any] = {
    **dict.fromkeys(("world", "policy", "estimator"), pl.String),
    "seed": pl.Int64,
    **dict.fromkeys(("status", "reason"), pl.String),
    "localized": pl.Boolean,
    **dict.fromkeys(("metres", "seconds", "error_position", "error_heading"), pl.Float64),
    "claimed_wrong": pl.Boolean,
    "steps": pl.Int64,
    **dict.fromkeys(("planning_ms", "planning_ms_max"), pl.Float64),
}
Row = dict[str, Any]


@dataclass(frozen=True)
class ActiveJob:
    """A run, for :func:`run_jobs`; plotted if ``pictured``."""

    simulation: SimulationSettings
    policy: str
    estimator: str
    seed: int
    settings: ActiveSettings
    folder: Path
    pictured: bool = False

    @property
    def name(self) -> str:
        """World, estimator and policy."""
        return file_name(f"{self.simulation.name}-{self.estimator}-{self.policy}")

    @property
    def part(self) -> Path:
        """The file with the row of this run, specific to settings and version."""
        told: list[Any] = [__version__, self.policy, self.estimator, self.seed, self.pictured]
        told += [model.model_dump(mode="json") for model in (self.simulation, self.settings)]
        key = hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:12]
        return self.folder / PARTS / f"{self.name}-{self.seed}-{key}.parquet"


@dataclass(frozen=True)
class ActiveResults:
    """``rows``: one per run, with the keys of :data:`ROW`; ``status`` is ok, refused (bad input) or failed; unless ok, there are
    only the identification of the run and a ``reason``. ``failures``: one line for each of those."""

    rows: list[Row]
    failures: list[str] = field(default_factory=list)


def seek(
    simulation: SimulationSettings,
    policies: Sequence[str],
    estimators: Sequence[str],
    seeds: Sequence[int],
    out: Path,
    settings: ActiveSettings | None = None,
    *,
    jobs: int | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> ActiveResults:
    """Run every policy with every estimator on every seed, in ``jobs`` parallel processes (None: one per core).

    Written into ``out``: ``results.parquet`` and ``results.csv`` (a row per run), ``differences.csv`` (see
    :func:`~factorgraph_loc.experiments.active_results.differences`), ``table.md``, ``config.toml``, ``plots/comparison.png``
    and for each policy and estimator a plot of the run of the first seed. A failed run is a row with its reason; the others
    continue. The same call resumes an interrupted experiment. ``progress`` is called with the number of runs done and of all.

    Raises InputError, before anything runs, for an unknown or repeated policy or estimator, or an ``out`` that contains results
    without ``overwrite``; and if all runs are refused for their input.
    """
    _check_names("policy", policies, tuple(POLICIES))
    _check_names("estimator", estimators, ACTIVE_ESTIMATORS)
    settings = ActiveSettings() if settings is None else settings
    check_free(out, overwrite=overwrite)
    with writing(out):
        (out / PLOTS).mkdir(parents=True, exist_ok=True)
    if overwrite:
        remove_results(out)
    work = jobs_of(simulation, policies, estimators, seeds, out, settings, pictured=seeds[0])
    results = run_jobs(work, jobs or os.cpu_count() or 1, progress)
    if all(row["status"] == "refused" for row in results.rows):
        raise InputError(str(results.rows[0]["reason"]))
    config: dict[str, Any] = {
        "version": __version__,
        "policies": list(policies),
        "estimators": list(estimators),
        "seeds": list(seeds),
    }
    for name, model in (("settings", settings), ("simulation", simulation)):
        config[name] = model.model_dump(mode="json", exclude_none=True)
    write_toml(out / "config.toml", config)
    write_tables(results.rows, out)
    write_picture(comparison(results.rows), out / PLOTS / "comparison.png")
    for job in work:
        job.part.unlink(missing_ok=True)
    with suppress(OSError):  # the rest of the folder stays
        (out / PARTS).rmdir()
    return results


def jobs_of(
    simulation: SimulationSettings,
    policies: Sequence[str],
    estimators: Sequence[str],
    seeds: Sequence[int],
    folder: Path,
    settings: ActiveSettings,
    pictured: int | None = None,
) -> list[ActiveJob]:
    """The jobs of all these runs, ordered such that all policies of some seeds come before the next seeds."""
    return [
        ActiveJob(simulation, policy, estimator, seed, settings, folder, seed == pictured)
        for chunk in (seeds[i : i + CHUNK] for i in range(0, len(seeds), CHUNK))
        for estimator in estimators
        for policy in policies
        for seed in chunk
    ]


def run_jobs(
    jobs: Sequence[ActiveJob], workers: int, progress: Callable[[int, int], None] | None = None
) -> ActiveResults:
    """The rows of all jobs in order. Parts from a previous call are read, new ones are stored."""
    found = {i: read_parquet(job.part).to_dicts()[0] for i, job in enumerate(jobs) if job.part.exists()}
    left = [i for i in range(len(jobs)) if i not in found]
    report = progress or (lambda _done, _total: None)
    report(len(found), len(jobs))
    for at, outcome in run_each(run_job, [jobs[i] for i in left], workers, lasting=True):
        job = jobs[left[at]]
        found[left[at]] = _failed(job, outcome) if isinstance(outcome, Exception) else outcome
        report(len(found), len(jobs))
    rows = [found[i] for i in range(len(jobs))]
    failures = [
        f"{row['world']}, {row['policy']}, {row['estimator']}, seed {row['seed']}: {row['reason']}"
        for row in rows
        if row["status"] != "ok"
    ]
    return ActiveResults(rows, failures)


def run_job(job: ActiveJob) -> Row:
    """The row of a run, stored as its part; can be sent to other processes."""
    run = run_active(job.simulation, job.policy, job.estimator, job.seed, job.settings)
    if job.pictured:
        write_picture(run_picture(run), job.folder / PLOTS / f"{job.name}-seed{job.seed}.png")
    row = row_of(run)
    job.part.parent.mkdir(parents=True, exist_ok=True)
    write_parquet(pl.DataFrame([row], schema=ROW), job.part)
    return row


def row_of(run: ActiveRun) -> Row:
    """The row of a run in tables."""
    times = run.planning_ms
    return {
        "world": run.preset,
        "policy": run.policy,
        "estimator": run.estimator,
        "seed": run.seed,
        "status": "ok",
        "reason": None,
        "localized": run.localized,
        "metres": run.metres,
        "seconds": run.seconds,
        "error_position": run.error_position,
        "error_heading": run.error_heading,
        "claimed_wrong": run.claimed_wrong,
        "steps": len(run.steps),
        "planning_ms": float(np.median(times)) if len(times) else None,
        "planning_ms_max": float(np.max(times)) if len(times) else None,
    }


def write_tables(rows: Sequence[Row], out: Path) -> None:
    """Write :data:`~factorgraph_loc.experiments.output.TABLES` into a folder."""
    text = markdown(*summary_cells(rows)) + "\n" + markdown(*difference_cells(rows))
    compared = pl.DataFrame(differences(rows), schema=DIFFERENCES)
    output.write_tables(pl.DataFrame(rows, schema=ROW), compared, text, out)


def check_free(out: Path, *, overwrite: bool) -> None:
    """Raise InputError if ``out`` is not a folder, or contains results that must not be replaced. Parts are allowed."""
    require_free(out, FILES, overwrite=overwrite, folders=(out / PARTS, out / PLOTS))


def remove_results(out: Path) -> None:
    """Remove the results and parts of a previous experiment, and nothing else."""
    for name in FILES:
        (out / name).unlink(missing_ok=True)
    for pattern in (f"{PARTS}/*.parquet", f"{PARTS}/*.error.txt", f"{PLOTS}/*.png"):
        for path in out.glob(pattern):
            path.unlink()


def _check_names(what: str, names: Sequence[str], known: Sequence[str]) -> None:
    if not names:
        raise InputError(f"no {what} is given; known: {', '.join(known)}")
    for name in names:
        if name not in known:
            raise InputError(f"unknown {what} {quoted(name)}{nearest(name, list(known))}")
        if list(names).count(name) > 1:
            raise InputError(f"{what} {name} is given twice")


def _failed(job: ActiveJob, error: Exception) -> Row:
    status = "refused" if isinstance(error, InputError) else "failed"
    reason = output.reason_of(error, job.part.with_name(f"{job.name}-{job.seed}.error.txt"))
    known = (job.simulation.name, job.policy, job.estimator, job.seed, status, reason)
    return {**dict.fromkeys(ROW), **dict(zip(ROW, known, strict=False))}
