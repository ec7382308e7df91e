"""``fgloc experiment`` and ``fgloc active`` as functions."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from factorgraph_loc.api.given import Settings
from factorgraph_loc.errors import InputError
from factorgraph_loc.experiments.active import ActiveResults, seek
from factorgraph_loc.experiments.cluster import Cluster
from factorgraph_loc.experiments.experiment import Done, Prepared, prepare, run_experiment
from factorgraph_loc.experiments.reporting import report_experiment
from factorgraph_loc.files.models import nearest, parse_model
from factorgraph_loc.planning.settings import ActiveSettings
from factorgraph_loc.simulation import SimulationSettings, named_settings

STATES = ("ok", "failed", "missing", "damaged")


@dataclass(frozen=True)
class ExperimentStatus:
    """``labels``: for each label of the plan how many runs are ok, failed, missing and damaged. ``failures``: a row for each
    failed run, with its ``reason``; ``damaged``: names of runs whose stored results are."""

    folder: Path
    labels: Mapping[str, Mapping[str, int]]
    failures: Sequence[Mapping[str, Any]]
    damaged: Sequence[str]


def experiment(
    file: str | Path,
    *,
    changes: Settings | None = None,
    out: str | Path | None = None,
    data_root: str | Path | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    retry_failed: bool = False,
    verify: bool = False,
    progress: Callable[[int, int, int], None] = lambda _done, _total, _failed: None,
) -> Done:
    """Execute those runs of an experiment file that have no stored result yet.

    ``changes``: values for dotted keys of the file, as with ``--set``. ``out``: folder of the results, by default the file's.
    ``jobs``: number of processes, by default one per core. ``scheduler``: address of a ``dask.distributed`` cluster to use
    instead. ``verify``: check the checksums of stored results and repeat damaged runs. ``progress`` is called with the numbers of
    finished, all and failed runs. A failed run is recorded as a row and in ``failures``; it raises nothing.
    """
    plan = prepare(file, changes, out=out, data_root=data_root, verify=verify)
    return execute(plan, jobs=jobs, scheduler=scheduler, retry_failed=retry_failed, progress=progress)


def execute(
    plan: Prepared,
    *,
    jobs: int | None = None,
    scheduler: str | None = None,
    retry_failed: bool = False,
    progress: Callable[[int, int, int], None] = lambda _done, _total, _failed: None,
) -> Done:
    """Execute the runs of an experiment that is prepared. For the arguments see :func:`experiment`."""
    if scheduler is not None and jobs is not None:
        raise InputError("--jobs applies to this machine, but --scheduler names a cluster: expected one of them")
    executor = None if scheduler is None else Cluster(scheduler, plan.experiment.limits)
    return run_experiment(plan, jobs=jobs, again=retry_failed, executor=executor, progress=progress)


def status(
    file: str | Path,
    *,
    changes: Settings | None = None,
    out: str | Path | None = None,
    data_root: str | Path | None = None,
    verify: bool = False,
) -> ExperimentStatus:
    """How many runs of an experiment file are done, failed, missing or damaged. For the arguments see :func:`experiment`."""
    plan = prepare(file, changes, out=out, data_root=data_root, verify=verify)
    counts = {run.label: dict.fromkeys(STATES, 0) for run in plan.runs}
    for run in plan.runs:
        counts[run.label][plan.states[run.key]] += 1
    failures = [
        {"log": run.log, "label": run.label, "seed": run.seed, **dict(run.sweep), **plan.store.row(run.key)}
        for run in plan.runs
        if plan.states[run.key] == "failed"
    ]
    return ExperimentStatus(plan.folder, counts, failures, [run.shown for run in plan.damaged()])


def report(
    file: str | Path,
    *,
    changes: Settings | None = None,
    out: str | Path | None = None,
    data_root: str | Path | None = None,
    page: str | Path | None = None,
) -> Path:
    """Write the results of an experiment as an HTML page, and return its path: ``page``, by default ``report.html`` in its
    folder.

    Damaged results are listed on the page and left out. For the other arguments see :func:`experiment`.
    """
    return report_experiment(
        prepare(file, changes, out=out, data_root=data_root), None if page is None else Path(page)
    ).page


def active(
    world: str | Path | SimulationSettings,
    out: str | Path,
    *,
    policies: Sequence[str] = ("information",),
    estimators: Sequence[str] = ("active_mcl",),
    seeds: Iterable[int] = (0,),
    changes: Settings | None = None,
    jobs: int | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> ActiveResults:
    """Drive simulated robots from an unknown start until they are localized, and compare policies on the same seeds.

    ``world``: a preset of :func:`~factorgraph_loc.api.logs.simulate`, a TOML file, or settings. ``changes``: nested tables of
    settings of robot, policy or world, such as ``{"policy": {"horizon": 8}, "max_metres": 50}``. ``out``: folder for tables and
    plots. See :func:`factorgraph_loc.experiments.active.seek`.
    """
    simulation, settings = _active_settings(world, changes or {})
    return seek(
        simulation,
        list(policies),
        list(estimators),
        list(seeds),
        Path(out),
        settings,
        jobs=jobs,
        overwrite=overwrite,
        progress=progress,
    )


def _active_settings(
    world: str | Path | SimulationSettings, changes: Settings
) -> tuple[SimulationSettings, ActiveSettings]:
    """Split the changes into settings of the world and of the run; no key belongs to both."""
    of_run, of_world = ActiveSettings.model_fields, SimulationSettings.model_fields
    for key in changes:
        if key not in of_run and key not in of_world:
            raise InputError(f"unknown key {key}{nearest(key, [*of_run, *of_world])}")
    changed = {key: value for key, value in changes.items() if key in of_world}
    if isinstance(world, SimulationSettings) and changed:
        raise InputError("changes of the world apply to a preset or a file, but settings are given")
    simulation = world if isinstance(world, SimulationSettings) else named_settings(str(world), changed)
    run = {key: value for key, value in changes.items() if key in of_run}
    return simulation, parse_model(ActiveSettings, run, "the settings")
