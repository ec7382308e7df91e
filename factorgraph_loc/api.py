"""The verbs of the command line as functions: they do what ``fgloc VERB`` does, and return it instead of printing it.

All of them are reached from the package, as ``factorgraph_loc.run``. Where a log is expected, its name will do. Wrong input raises
:class:`~factorgraph_loc.errors.InputError` with one line on what is wrong, a run without a usable result
:class:`~factorgraph_loc.errors.RunFailedError`. Functions that take ``jobs`` spawn processes, as does :func:`simulate` with images,
so a script that calls them needs the usual ``if __name__ == "__main__"``.
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
    """What a run gave: ``result`` with trajectories and covariances, and ``scores``, the figures of ``metrics.json``."""

    result: RunResult
    scores: dict[str, Any]


def datasets(data_root: str | Path | None = None) -> list[Dataset]:
    """The logs that are known by name; ``present``: whether their files are there."""
    return describe(data_root)


def info(log: LogLike) -> Inspection:
    """What a log holds, and what looks wrong with it."""
    return inspect(_one(log))


def convert(log: LogLike, out: str | Path, *, format: Literal["csv", "parquet"] = "csv") -> None:
    """Write a log in the native format into a new folder, with tables of ``format``, or, where ``out`` ends with .bag, .mcap or
    .db3, as a ROS bag."""
    write_log(_one(log), out, format=format)


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
    """Run one estimator on one log, and score it. See :class:`~factorgraph_loc.experiments.run.RunConfig` for what is given.

    With ``out`` the folder gets the files of ``fgloc run``, plots included.
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
    """Run several estimators on several logs, with every seed, in ``jobs`` processes; write tables and plots into ``out``.

    ``settings``: by estimator. See :func:`factorgraph_loc.experiments.compare.compare`.
    """
    comparing.check_free(Path(out), overwrite=overwrite)
    named = settings or {}
    if others := [name for name in named if name not in estimators]:
        raise InputError(f"settings are given of {others[0]}, which is not run here; run: {listed(estimators)}")
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
    """A log with known truth.

    ``what``: a preset, a TOML file, or settings; ``changes`` as nested tables, such as ``{"drive": {"duration": 60.0}}``.
    ``recorded``: logs whose reads are drawn from, or what is kept of them. ``out``: a new folder that the log is written to in the
    native format; needed with ``images``, which are rendered into it. The same seed gives the same bytes.
    """
    if isinstance(what, SimulationSettings) and changes:
        raise InputError("changes are for a preset or a file, but settings are given")
    settings = what if isinstance(what, SimulationSettings) else named_settings(str(what), changes)
    if images and out is None:
        raise InputError("images are files: expected out, a folder to write the log to")
    if recorded is not None and not isinstance(recorded, RecordedLooks):
        recorded = recorded_looks(_all(recorded))
    log = make_log(settings, seed, recorded)
    if out is None:
        return log
    folder = Path(out)
    try:
        if images:
            _write_with_images(log, settings, seed, folder, progress)
        else:
            write_native(log, folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from error
    return _one(folder) if images else log


def calibrate(
    logs: LogLike | Sequence[LogLike],
    out: str | Path,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> calibration.Calibration:
    """Learn a rig from logs with reference poses; write it to ``out`` (``NAME.rig.toml``), and ``NAME.report.html`` beside it."""
    rig, page = Path(out), report_beside(Path(out), overwrite=overwrite)
    loaded = _all(logs)
    # learnt grids lie here until the rig is written: nothing is left of a calibration that fails
    with temporary_folder(of_system("grids")) as folder:
        grids = folder / rig.name.removesuffix(RIG)
        found = calibration.calibrate(loaded, _score, progress=progress, grids=grids)
        try:
            with replacing(page) as temporary:  # both are there or none
                temporary.write_text(rig_report.page(found), encoding="utf-8")
                write_rig(found.rig, rig)
        except OSError as error:
            raise InputError(f"{rig}: cannot be written: {error.strerror}") from error
    return found


def report_beside(out: Path, *, overwrite: bool) -> Path:
    """The path of the report beside a rig; InputError if the rig's name is not one, or something is there already."""
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
    """Make a map of the landmarks, RFID tags or points in a log; write it to ``out`` (``NAME.world.toml``), with a picture beside.

    See :class:`~factorgraph_loc.experiments.maps.MapOptions` for what is given.
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
    """Make the runs of an experiment's file whose results are not there yet.

    ``changes``: other values of its dotted keys, as of ``--set``. ``out``: folder of the results, else what the file says.
    ``jobs``: processes, else one per core; ``scheduler``: address of a ``dask.distributed`` cluster in place of them.
    ``verify``: what is stored is compared with its checksums, and made again where it is damaged.
    ``progress`` is given the number of runs done, of all, and of failures. A run that fails is a row and a line of ``failures``.
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
    """Write the results of an experiment as one HTML page, ``report.html`` in its folder or ``page``, and return its path. Damaged
    results are named there, and left out.

    ``changes``, ``out`` and ``data_root`` as they were given to :func:`experiment`.
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
    """Map some images of a log with their reference, locate those of each of ``queries``, and write the errors into ``out``."""
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
    """Compare point features on images of flat scenes: folders of sequences, or photographs, which are warped."""
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
    """A log, or the one that a name stands for."""
    if isinstance(log, Log):
        return log
    return read_log(log)


def _all(logs: LogLike | Sequence[LogLike]) -> list[Log]:
    """Logs, and those that names stand for."""
    several = [logs] if isinstance(logs, (Log, str, Path)) else logs
    return [one for log in several for one in ([log] if isinstance(log, Log) else load(log))]


def _score(log: Log) -> dict[str, Any]:
    """The scores of the EKF on a log, with the log's rig and its sensors; of the smoother where tags are read."""
    return run(log, calibration.estimator_for(log.rig)).scores


def _write_with_images(log: Log, settings: SimulationSettings, seed: int, folder: Path, progress: Progress) -> None:
    """The images go to a folder beside the log's first, so that there is a whole log or none."""
    require_new(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with temporary_folder(folder) as beside:
        workers = os.cpu_count() or 1
        write_native(with_images(log, settings, seed, beside, workers=workers, tell=progress), folder)
