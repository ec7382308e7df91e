"""The commands ``fgloc calibrate``, ``map`` and ``features evaluate`` as functions."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import polars as pl

from factorgraph_loc.api.running import run
from factorgraph_loc.calibration import calibrate as calibration
from factorgraph_loc.calibration import report as rig_report
from factorgraph_loc.evaluation.features import scores as feature_scores
from factorgraph_loc.evaluation.features.feature_evaluation import Feature
from factorgraph_loc.evaluation.features.sequences import find_sequences
from factorgraph_loc.experiments import maps, output
from factorgraph_loc.files.models import replacing
from factorgraph_loc.files.temporary import of_system, require_free, temporary_folder, writing
from factorgraph_loc.io.native.rig_file import write_rig
from factorgraph_loc.io.readers import LogLike, RigLike, WorldLike, load_all, read_log
from factorgraph_loc.plugins import FEATURES, MAP_ESTIMATORS
from factorgraph_loc.vision.features import extractor

RIG = ".rig.toml"


def calibrate(
    logs: LogLike | Sequence[LogLike],
    out: str | Path,
    *,
    rig: RigLike | None = None,
    world: WorldLike | None = None,
    overwrite: bool = False,
    progress: Callable[[float, float], None] | None = None,
) -> calibration.Calibration:
    """Return a calibration of a rig, the settings of a robot and its sensors, from logs. Write the rig and a report.

    ``out``: the rig file, ``NAME.rig.toml``; the report is ``NAME.report.html`` next to it. ``overwrite``: replace
    existing files. ``rig``, ``world``: replace those of the logs. Either all logs or none must have a reference
    trajectory. ``progress`` is called with the number of finished steps and the number of all steps.
    """
    file, page = Path(out), report_beside(Path(out), overwrite=overwrite)
    loaded = load_all(logs, rig, world)
    # estimated detection models are stored here until the rig is written: a failed calibration leaves no files
    with temporary_folder(of_system("grids")) as folder:
        grids = folder / file.name.removesuffix(RIG)
        result = calibration.calibrate(loaded, run, progress=progress, grids=grids)
        with writing(file), replacing(page) as temporary:  # write both files or none
            temporary.write_text(rig_report.page(result), encoding="utf-8")
            write_rig(result.rig, file)
    return result


def report_beside(out: Path, *, overwrite: bool) -> Path:
    """Return the path of the report next to the rig file ``out``.

    Raises InputError if one of the two files exists and ``overwrite`` is False.
    """
    return output.with_ending(out, RIG, ".report.html", overwrite=overwrite)


def build_map(
    log: LogLike,
    out: str | Path,
    *,
    of: str | None = None,
    estimator: str = MAP_ESTIMATORS[0],
    settings: Mapping[str, Any] | None = None,
    extend: bool = False,
    poses: str | None = None,
    height: float | None = None,
    prior: str | None = None,
    drop_dead: bool = False,
    points: Mapping[str, Any] | None = None,
    rig: RigLike | None = None,
    world: WorldLike | None = None,
    overwrite: bool = False,
    progress: maps.Progress = lambda _share: None,
) -> maps.MadeMap:
    """Estimate a map of landmarks, RFID tags or points from a log, and return it.

    Writes ``out`` (``NAME.world.toml``) and a picture next to it. ``of``: landmarks, tags or points, by default what
    the log measures. ``estimator``, ``settings``: the estimator of landmarks, and changes of its settings. ``extend``:
    keep the log's map and add missing objects. ``poses``: the robot poses for a map of tags: "reference", or "odometry"
    to estimate them too. ``height`` [m]: height of new tags or landmarks, by default that of the antennas or the radio.
    ``prior``: the start pose, "X,Y,HEADING" or a name such as "reference". ``drop_dead``: only remove tags from the
    log's map that the log shows to be dead. ``points``: settings of a map of points. ``rig``, ``world``: replace those
    of the log. ``progress`` is called with the fraction of the work that is done.
    """
    maps.plot_path(Path(out), overwrite=overwrite)
    options = maps.MapOptions(of, estimator, settings or {}, extend, poses, height, prior, drop_dead, points or {})
    made = maps.make_map(read_log(log, rig=rig, world=world), options, progress)
    made.write(Path(out), overwrite=overwrite)
    return made


def features(
    images: Sequence[str | Path],
    out: str | Path,
    *,
    features: Sequence[str] = FEATURES,
    count: int = 1000,
    overwrite: bool = False,
    progress: Callable[[float, float], None] = lambda _done, _total: None,
) -> pl.DataFrame:
    """Return scores of point features on ``images`` of planar scenes, and write them to the folder ``out``.

    ``images``: folders of image sequences, or photographs. Known homographies warp photographs to image sequences.
    ``features``: names of the features to compare. ``count``: maximum number of features in an image. ``overwrite``:
    replace existing files. ``progress`` is called with the number of finished images and the number of all images.
    """
    require_free(Path(out), feature_scores.FILES, overwrite=overwrite)
    chosen = [Feature(name, extractor(name, count).detectAndCompute) for name in features]
    scores = feature_scores.evaluate_all(find_sequences([Path(path) for path in images]), chosen, progress)
    feature_scores.write_scores(scores, Path(out))
    return scores
