"""Scores of trajectories, given as such or by what names them."""

from pathlib import Path

from factorgraph_loc.evaluation.trajectories.page import check_free, write_score
from factorgraph_loc.evaluation.trajectories.score import TrajectoryScore, score_paths
from factorgraph_loc.io.trajectories import read_trajectory
from factorgraph_loc.model.pose_path import PosePath
from factorgraph_loc.model.scoring import MAX_DIFF, MAX_GAP, Alignment, Association
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.trajectory3 import Trajectory3, path_of

TrajectoryLike = Trajectory | Trajectory3 | str | Path


def score(
    estimate: TrajectoryLike,
    reference: TrajectoryLike,
    *,
    align: Alignment = "none",
    associate: Association = "nearest",
    max_diff: float = MAX_DIFF,
    max_gap: float = MAX_GAP,
    all_pairs: bool = False,
    out: str | Path | None = None,
    overwrite: bool = False,
) -> TrajectoryScore:
    """Score any trajectory against any other; ``figures`` of the returned score are the errors, in metres and radians.

    ``estimate``, ``reference``: trajectories whose times are of one clock, or what names one for ``fgloc score``. For the other
    arguments see :func:`~factorgraph_loc.evaluation.trajectories.score.score_paths`. ``out``: folder for the files that ``fgloc
    score`` writes. InputError if a trajectory cannot be read, or the two have nothing in common.
    """
    if out is not None:
        check_free(Path(out), overwrite=overwrite)
    paths = _path(estimate, "estimate"), _path(reference, "reference")
    found = score_paths(*paths, align, associate, max_diff=max_diff, max_gap=max_gap, all_pairs=all_pairs)
    if out is not None:
        write_score(found, Path(out))
    return found


def _path(trajectory: TrajectoryLike, name: str) -> PosePath:
    return read_trajectory(trajectory) if isinstance(trajectory, str | Path) else path_of(trajectory, name)
