"""The files of a score."""

import json
from pathlib import Path

import polars as pl

from factorgraph_loc.drawing.figures import save
from factorgraph_loc.evaluation.trajectories.figures import plots
from factorgraph_loc.evaluation.trajectories.page import page
from factorgraph_loc.evaluation.trajectories.score import TrajectoryScore
from factorgraph_loc.files.models import replacing, write_text
from factorgraph_loc.files.results import require_free, writing

FILES = ("errors.csv", "report.html", "score.json")  # the last one is written last
PLOTS = ("trajectories.png", "errors.png", "relative-errors.png")


def check_free(out: Path, *, overwrite: bool) -> None:
    """Raise InputError if ``out`` is not a folder, or contains a score that must not be replaced."""
    require_free(out, FILES, overwrite=overwrite, folders=(out.parent, out / "plots"))


def write_score(score: TrajectoryScore, out: Path) -> None:
    """Write a score into the folder ``out``, replacing a previous one.

    ``errors.csv``: a row for each pair of poses. ``report.html``: tables and plots. ``plots``: the same plots as PNG.
    ``score.json``: the figures, see :meth:`TrajectoryScore.document`.
    """
    with writing(out):
        (out / "plots").mkdir(parents=True, exist_ok=True)
        for name in (*reversed(FILES), *(f"plots/{plot}" for plot in PLOTS)):
            (out / name).unlink(missing_ok=True)
        for name, figure in plots(score).items():
            with replacing(out / "plots" / f"{name}.png") as temporary:
                save(figure, temporary)
        write_text(out / FILES[0], errors_of(score).write_csv())
        write_text(out / FILES[1], page(score))
        write_text(out / FILES[2], json.dumps(score.document(), indent=2, allow_nan=False) + "\n")


def errors_of(score: TrajectoryScore) -> pl.DataFrame:
    """The table of ``errors.csv``: for each pair the stamps [ns] of both, empty where there are none, the positions [m] of
    both, the estimate's after its alignment, and the errors in position [m] and rotation [rad]."""
    rotation = score.ape.rotation
    columns = [
        pl.Series(name, [None] * len(path) if path.t_ns is None else path.t_ns, pl.Int64)
        for name, path in (("t_ns", score.estimate), ("reference_t_ns", score.reference))
    ]
    for before, path in (("", score.estimate), ("reference_", score.reference)):
        columns += [pl.Series(f"{before}{axis}", path.positions[:, i]) for i, axis in enumerate("xyz")]
    columns.append(pl.Series("error_position", score.ape.position))
    columns.append(
        pl.Series("error_rotation", [None] * len(score.estimate) if rotation is None else rotation, pl.Float64)
    )
    return pl.DataFrame(columns)
