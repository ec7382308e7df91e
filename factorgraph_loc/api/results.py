"""The commands ``fgloc view``, ``export`` and ``score`` as functions."""

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.trajectories.page import FILES, write_score
from factorgraph_loc.evaluation.trajectories.score import TrajectoryScore, score_paths
from factorgraph_loc.exports.rerun_viewer import LOOPBACK
from factorgraph_loc.exports.ros import write_mcap
from factorgraph_loc.exports.runs import StoredRun, find_runs, is_results, read_runs
from factorgraph_loc.files.shipped import manifests
from factorgraph_loc.files.temporary import require_free
from factorgraph_loc.io.readers import LogLike, RigLike, WorldLike, read_log
from factorgraph_loc.io.trajectories import read_trajectory, write_trajectory
from factorgraph_loc.maps.points import write_ply
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.pose_path import PosePath
from factorgraph_loc.model.scoring import MAX_DIFF, MAX_GAP, Alignment, Association
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.text import listed, quoted

TrajectoryLike = Trajectory | PosePath | str | Path
FORMATS = (".mcap", ".tum", ".kitti", ".ply")
L = TypeVar("L", bound=LogLike)


def view(
    results: LogLike | Sequence[LogLike],
    *,
    rig: RigLike | None = None,
    world: WorldLike | None = None,
    rrd: str | Path | None = None,
    bind: str = LOOPBACK,
) -> None:
    """Show a log and its runs over time in the viewer Rerun.

    ``results``: folders of runs or comparisons, or only a log. The log of the runs must be given too, unless
    :func:`~factorgraph_loc.api.logs.datasets` lists it. ``rig``, ``world``: replace those of the log. ``rrd``: a file
    to write for the viewer instead of opening it. ``bind``: the IP address at which the viewer listens, without a
    password. By default only this machine can connect. Raises InputError if ``rerun-sdk`` is not installed, if the
    viewer does not start, or if the file cannot be written.
    """
    log, runs = stored(_listed(results), lambda name: read_log(name, rig=rig, world=world))
    show(log, runs, None if rrd is None else Path(rrd), bind)


def export(
    results: LogLike | Sequence[LogLike],
    out: str | Path,
    *,
    rig: RigLike | None = None,
    world: WorldLike | None = None,
) -> list[Path]:
    """Write results for other programs. Returns the written files.

    ``results``: folders of runs, or a log. ``rig``, ``world``: replace those of the log. ``out``: a file. Its suffix
    selects the content: .mcap for runs in Foxglove and RViz; .tum or .kitti for the final trajectory of a run, or the
    reference of a log; .ply for points of a map.
    """
    require_format(Path(out))
    log, runs = stored(_listed(results), lambda name: read_log(name, rig=rig, world=world))
    return write(log, runs, Path(out))


def _listed(results: LogLike | Sequence[LogLike]) -> list[LogLike]:
    return [results] if isinstance(results, (Log, str, Path)) else list(results)


def stored(results: Sequence[L], read: Callable[[L | str], Log]) -> tuple[Log, list[StoredRun]]:
    """Return the log and the stored runs that the names ``results`` refer to. ``read``: a function that reads a log.

    If ``results`` has no log, the known data set that the runs name is read. Raises InputError if there is none, or if
    there are several logs.
    """
    places = [Path(name) for name in results if not isinstance(name, Log) and is_results(Path(name))]
    logs = [name for name in results if isinstance(name, Log) or Path(name) not in places]
    if len(logs) > 1:
        names = [log.name if isinstance(log, Log) else log for log in logs]
        raise InputError(f"{listed(names)} are {len(logs)} logs, expected one log and folders of its results")
    folders = [run for place in places for run in find_runs(place)]
    named = sorted({folder.log for folder in folders})
    if not logs and not named:
        raise InputError("there are no results, expected folders of runs, or a log")
    if not logs and len(named) > 1:
        raise InputError(f"{places[0]}: contains runs on the logs {listed(named)}: give one of these logs, too")
    if not logs and named[0] not in manifests():
        raise InputError(
            f"{places[0]}: is a run on the log {named[0]}, which `fgloc datasets` does not list: give that log, too"
        )
    log = read(logs[0] if logs else named[0])
    of_log = [folder for folder in folders if folder.log == log.name]
    if folders and not of_log:
        raise InputError(f"{places[0]}: contains runs on the logs {listed(named)}, expected runs on the log {log.name}")
    return log, read_runs(of_log, log)


def show(log: Log, runs: list[StoredRun], rrd: Path | None, bind: str) -> None:
    """Show a log and its runs in the viewer Rerun, or write them to the file ``rrd`` if it is not None.

    ``bind``: the IP address at which the viewer listens. Raises InputError if ``rerun-sdk`` is not installed."""
    # Rerun also prints the errors that it raises, unless RUST_LOG is "off" when it is imported
    is_set = "RUST_LOG" in os.environ
    os.environ.setdefault("RUST_LOG", "off")
    try:
        from factorgraph_loc.exports import rerun_scene  # noqa: PLC0415
    except ImportError as error:
        raise InputError("the viewer needs rerun-sdk: pip install 'factorgraph-loc[viewer]'") from error
    finally:
        if not is_set:
            del os.environ["RUST_LOG"]
    if rrd is None:
        rerun_scene.show(log, runs, bind)
    else:
        rerun_scene.write_rrd(log, runs, rrd)


def require_format(out: Path) -> None:
    """Raise InputError if the suffix of ``out`` is not among the formats of exports."""
    if out.suffix not in FORMATS:
        raise InputError(f"{out}: has the suffix {quoted(out.suffix)}, expected one of {', '.join(FORMATS)}")


def write(log: Log, runs: list[StoredRun], out: Path) -> list[Path]:
    """Write a log and its runs, a trajectory, or points of a map to ``out``. Return the written files.

    The suffix of ``out`` selects the content and the format.
    """
    if out.suffix == ".mcap":
        write_mcap(log, runs, out)
    elif out.suffix == ".ply":
        if log.world.points is None:
            raise InputError(f"{log.name}: its map has no points to write: give a map with points (--world)")
        write_ply(log.world.points, out)
    else:
        return write_trajectory(_trajectory(log, runs, out), out, log.t0_ns)
    return [out]


def _only(runs: list[StoredRun], out: Path) -> StoredRun:
    if len(runs) != 1:
        count = f"{len(runs)} runs are given ({listed(run.name for run in runs)})" if runs else "no run is given"
        raise InputError(f"{out}: a file of this format contains one run, but {count}: give the folder of one run")
    return runs[0]


def _trajectory(log: Log, runs: list[StoredRun], out: Path) -> Trajectory:
    """Return the final trajectory of the only run in ``runs``, or the reference of the log if there are no runs.

    ``out``: the file to write, for messages."""
    if runs:
        return _only(runs, out).final
    if log.reference is None:
        raise InputError(f"{log.name}: has no reference to write: give the folder of a run, too")
    return log.reference


def score(
    estimate: TrajectoryLike,
    reference: TrajectoryLike,
    *,
    align: Alignment = "none",
    associate: Association = "nearest",
    max_diff: float = MAX_DIFF,
    max_gap: float = MAX_GAP,
    all_pairs: bool = False,
    align_poses: int | None = None,
    delta: Sequence[str] = (),
    out: str | Path | None = None,
    overwrite: bool = False,
) -> TrajectoryScore:
    """Return the errors of a trajectory against another, in the field ``figures`` in metres and radians.

    ``estimate``, ``reference``: trajectories with times of the same clock, or texts that name trajectories as in
    ``fgloc score``. ``align``: how the estimate is first moved onto the reference: "none", "origin" (first poses
    agree), "se2", "yaw", "se3" or "sim3". ``associate``: how poses are paired: "nearest" in time, at most ``max_diff``
    [s] apart, or "interpolate" across gaps of at most ``max_gap`` [s]. ``all_pairs``: compute relative errors from each
    pose, not over successive segments. ``align_poses``: number of first poses that determine the alignment, by default
    all. ``delta``: further lengths of relative errors, such as "5m" or "2s". ``out``: a folder for the files of ``fgloc
    score``. Raises InputError if a trajectory cannot be read, or if no poses can be paired.
    """
    if out is not None:
        require_free(Path(out), FILES, overwrite=overwrite)
    paths = _path(estimate, "estimate"), _path(reference, "reference")
    pieces: dict[str, Any] = {"all_pairs": all_pairs, "align_poses": align_poses, "delta": delta}
    result = score_paths(*paths, align, associate, max_diff=max_diff, max_gap=max_gap, **pieces)
    if out is not None:
        write_score(result, Path(out))
    return result


def _path(trajectory: TrajectoryLike, name: str) -> PosePath:
    if isinstance(trajectory, str | Path):
        return read_trajectory(trajectory)
    return trajectory.path(name) if isinstance(trajectory, Trajectory) else replace(trajectory, name=name)
