"""Experiments with active localization: worlds, policies and estimators on the same seeds, in parallel processes.

The runs are executed and stored like those of other experiments, so that an interrupted experiment can be resumed.
"""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from factorgraph_loc.drawing.figures import png_bytes
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
from factorgraph_loc.experiments.execute import Files, execute, failure
from factorgraph_loc.experiments.experiment import Done
from factorgraph_loc.experiments.experiment_file import NO_TIME_LIMIT, Limits
from factorgraph_loc.experiments.keys import digest_of
from factorgraph_loc.experiments.pool import Processes
from factorgraph_loc.experiments.store import METRICS, Store
from factorgraph_loc.files.models import file_name, nearest, parse_model, write_bytes, write_toml
from factorgraph_loc.files.temporary import require_free, writing
from factorgraph_loc.planning.closed_loop import ActiveRun, run_active
from factorgraph_loc.planning.settings import ActiveSettings
from factorgraph_loc.plugins import ACTIVE_ESTIMATORS, POLICIES
from factorgraph_loc.simulation import SimulationSettings, named_settings
from factorgraph_loc.text import json_text, quoted
from factorgraph_loc.version import __version__

CHUNK = 10  # seeds that run with all policies before the next ones do
FILES = (*output.TABLES, "config.toml")
PLOTS, PICTURE = "plots", "run.png"
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
    """A planned run; plotted if ``pictured``."""

    simulation: SimulationSettings
    policy: str
    estimator: str
    seed: int
    settings: ActiveSettings
    pictured: bool = False

    @property
    def source(self) -> str:
        """The name of the world."""
        return self.simulation.name

    @property
    def key(self) -> str:
        """The key of the results, specific to settings and version."""
        given: list[Any] = [__version__, self.policy, self.estimator, self.seed, self.pictured]
        return digest_of(given + [model.model_dump(mode="json") for model in (self.simulation, self.settings)])

    def make(self) -> Files:
        """The figures of the run, and its plot."""
        try:
            run = run_active(self.simulation, self.policy, self.estimator, self.seed, self.settings)
        except InputError as error:
            return failure("refused", str(error))
        files = {METRICS: json_text(figures_of(run)).encode()}
        return files | ({PICTURE: png_bytes(run_picture(run))} if self.pictured else {})

    def row(self, stored: Mapping[str, Any]) -> Row:
        """The row of the run, from its ``stored`` row in the store."""
        about = {"world": self.source, "policy": self.policy, "estimator": self.estimator, "seed": self.seed}
        row = {name: stored.get(name) for name in ROW} | about
        for name in ("localized", "claimed_wrong"):
            row[name] = None if row[name] is None else bool(row[name])
        return row | ({"status": "refused"} if stored["kind"] == "refused" else {})


def active(
    world: str | Path | SimulationSettings,
    out: str | Path,
    *,
    policies: Sequence[str] = ("information",),
    estimators: Sequence[str] = ("active_mcl",),
    seeds: Iterable[int] = (0,),
    changes: Mapping[str, Any] | None = None,
    jobs: int | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> Done:
    """Drive simulated robots from an unknown start until they are localized: each policy with each estimator on each seed.

    ``jobs``: number of parallel processes (None: one per core).

    ``world``: a preset of :func:`~factorgraph_loc.api.logs.simulate`, a TOML file, or settings. ``changes``: nested tables of
    settings of robot, policy or world, such as ``{"policy": {"horizon": 8}, "max_metres": 50}``.
    Written into ``out``: ``results.parquet`` and ``results.csv`` (a row per run), ``differences.csv`` (see
    :func:`~factorgraph_loc.experiments.active_results.differences`), ``table.md``, ``config.toml``, ``plots/comparison.png``
    and for each policy and estimator a plot of the run of the first seed. A failed run is a row with its reason; the others
    continue. The same call resumes an interrupted experiment. ``progress`` is called with the number of runs done and of all.

    Raises InputError before anything runs if a policy or an estimator is unknown or repeated, or if ``out`` contains results
    without ``overwrite``. It also raises InputError if the input of all runs is rejected.
    """
    simulation, settings = _settings(world, changes or {})
    seeds, out = list(seeds), Path(out)
    _check_names("policy", policies, tuple(POLICIES))
    _check_names("estimator", estimators, ACTIVE_ESTIMATORS)
    require_free(out, FILES, overwrite=overwrite)
    with writing(out):
        (out / PLOTS).mkdir(parents=True, exist_ok=True)
    for path in (*(out / name for name in FILES), *(out / PLOTS).glob("*.png")):
        path.unlink(missing_ok=True)
    work = jobs_of(simulation, policies, estimators, seeds, settings, pictured=seeds[0])
    results = run_jobs(work, out, jobs or os.cpu_count() or 1, progress)
    rows = results.rows
    if all(row["status"] == "refused" for row in rows):
        raise InputError(str(rows[0]["reason"]))
    config: dict[str, Any] = {
        "version": __version__,
        "policies": list(policies),
        "estimators": list(estimators),
        "seeds": list(seeds),
    }
    for name, model in (("settings", settings), ("simulation", simulation)):
        config[name] = model.model_dump(mode="json", exclude_none=True)
    write_toml(out / "config.toml", config)
    write_tables(rows, out)
    write_picture(comparison(rows), out / PLOTS / "comparison.png")
    for job, row in zip(work, rows, strict=True):
        if job.pictured and row["status"] == "ok":
            name = file_name(f"{job.source}-{job.estimator}-{job.policy}-seed{job.seed}.png")
            write_bytes(out / PLOTS / name, Store(out).read(job.key, PICTURE))
    return results


def _settings(
    world: str | Path | SimulationSettings, changes: Mapping[str, Any]
) -> tuple[SimulationSettings, ActiveSettings]:
    """Split the changes into settings of the world and of the run; no key belongs to both."""
    of_run, of_world = ActiveSettings.model_fields, SimulationSettings.model_fields
    for key in changes:
        if key not in of_run and key not in of_world:
            raise InputError(f"unknown key {key}{nearest(key, [*of_run, *of_world])}")
    changed = {key: value for key, value in changes.items() if key in of_world}
    if isinstance(world, SimulationSettings) and changed:
        raise InputError(
            "the world is given as settings, so no key of it can be changed: name a preset or a file, or edit the settings"
        )
    simulation = world if isinstance(world, SimulationSettings) else named_settings(str(world), changed)
    run = {key: value for key, value in changes.items() if key in of_run}
    return simulation, parse_model(ActiveSettings, run, "the settings")


def jobs_of(
    simulation: SimulationSettings,
    policies: Sequence[str],
    estimators: Sequence[str],
    seeds: Sequence[int],
    settings: ActiveSettings,
    pictured: int | None = None,
) -> list[ActiveJob]:
    """The jobs of all these runs, ordered such that all policies of some seeds come before the next seeds."""
    return [
        ActiveJob(simulation, policy, estimator, seed, settings, seed == pictured)
        for chunk in (seeds[i : i + CHUNK] for i in range(0, len(seeds), CHUNK))
        for estimator in estimators
        for policy in policies
        for seed in chunk
    ]


def run_jobs(
    jobs: Sequence[ActiveJob],
    folder: Path,
    workers: int,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> Done:
    """The results of all jobs in order, with the columns :data:`ROW`. Stored ones below ``folder`` are read, new ones are stored.

    ``status`` is ok, refused (bad input) or failed; unless ok, there are only the identification of the run and a ``reason``."""
    store = Store(folder)
    store.create()
    left = [job for job in jobs if store.state(job.key) != "ok"]
    done = len(jobs) - len(left)
    progress(done, len(jobs))
    executor = Processes(max(1, min(workers, len(left))), Limits(time=NO_TIME_LIMIT))
    for _ in execute(left, folder, executor, again=True) if left else ():
        done += 1
        progress(done, len(jobs))
    rows = [job.row(store.row(job.key)) for job in jobs]
    failures = [
        f"{row['world']}, {row['policy']}, {row['estimator']}, seed {row['seed']}: {row['reason']}"
        for row in rows
        if row["status"] != "ok"
    ]
    return Done(pl.DataFrame(rows, schema=ROW), failures, [])


def figures_of(run: ActiveRun) -> dict[str, float | None]:
    """The figures of a run in tables."""
    times = run.planning_ms
    return {
        "localized": int(run.localized),
        "metres": run.metres,
        "seconds": run.seconds,
        "error_position": run.error_position,
        "error_heading": run.error_heading,
        "claimed_wrong": int(run.claimed_wrong),
        "steps": len(run.steps),
        "planning_ms": float(np.median(times)) if len(times) else None,
        "planning_ms_max": float(np.max(times)) if len(times) else None,
    }


def write_tables(rows: Sequence[Row], out: Path) -> None:
    """Write :data:`~factorgraph_loc.experiments.output.TABLES` into a folder."""
    text = markdown(*summary_cells(rows)) + "\n" + markdown(*difference_cells(rows))
    compared = pl.DataFrame(differences(rows), schema=DIFFERENCES)
    output.write_tables(pl.DataFrame(rows, schema=ROW), compared, text, out)


def _check_names(what: str, names: Sequence[str], known: Sequence[str]) -> None:
    if not names:
        raise InputError(f"no {what} is given; known: {', '.join(known)}")
    for name in names:
        if name not in known:
            raise InputError(f"unknown {what} {quoted(name)}{nearest(name, list(known))}")
        if list(names).count(name) > 1:
            raise InputError(f"{what} {name} is given twice")
