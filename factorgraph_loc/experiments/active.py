"""Experiments with active localization: policies and estimators are compared on the same simulated worlds and seeds.

The runs are executed in parallel processes and stored like those of other experiments. An interrupted experiment can be resumed.
"""

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
from factorgraph_loc.experiments.execute import Files, failure
from factorgraph_loc.experiments.experiment import Done, Prepared, run_experiment
from factorgraph_loc.experiments.experiment_file import NO_TIME_LIMIT, Limits
from factorgraph_loc.experiments.keys import digest_of
from factorgraph_loc.experiments.store import METRICS, Store
from factorgraph_loc.files.models import file_name, nearest, parse_model, write_bytes, write_toml
from factorgraph_loc.files.temporary import require_free, writing
from factorgraph_loc.planning.closed_loop import ActiveRun, run_active
from factorgraph_loc.planning.settings import ActiveSettings
from factorgraph_loc.plugins import ACTIVE_ESTIMATORS, POLICIES
from factorgraph_loc.simulation import SimulationSettings, named_settings
from factorgraph_loc.text import json_text, quoted
from factorgraph_loc.version import __version__

FILES = (*output.TABLES, "config.toml")
PLOTS, PICTURE = "plots", "run.png"


@dataclass(frozen=True)
class ActiveJob:
    """A planned simulation of active localization: a robot chooses its path in order to localize itself.

    ``simulation``: the simulated world. ``policy``: name of the method that chooses the path. ``estimator``: name of
    the estimator of the pose. ``seed``: of all random numbers. ``settings``: settings of robot and policy.
    ``pictured``: whether to plot the run.
    """

    simulation: SimulationSettings
    policy: str
    estimator: str
    seed: int
    settings: ActiveSettings
    pictured: bool

    @property
    def source(self) -> str:
        """The name of the world."""
        return self.simulation.name

    @property
    def key(self) -> str:
        """The key of the stored results: a hash of all fields and of the version of the package."""
        given: list[Any] = [__version__, self.policy, self.estimator, self.seed, self.pictured]
        return digest_of(given + [model.model_dump(mode="json") for model in (self.simulation, self.settings)])

    def make(self) -> Files:
        """Execute the run, and return {file name: content}: scores as JSON, and a plot as PNG if ``pictured`` is true.
        If the run rejects its input, the only file describes the failure."""
        try:
            run = run_active(self.simulation, self.policy, self.estimator, self.seed, self.settings)
        except InputError as error:
            return failure("refused", str(error))
        files = {METRICS: json_text(figures_of(run)).encode()}
        return files | ({PICTURE: png_bytes(run_picture(run))} if self.pictured else {})

    @property
    def shown(self) -> str:
        """A description that distinguishes this run from the other runs, for messages."""
        return f"{self.source}, {self.policy}, {self.estimator}, seed {self.seed}"

    @property
    def columns(self) -> dict[str, Any]:
        """World, policy, estimator, seed and key of the run: the first columns of its row in the table of results."""
        named = {"world": self.source, "policy": self.policy, "estimator": self.estimator, "seed": self.seed}
        return named | {"key": self.key}


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
    """Simulate robots that drive from an unknown start until they are localized, and compare policies for their paths.

    There is a run for each policy, estimator and seed. ``world``: a preset of
    :func:`~factorgraph_loc.api.logs.simulate`, a TOML file, or settings. ``out``: folder for the results.
    ``overwrite``: replace existing results. ``changes``: nested settings, such as ``{"policy": {"horizon": 8}}``.
    ``jobs``: number of processes, None for one per core. ``progress``: called with numbers of finished and all runs.

    The files in ``out`` are ``results.parquet``, ``results.csv`` (a row for each run), ``differences.csv`` (see
    :func:`~factorgraph_loc.experiments.active_results.differences`), ``table.md``, ``config.toml`` and
    ``plots/comparison.png``. For each policy and estimator there is a plot of the run with the first seed. A failed run
    has a row with the reason. The same call resumes an interrupted experiment. Raises InputError for an unknown or
    repeated name, for results in ``out`` without ``overwrite``, or if every run rejects its input.
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
    work = [
        ActiveJob(simulation, policy, estimator, seed, settings, pictured=seed == seeds[0])
        for seed in seeds
        for estimator in estimators
        for policy in policies
    ]
    Store(out).create()
    results = run_experiment(
        Prepared.of(out, work, Limits(time=NO_TIME_LIMIT)),
        jobs=jobs,
        again=True,
        progress=lambda made, total, _failed: progress(made, total),
    )
    if results.table["kind"].eq_missing("refused").all():
        raise InputError(str(results.table["reason"][0]))
    config = {
        "version": __version__,
        "policies": list(policies),
        "estimators": list(estimators),
        "seeds": seeds,
        "settings": settings.model_dump(mode="json", exclude_none=True),
        "simulation": simulation.model_dump(mode="json", exclude_none=True),
    }
    write_toml(out / "config.toml", config)
    _write(results.table, work, out)
    return results


def _write(table: pl.DataFrame, jobs: Sequence[ActiveJob], out: Path) -> None:
    """Write the tables and plots of all runs into ``out``. ``table``: the results, with a row for each of ``jobs``."""
    rows = table.to_dicts()
    text = markdown(*summary_cells(rows)) + "\n" + markdown(*difference_cells(rows))
    output.write_tables(table, pl.DataFrame(differences(rows), schema=DIFFERENCES), text, out)
    write_picture(comparison(rows), out / PLOTS / "comparison.png")
    for job, row in zip(jobs, rows, strict=True):
        if job.pictured and row["status"] == "ok":
            name = file_name(f"{job.source}-{job.estimator}-{job.policy}-seed{job.seed}.png")
            write_bytes(out / PLOTS / name, Store(out).read(job.key, PICTURE))


def _settings(
    world: str | Path | SimulationSettings, changes: Mapping[str, Any]
) -> tuple[SimulationSettings, ActiveSettings]:
    """Return the settings of the simulated world and of the run. ``changes``: values that replace settings, by key.
    Raises InputError for an unknown key."""
    of_run, of_world = ActiveSettings.model_fields, SimulationSettings.model_fields
    for key in changes:
        if key not in of_run and key not in of_world:
            raise InputError(f"unknown key {key}{nearest(key, [*of_run, *of_world])}")
    changed = {key: value for key, value in changes.items() if key in of_world}
    if isinstance(world, SimulationSettings) and changed:
        raise InputError(
            "the world is given as settings, so its keys cannot be changed: name a preset or a file, or edit the settings"
        )
    simulation = world if isinstance(world, SimulationSettings) else named_settings(str(world), changed)
    run = {key: value for key, value in changes.items() if key in of_run}
    return simulation, parse_model(ActiveSettings, run, "the settings")


def figures_of(run: ActiveRun) -> dict[str, float | None]:
    """Return the scores of a run as {column of the table of results: value}, such as ``metres`` and ``planning_ms``."""
    times = run.planning_ms
    return {
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


def _check_names(what: str, names: Sequence[str], known: Sequence[str]) -> None:
    """Raise InputError if ``names`` is empty, or a name is repeated or not in ``known``. ``what``: such as "policy"."""
    if not names:
        raise InputError(f"no {what} is given; known: {', '.join(known)}")
    for name in names:
        if name not in known:
            raise InputError(f"unknown {what} {quoted(name)}{nearest(name, list(known))}")
        if list(names).count(name) > 1:
            raise InputError(f"{what} {name} is given twice")
