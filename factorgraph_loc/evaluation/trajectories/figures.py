"""Plots of a score: both trajectories, and the errors over time and by size."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from factorgraph_loc.drawing.figures import COLOURS, grid, lay_out, legend
from factorgraph_loc.evaluation.pairing import pauses
from factorgraph_loc.evaluation.trajectories.score import PoseErrors, TrajectoryScore
from factors.se2 import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ESTIMATE, REFERENCE = "estimate", "reference"


def plots(score: TrajectoryScore) -> dict[str, Figure]:
    """The plots by name: ``trajectories``, ``errors``, and ``relative-errors`` where there are any."""
    drawn = {"trajectories": _trajectories(score), "errors": _absolute(score)}
    if any(errors is not None and len(errors.position) for errors in (score.rpe_per_m, score.rpe_per_s)):
        drawn["relative-errors"] = _relative(score)
    return drawn


def _trajectories(score: TrajectoryScore) -> Figure:
    """Seen from above; beside it the heights, unless both are planar."""
    flat = score.estimate.is_planar and score.reference.is_planar
    places = np.concatenate((score.estimate.positions, score.reference.positions))[:, :2]
    width, depth = np.maximum(np.ptp(places, axis=0), 1e-6)
    height = float(np.clip((14.0 if flat else 7.0) * depth / width + 1.5, 5.0, 10.0))
    figure, axes = grid(1, 1 if flat else 2, height, "trajectories, at the compared poses")
    x, label = _over(score)
    for path, look, name in (
        (score.reference, {"color": "0.75", "linewidth": 4.0}, REFERENCE),
        (score.estimate, {"color": COLOURS[0], "linewidth": 1.2}, ESTIMATE),
    ):
        broken = _broken(score, path.positions)
        axes[0, 0].plot(*broken[:, :2].T, label=name, **look)
        if not flat:
            axes[0, 1].plot(_broken(score, x), broken[:, 2], label=name, **look)
    axes[0, 0].plot(
        *score.estimate.positions[0, :2], "o", color=COLOURS[0], markersize=5, label="start of the estimate"
    )
    axes[0, 0].set_aspect("equal", adjustable="datalim")
    axes[0, 0].set_xlabel("x [m]")
    axes[0, 0].set_ylabel("y [m]")
    if not flat:
        axes[0, 1].set_xlabel(label)
        axes[0, 1].set_ylabel("z [m]")
    legend(figure, axes[0])
    lay_out(figure)  # the first layout changes the axes, and their labels would overlap the legend
    return figure


def _absolute(score: TrajectoryScore) -> Figure:
    rows = _kinds(score.ape)
    figure, axes = grid(len(rows), 2, 3.5 * len(rows), "absolute errors")
    x, label = _over(score)
    for (left, right), (what, unit, values) in zip(axes, rows, strict=True):
        left.plot(_broken(score, x), _broken(score, values), color=COLOURS[0], linewidth=1.2, label="error")
        left.axhline(np.sqrt(np.mean(values**2)), color=COLOURS[1], linestyle="--", linewidth=1.2, label="RMSE")
        left.set_xlabel(label)
        left.set_ylabel(f"{what} error [{unit}]")
        left.set_ylim(bottom=0.0)
        _distribution(right, values, f"{what} error [{unit}]")
    legend(figure, axes[0])
    return figure


def _relative(score: TrajectoryScore) -> Figure:
    kinds = [
        (over, errors)
        for over, errors in (("1 m", score.rpe_per_m), ("1 s", score.rpe_per_s))
        if errors is not None and len(errors.position)
    ]
    figure, axes = grid(2, len(kinds), 7.0, "relative errors")
    x, label = _over(score)
    for (upper, lower), (over, errors) in zip(axes.T, kinds, strict=True):
        upper.set_title(f"over {over}{' of path' if over == '1 m' else ''}")
        for axis, (what, unit, values) in zip((upper, lower), _kinds(errors), strict=True):
            axis.plot(x[errors.ends], values, ".", color=COLOURS[0], markersize=4, label="error at the end of a piece")
            axis.axhline(np.sqrt(np.mean(values**2)), color=COLOURS[1], linestyle="--", linewidth=1.2, label="RMSE")
            axis.set_xlabel(label)
            axis.set_ylabel(f"{what} error [{unit}]")
            axis.set_ylim(bottom=0.0)
    legend(figure, axes[0])
    return figure


def _kinds(errors: PoseErrors) -> list[tuple[str, str, Array]]:
    kinds = [("position", "m", errors.position)]
    return kinds if errors.rotation is None else [*kinds, ("rotation", "rad", errors.rotation)]


def _over(score: TrajectoryScore) -> tuple[Array, str]:
    """What the errors are plotted over: times (N,), or the numbers of the poses, and its label."""
    t = score.seconds()
    return (np.arange(1.0, len(score.estimate) + 1), "number of the pose") if t is None else (t, "time [s]")


def _broken(score: TrajectoryScore, values: Array) -> Array:
    """Values (N, ...) with a row of NaN in each gap in time, which interrupts the line."""
    t = score.seconds()
    return values if t is None else np.insert(values, pauses(t), np.nan, axis=0)


def _distribution(axis: Axes, values: Array, label: str) -> None:
    axis.plot(np.sort(values), np.arange(1, len(values) + 1) / len(values), color=COLOURS[0], linewidth=2.0)
    axis.set_xlim(left=0.0)
    axis.set_ylim(0.0, 1.0)
    axis.set_xlabel(label)
    axis.set_ylabel("share of poses below")
