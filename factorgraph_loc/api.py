"""The commands of ``fgloc`` as functions that return their results instead of printing them.

They are available as ``factorgraph_loc.run`` and so on. A log may be given by its name. Invalid input raises
:class:`~factorgraph_loc.errors.InputError`, and a run without a usable result :class:`~factorgraph_loc.errors.RunFailedError`.
Functions with ``jobs``, and :func:`simulate` with images, spawn processes, so a script that calls them needs
``if __name__ == "__main__"``.
"""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from factorgraph_loc.calibration import calibrate as calibration
from factorgraph_loc.calibration import report as rig_report
from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.features import scores as feature_scores
from factorgraph_loc.evaluation.features.feature_evaluation import feature
from factorgraph_loc.evaluation.features.sequences import find_sequences
from factorgraph_loc.evaluation.inspect import Inspection, inspect
from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments import compare as comparing
from factorgraph_loc.experiments import image_localization, maps, output
from factorgraph_loc.experiments import run as running
from factorgraph_loc.experiments.cluster import on_cluster
from factorgraph_loc.experiments.experiment import Done, Prepared, prepare, run_experiment
from factorgraph_loc.experiments.reporting import report_experiment
from factorgraph_loc.experiments.run import RunConfig
from factorgraph_loc.files.models import replacing
from factorgraph_loc.files.results import writing
from factorgraph_loc.files.temporary import of_system, temporary_folder
from factorgraph_loc.io.native.native import require_new, write_native
from factorgraph_loc.io.native.rig_file import write_rig
from factorgraph_loc.io.readers import Dataset, describe, load, read_log
from factorgraph_loc.io.write import write_log
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.result import RunResult
from factorgraph_loc.model.scoring import MAX_GAP
from factorgraph_loc.model.ticks import TICK_GAP
from factorgraph_loc.sensors.rfid.recorded import RecordedLooks
from factorgraph_loc.simulation import SimulationSettings, named_settings, recorded_looks, with_images
from factorgraph_loc.simulation import simulate as make_log
from factorgraph_loc.text import listed

__all__ = [
    "Run",
    "calibrate",
    "compare",
    "convert",
    "datasets",
    "experiment",
    "features",
    "images",
    "info",
    "map",
    "report",
    "run",
    "simulate",
]

LogLike = Log | str | Path
Settings = Mapping[str, Any]
Progress = Callable[[float, float], None]
RIG = ".rig.toml"
FEATURES = ("colour", "sift", "orb")


@dataclass(frozen=True)
class Run:
    """The outcome of a run: its ``result``, and its ``scores`` as in ``metrics.json``."""

    result: RunResult
    scores: dict[str, Any]


def datasets(data_root: str | Path | None = None) -> list[Dataset]:
    """The logs that are known by name; ``present`` tells whether their files exist."""
    return describe(data_root)


def info(log: LogLike) -> Inspection:
    """Summarize a log, with warnings about its content."""
    return inspect(_one(log))


def convert(
    log: LogLike, out: str | Path, *, format: Literal["csv", "parquet"] = "csv", overwrite: bool = False
) -> None:
    """Write a log as a new folder in the native format, or as a ROS bag if ``out`` ends with .bag, .mcap or .db3.

    ``overwrite`` replaces a log that ``out`` is.
    """
    write_log(_one(log), out, format=format, overwrite=overwrite)


def run(
    log: LogLike,
    estimator: str,
    *,
    settings: Settings | None = None,
    sensors: Sequence[str] | None = None,
    prior: str | None = None,
    seed: int = 0,
    max_gap: float = MAX_GAP,
    tick_gap: float = TICK_GAP,
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: Callable[[float], None] | None = None,
) -> Run:
    """Run one estimator on one log and score the result.

    For the arguments see :class:`~factorgraph_loc.experiments.run.RunConfig`. ``out``: folder for the files that ``fgloc run``
    writes.
    """
    if out is not None:
        output.check_free(Path(out), overwrite=overwrite)
    loaded = _one(log)
    config = RunConfig(
        estimator, settings or {}, None if sensors is None else tuple(sensors), prior, seed, max_gap, tick_gap
    )
    result = running.run(loaded, config, progress)
    if out is None:
        return Run(result, score(result, loaded))
    scores = output.write_run(result, loaded, Path(out), overwrite=overwrite)
    output.write_plots(result, loaded, Path(out))
    return Run(result, scores)


def compare(
    logs: LogLike | Sequence[LogLike],
    estimators: Sequence[str],
    out: str | Path,
    *,
    settings: Mapping[str, Settings] | None = None,
    sensors: Sequence[str] | None = None,
    prior: str | None = None,
    seeds: Iterable[int] = (0,),
    max_gap: float = MAX_GAP,
    tick_gap: float = TICK_GAP,
    jobs: int | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> comparing.Comparison:
    """Run several estimators on several logs with each seed, in ``jobs`` processes, and write tables and plots to ``out``.

    ``settings`` are given per estimator. See :func:`factorgraph_loc.experiments.compare.compare`.
    """
    comparing.check_free(Path(out), overwrite=overwrite)
    named = settings or {}
    if others := [name for name in named if name not in estimators]:
        raise InputError(f"settings are given for {others[0]}, which is not run here; run: {listed(estimators)}")
    used = None if sensors is None else tuple(sensors)
    chosen = list(seeds)
    configs = [
        RunConfig(name, named.get(name, {}), used, prior, seed, max_gap, tick_gap)
        for name in estimators
        for seed in chosen
    ]
    return comparing.compare(_all(logs), configs, Path(out), jobs=jobs, overwrite=overwrite, progress=progress)


def simulate(
    what: str | Path | SimulationSettings = "office",
    seed: int = 0,
    *,
    changes: Settings | None = None,
    recorded: RecordedLooks | LogLike | Sequence[LogLike] | None = None,
    images: bool = False,
    out: str | Path | None = None,
    progress: Progress = lambda _done, _total: None,
) -> Log:
    """Simulate a log with known ground truth. The same seed gives the same bytes.

    ``what``: a preset, a TOML file, or settings. ``changes``: nested tables, such as ``{"drive": {"duration": 60.0}}``.
    ``recorded``: logs whose RFID reads are resampled, or the reads extracted from them. ``out``: a new folder for the log in the
    native format; required with ``images``, which are rendered into it.
    """
    if isinstance(what, SimulationSettings) and changes:
        raise InputError("changes apply to a preset or a file, but settings are given")
    settings = what if isinstance(what, SimulationSettings) else named_settings(str(what), changes)
    if images and out is None:
        raise InputError("images need out, a folder to write the log to")
    if recorded is not None and not isinstance(recorded, RecordedLooks):
        recorded = recorded_looks(_all(recorded))
    log = make_log(settings, seed, recorded)
    if out is None:
        return log
    folder = Path(out)
    with writing(folder):
        if images:
            _write_with_images(log, settings, seed, folder, progress)
        else:
            write_native(log, folder)
    return _one(folder) if images else log


def calibrate(
    logs: LogLike | Sequence[LogLike],
    out: str | Path,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> calibration.Calibration:
    """Calibrate a rig from logs with reference poses. Writes ``out`` (``NAME.rig.toml``) and ``NAME.report.html`` next to it."""
    rig, page = Path(out), report_beside(Path(out), overwrite=overwrite)
    loaded = _all(logs)
    # learnt grids are kept here until the rig is written, so that a failed calibration leaves nothing behind
    with temporary_folder(of_system("grids")) as folder:
        grids = folder / rig.name.removesuffix(RIG)
        found = calibration.calibrate(loaded, _score, progress=progress, grids=grids)
        with writing(rig), replacing(page) as temporary:  # write both files or none
            temporary.write_text(rig_report.page(found), encoding="utf-8")
            write_rig(found.rig, rig)
    return found


def report_beside(out: Path, *, overwrite: bool) -> Path:
    """The path of the report of a rig; InputError if the rig's name is invalid or the file exists."""
    return output.beside(out, RIG, ".report.html", overwrite=overwrite)


def map(
    log: LogLike,
    out: str | Path,
    *,
    of: str | None = None,
    estimator: str = maps.MAPPERS[0],
    settings: Settings | None = None,
    extend: bool = False,
    poses: str | None = None,
    tag_height: float | None = None,
    prior: str | None = None,
    overwrite: bool = False,
) -> maps.MadeMap:
    """Estimate a map of landmarks, RFID tags or points from a log. Writes ``out`` (``NAME.world.toml``) and a picture next to it.

    For the arguments see :class:`~factorgraph_loc.experiments.maps.MapOptions`.
    """
    maps.picture_beside(Path(out), overwrite=overwrite)
    options = maps.MapOptions(of, estimator, settings or {}, extend, poses, tag_height, prior)
    made = maps.make_map(_one(log), options)
    made.write(Path(out), overwrite=overwrite)
    return made


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
    prepared = _prepared(file, changes, out, data_root, verify=verify)
    executor = None if scheduler is None else on_cluster(scheduler, prepared, again=retry_failed)
    return run_experiment(prepared, jobs=jobs, again=retry_failed, executor=executor, progress=progress)


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
    return report_experiment(_prepared(file, changes, out, data_root), None if page is None else Path(page)).page


def images(
    log: LogLike,
    out: str | Path,
    *,
    mapped: Sequence[int],
    queries: Mapping[str, Sequence[int]],
    features: Sequence[str] = FEATURES,
    count: int = 1500,
    overwrite: bool = False,
    progress: Callable[[float], None] = lambda _: None,
) -> image_localization.ImageResults:
    """Map some images of a log with their reference poses, localize the images of each query, and write the errors to ``out``."""
    image_localization.check_free(Path(out), overwrite=overwrite)
    loaded = _one(log)
    results = image_localization.evaluate_images(loaded, features, count, mapped, queries, progress)
    image_localization.write_results(loaded.name, results, Path(out))
    return results


def features(
    images: Sequence[str | Path],
    out: str | Path,
    *,
    features: Sequence[str] = FEATURES,
    count: int = 1000,
    overwrite: bool = False,
    progress: Progress = lambda _done, _total: None,
) -> feature_scores.FeatureScores:
    """Evaluate point features on images of planar scenes: folders of sequences, or photographs, which are warped."""
    feature_scores.check_free(Path(out), overwrite=overwrite)
    chosen = [feature(name, count) for name in features]
    scores = feature_scores.evaluate_all(find_sequences([Path(path) for path in images]), chosen, progress)
    feature_scores.write_scores(scores, Path(out))
    return scores


def _prepared(
    file: str | Path,
    changes: Settings | None,
    out: str | Path | None,
    data_root: str | Path | None,
    *,
    verify: bool = False,
) -> Prepared:
    folder, root = None if out is None else Path(out), None if data_root is None else str(data_root)
    return prepare(Path(file), list((changes or {}).items()), data_root=root, out=folder, verify=verify)


def _one(log: LogLike) -> Log:
    """The log, loaded if it is given by name."""
    if isinstance(log, Log):
        return log
    return read_log(log)


def _all(logs: LogLike | Sequence[LogLike]) -> list[Log]:
    """The logs, loaded if they are given by name."""
    several = [logs] if isinstance(logs, (Log, str, Path)) else logs
    return [one for log in several for one in ([log] if isinstance(log, Log) else load(log))]


def _score(log: Log) -> dict[str, Any]:
    """Scores of the EKF, or of the smoother if the log has RFID, with the log's rig and its sensors."""
    return run(log, calibration.estimator_for(log.rig)).scores


def _write_with_images(log: Log, settings: SimulationSettings, seed: int, folder: Path, progress: Progress) -> None:
    """Render the images into a temporary folder first, so that the log is written completely or not at all."""
    require_new(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with temporary_folder(folder) as beside:
        workers = os.cpu_count() or 1
        write_native(with_images(log, settings, seed, beside, workers=workers, tell=progress), folder)
