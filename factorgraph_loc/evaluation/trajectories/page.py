"""The report of a comparison of two trajectories as an HTML page and as files, with plots of the trajectories and errors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import polars as pl
from scipy.spatial.transform import Rotation

from factorgraph_loc.drawing.figures import COLOURS, grid, legend, png
from factorgraph_loc.drawing.pages import Part, Rows, sectioned
from factorgraph_loc.evaluation.figures import write_picture
from factorgraph_loc.evaluation.pairing import HOW, pauses
from factorgraph_loc.evaluation.trajectories.score import TrajectoryScore
from factorgraph_loc.files.models import write_text
from factorgraph_loc.files.temporary import writing
from factorgraph_loc.text import json_text, number
from factors.se2 import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ESTIMATE, REFERENCE = "estimate", "reference"
TITLES = {"rmse": "RMSE", "p95": "95 %"}
UNITS = {"position": "m", "rotation": "rad"}
ERRORS = {
    "absolute position [m]": "ape.position",
    "absolute rotation [rad]": "ape.rotation",
    "position per metre [m]": "rpe_per_m.position",
    "rotation per metre [rad]": "rpe_per_m.rotation",
    "position per second [m]": "rpe_per_s.position",
    "rotation per second [rad]": "rpe_per_s.rotation",
}
EXPLANATION = (
    "Absolute errors are differences between the poses of both trajectories, after the alignment. Errors per metre and per second "
    "are differences between the motions of both trajectories over pieces of that length. They are not divided by the length, and "
    "are plotted at the end of each piece. A rotation error is the angle between two orientations. 95 % of the errors are smaller "
    "than the value in the column 95 %. The column std has their standard deviation."
)
FILES = ("errors.csv", "report.html", "score.json")  # score.json is written last and marks a complete report


def _trajectories(score: TrajectoryScore) -> Figure:
    """Return a figure of both trajectories from above. Unless both are planar, it also shows their heights."""
    flat = score.estimate.is_planar and score.reference.is_planar
    places = np.concatenate((score.estimate.positions, score.reference.positions))[:, :2]
    width, depth = np.maximum(np.ptp(places, axis=0), 1e-6)
    height = float(np.clip((14.0 if flat else 7.0) * depth / width + 1.5, 5.0, 10.0))
    figure, axes = grid(1, 1 if flat else 2, height, "trajectories, at the compared poses")
    x, label = _abscissa(score)
    breaks = pauses(x) if score.seconds() is not None else np.empty(0, dtype=np.int64)  # NaN interrupts a line
    for path, style, name in (
        (score.reference, {"color": "0.75", "linewidth": 4.0}, REFERENCE),
        (score.estimate, {"color": COLOURS[0], "linewidth": 1.2}, ESTIMATE),
    ):
        positions = np.insert(path.positions, breaks, np.nan, axis=0)
        axes[0, 0].plot(*positions[:, :2].T, label=name, **style)
        if not flat:
            axes[0, 1].plot(np.insert(x, breaks, np.nan), positions[:, 2], label=name, **style)
    axes[0, 0].plot(
        *score.estimate.positions[0, :2], "o", color=COLOURS[0], markersize=5, label="start of the estimate"
    )
    axes[0, 0].set_aspect("equal", adjustable="datalim")
    axes[0, 0].set(xlabel="x [m]", ylabel="y [m]")
    if not flat:
        axes[0, 1].set(xlabel=label, ylabel="z [m]")
    legend(figure, axes[0])
    return figure


def _errors(score: TrajectoryScore) -> Figure:
    """Return a figure of the errors of a comparison over time, and of the distribution of the absolute errors."""
    kinds = {"absolute": score.ape, "over 1 m of path": score.rpe_per_m, "over 1 s": score.rpe_per_s}
    kinds |= {f"over {delta}": errors for delta, errors in score.rpe.items()}
    known = {name: errors for name, errors in kinds.items() if errors is not None and len(errors.position)}
    units = {"position": "m"} if score.ape.rotation is None else UNITS
    figure, axes = grid(len(units), len(known) + 1, 3.5 * len(units), "errors")
    x, label = _abscissa(score)
    for row, (what, unit) in zip(axes, units.items(), strict=True):
        for axis, (name, errors) in zip(row, known.items(), strict=False):
            values = getattr(errors, what)
            axis.plot(x[errors.ends], values, ".", color=COLOURS[0], markersize=4, label="error")
            axis.axhline(np.sqrt(np.mean(values**2)), color=COLOURS[1], linestyle="--", linewidth=1.2, label="RMSE")
            axis.set(title=name, xlabel=label, ylabel=f"{what} error [{unit}]")
            axis.set_ylim(bottom=0.0)
        absolute = np.sort(getattr(score.ape, what))
        row[-1].plot(absolute, np.arange(1, len(absolute) + 1) / len(absolute), color=COLOURS[0])
        row[-1].set(ylim=(0.0, 1.0), xlabel=f"absolute {what} error [{unit}]", ylabel="fraction of smaller errors")
    legend(figure, axes[0])
    return figure


def _abscissa(score: TrajectoryScore) -> tuple[Array, str]:
    """Return the abscissa (N,) of the plots, and its label. It has times [s], or pose numbers from 1 without
    timestamps."""
    t = score.seconds()
    return (np.arange(1.0, len(score.estimate) + 1), "number of the pose") if t is None else (t, "time [s]")


def errors_table(score: TrajectoryScore) -> Rows:
    """Return the header of a table of errors, and its rows. A row has a kind of error and its statistics as text. Kinds
    of errors that are undefined have no row."""
    figures, titles = score.figures, dict(ERRORS)
    for delta in score.rpe:
        titles |= {f"{what} per {delta} [{unit}]": f"rpe_{delta}.{what}" for what, unit in UNITS.items()}
    rows = [
        (title, *(number(figures[f"{key}_{how}"]) for how in HOW))
        for title, key in titles.items()
        if figures[f"{key}_rmse"] is not None
    ]
    return ("error", *(TITLES.get(how, how) for how in HOW)), rows


def extents(score: TrajectoryScore) -> dict[str, str]:
    """Return a description of what was compared, as {title: text}. The titles are ``estimate`` and ``reference``
    (number of poses, length), ``pairs`` (number and method of pairing), and ``alignment``. ``pieces`` has the numbers
    of path sections that relative errors refer to, and is missing without relative errors."""
    rows = {}
    for name, path, poses, length in zip(
        ("estimate", "reference"), (score.estimate, score.reference), score.poses, score.lengths, strict=True
    ):
        rows[name] = f"{path.name}: {poses} poses, {length:.2f} m"
    t = score.seconds()
    rows["pairs"] = f"{len(score.estimate)}, {_association(score)}" + ("" if t is None else f"; {t[-1]:.1f} s")
    pieces = {"metre": score.rpe_per_m, "second": score.rpe_per_s}
    counts = [f"{len(errors.position)} of a {unit}" for unit, errors in pieces.items() if errors is not None]
    if counts:
        overlap = "which may overlap" if score.settings["all_pairs"] else "which do not overlap"
        rows["pieces"] = f"{', '.join(counts)}, {overlap}"
    rows["alignment"] = _alignment(score)
    return rows


def page(score: TrajectoryScore) -> str:
    """Return the report of a comparison as the text of an HTML page."""
    lead = (
        f"The position error (RMSE) of {score.estimate.name} is {number(score.figures['ape.position_rmse'])} m, over "
        f"{len(score.estimate)} poses of {score.reference.name}."
    )
    sections: dict[str, Sequence[Part]] = {
        "Errors": [EXPLANATION, errors_table(score), png(_errors(score))],
        "Trajectories": ["At the compared poses, the estimate after its alignment.", png(_trajectories(score))],
        "How they were compared": [(("", ""), list(extents(score).items()))],
    }
    return sectioned(f"{score.estimate.name} against {score.reference.name}", lead, score.warnings, sections)


def _association(score: TrajectoryScore) -> str:
    """Return a description of how the poses of both trajectories were paired."""
    settings = score.settings
    if "max_diff" in settings:
        return f"nearest stamps, at most {settings['max_diff']:g} s apart"
    if "max_gap" in settings:
        return f"estimates interpolated at the stamps of the reference, across at most {settings['max_gap']:g} s"
    return "by row number"


def _alignment(score: TrajectoryScore) -> str:
    """Return a description of the alignment: its kind, translation, rotation vector and scale."""
    how, transform = score.settings["align"], score.transform
    if how == "none":
        return "none"
    turn = Rotation.from_matrix(transform.rotation).as_rotvec()
    translation, vector = (tuple((np.round(values, 4) + 0.0).tolist()) for values in (transform.translation, turn))
    text = f"{how}: translation {translation} m, rotation vector {vector} rad"
    return f"{text}, scale {transform.scale:.5f}" if how == "sim3" else text


def write_score(score: TrajectoryScore, out: Path) -> None:
    """Write the report of a comparison into the folder ``out``. Files of a previous report are replaced.

    The files are ``errors.csv`` (a row for each pair of poses), ``report.html``, the plots as PNG in ``plots``, and
    ``score.json`` (settings, statistics, alignment and warnings).
    """
    with writing(out):
        (out / "plots").mkdir(parents=True, exist_ok=True)
        for name in reversed(FILES):
            (out / name).unlink(missing_ok=True)
        write_picture(_trajectories(score), out / "plots" / "trajectories.png")
        write_picture(_errors(score), out / "plots" / "errors.png")
        write_text(out / FILES[0], errors_of(score).write_csv())
        write_text(out / FILES[1], page(score))
        write_text(out / FILES[2], json_text(score.document()))


def errors_of(score: TrajectoryScore) -> pl.DataFrame:
    """Return the table of ``errors.csv``, with a row for each pair of poses.

    The columns are timestamps [ns] and aligned positions [m] of both trajectories, and errors of position [m] and
    rotation [rad]. Missing timestamps are empty.
    """
    rotation = score.ape.rotation
    columns = [
        pl.Series(name, [None] * len(path) if path.t_ns is None else path.t_ns, pl.Int64)
        for name, path in (("t_ns", score.estimate), ("reference_t_ns", score.reference))
    ]
    for prefix, path in (("", score.estimate), ("reference_", score.reference)):
        columns += [pl.Series(f"{prefix}{axis}", path.positions[:, i]) for i, axis in enumerate("xyz")]
    columns.append(pl.Series("error_position", score.ape.position))
    columns.append(
        pl.Series("error_rotation", [None] * len(score.estimate) if rotation is None else rotation, pl.Float64)
    )
    return pl.DataFrame(columns)
