"""Plots of the runs of one or several estimators on a log."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from factorgraph_loc.drawing.figures import COLOURS, grid, legend, styles
from factorgraph_loc.evaluation.figures import Track, consistency, gapped_path, mark_events, with_pauses, write_picture
from factorgraph_loc.evaluation.metrics import Errors, errors
from factorgraph_loc.files.models import file_name
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.result import Reliability, RunResult
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.interfaces import Marks, marks
from factors.se2 import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_FILES = (
    "*-trajectories.png",
    "*-error-distribution.png",
    "*-errors-*.png",
    "*-consistency-*.png",
    "*-reliability-*.png",
)


def plot_log(log: Log, tracks: Mapping[str, Track], folder: Path) -> list[Path]:
    """Write the plots of the runs on a log into ``folder``. Return the paths of the PNG files.

    ``tracks``: by estimator, the plotted data of its run. The names of the files start with the name of the log:

    - ``trajectories``: the trajectories of all estimators.
    - ``error-distribution``: the distribution of errors, for several estimators and a log with a reference.
    - ``errors-ESTIMATOR``: errors over time, if there is a reference.
    - ``consistency-ESTIMATOR``: NEES and NIS, if there is a reference or if there are innovations.
    - ``reliability-ESTIMATOR``: observed and predicted numbers of detections, if there are RFID tags.
    """
    figures = {"trajectories": trajectories(log, tracks)}
    if log.reference is not None and len(tracks) > 1:
        figures["error-distribution"] = error_distribution(log, log.reference, tracks)
    for estimator, track in tracks.items():
        figures |= _estimator_figures(log, estimator, track)
    folder.mkdir(parents=True, exist_ok=True)
    paths = {folder / f"{file_name(log.name)}-{what}.png": figure for what, figure in figures.items()}
    for path, figure in paths.items():
        write_picture(figure, path)
    return list(paths)


def write_plots(result: RunResult, log: Log, out: Path) -> None:
    """Write the plots of a run into ``out/plots``, and remove the plots of a previous run from it."""
    remove_plots(out / "plots")
    plot_log(log, {str(result.config["estimator"]): Track.of(result)}, out / "plots")


def remove_plots(folder: Path) -> None:
    """Remove the plots of a previous run or comparison from a folder. Other files are kept."""
    for pattern in _FILES:
        for plot in folder.glob(pattern):
            plot.unlink()


def _estimator_figures(log: Log, estimator: str, track: Track) -> dict[str, Figure]:
    """Return the plots of a single estimator as {end of the file name, such as "errors-ekf": figure}."""
    if not len(track.final):
        return {}
    figures = {}
    if log.reference is not None:
        figures[f"errors-{estimator}"] = error_bands(log, log.reference, estimator, track)
    figure = consistency(log, estimator, track)
    if figure is not None:
        figures[f"consistency-{estimator}"] = figure
    if track.reliability:
        figures[f"reliability-{estimator}"] = reliability_diagram(log, estimator, track.reliability)
    return figures


def trajectories(log: Log, tracks: Mapping[str, Track]) -> Figure:
    """Return a figure of causal and final trajectories with walls, map objects and reference. ``tracks``: by estimator,
    the data of its run. The range of the axes fits map and reference."""
    view, height = _plotted_area(log)
    figure, axes = grid(1, 2, height, f"{log.name}: trajectories")
    for i, axis in enumerate(axes[0]):
        _map(axis, log, view)
        for (estimator, track), style in zip(tracks.items(), styles(), strict=False):
            kind, trajectory = track.kinds()[i]
            if trajectory is not None:
                axis.plot(*gapped_path(trajectory).T, label=estimator, linewidth=1.2, zorder=3, **style)
                axis.plot(*trajectory.poses[0, :2], "o", color=style["color"], markersize=5, zorder=4)
            axis.set_title(f"{kind} (dot: start)")
    legend(figure, axes[0])
    return figure


def overview(log: Log, odometry: Trajectory | None) -> Figure:
    """Return a figure of a log from above: its map, its reference, and the dead reckoning from the start (``odometry``,
    None if it is unknown)."""
    view, height = _plotted_area(log)
    figure, axes = grid(1, 1, height, log.name)
    _map(axes[0, 0], log, view)
    if odometry is not None and len(odometry):
        axes[0, 0].plot(*gapped_path(odometry).T, label="odometry", linewidth=1.2, zorder=3, color=COLOURS[0])
        axes[0, 0].plot(*odometry.poses[0, :2], "o", label="start", color=COLOURS[0], markersize=5, zorder=4)
    legend(figure, axes[0])
    return figure


def reliability_diagram(log: Log, estimator: str, reliability: Mapping[str, Reliability]) -> Figure:
    """Return a figure of the ratio of observed to predicted numbers of detections, with 2-sigma bars.

    ``log``, ``estimator``: for the title. ``reliability``: by sensor, the numbers of detections in groups of
    measurements, such as ranges of distance.
    """
    figure, axes = grid(
        len(reliability), 1, 3.2 * len(reliability), f"{log.name}, {estimator}: observed over predicted detections"
    )
    for axis, sensor in zip(axes[:, 0], reliability.values(), strict=True):
        place = np.arange(len(sensor.groups))
        label = "expected for a correct model (2 sigma)"
        axis.errorbar(
            place,
            np.ones(len(place)),
            2.0 * sensor.sigma / sensor.predicted,
            fmt="none",
            color=COLOURS[1],
            label=label,
        )
        axis.plot(
            place,
            sensor.observed / sensor.predicted,
            "o",
            color=COLOURS[0],
            label=f"{sensor.what}, observed over predicted",
        )
        axis.axhline(1.0, color="0.7", linewidth=0.8, zorder=1)
        axis.set_xticks(place, sensor.groups, rotation=40, ha="right")
        axis.set_ylim(bottom=0.0)
    legend(figure, axes[:, 0])
    return figure


def error_bands(log: Log, reference: Trajectory, estimator: str, track: Track) -> Figure:
    """Return a figure of signed errors in x, y and heading over time, of causal and final poses, with 2-sigma bands.
    ``log``, ``estimator``: for the title. ``reference``: the true poses. ``track``: the data of the run."""
    rows = (("x", "m"), ("y", "m"), ("heading", "rad"))[: 3 if reference.has_heading else 2]
    figure, axes = grid(
        len(rows), 2, 3.0 * len(rows), f"{log.name}, {estimator}: errors, with 2-sigma bands", shared=True
    )
    all_errors = [
        None if estimated is None else errors(estimated, reference, track.max_gap) for _, estimated in track.kinds()
    ]
    for column, (kind, trajectory) in enumerate(track.kinds()):
        axes[0, column].set_title(kind)
        axes[-1, column].set_xlabel("time [s]")
        e = all_errors[column]
        if trajectory is None or e is None:
            for axis in axes[:, column]:
                axis.text(0.5, 0.5, "no causal estimate", ha="center", transform=axis.transAxes, color="0.4")
            continue
        for row in range(len(rows)):
            _band(axes[row, column], trajectory, e, row)
            mark_events(axes[row, column], track.events)
    for row, (what, unit) in enumerate(rows):
        limit = max(
            (_extent(e, t, row) for e, (_, t) in zip(all_errors, track.kinds(), strict=True) if e and t), default=1.0
        )
        axes[row, 0].set(ylim=(-limit, limit), ylabel=f"error in {what} [{unit}]")
    legend(figure, axes[0])
    return figure


def error_distribution(log: Log, reference: Trajectory, tracks: Mapping[str, Track]) -> Figure:
    """Return a figure of the cumulative distributions of position and heading errors of causal and final poses.

    ``log``: for the title. ``reference``: the true poses. ``tracks``: by estimator, the data of its run. The axis of
    errors is logarithmic.
    """
    rows = (("position", "m"), ("heading", "rad"))[: 2 if reference.has_heading else 1]
    figure, axes = grid(len(rows), 2, 4.5 * len(rows), f"{log.name}: distribution of errors")
    for (estimator, track), style in zip(tracks.items(), styles(), strict=False):
        for column, (kind, trajectory) in enumerate(track.kinds()):
            axes[0, column].set_title(kind)
            if trajectory is None:
                continue
            e = errors(trajectory, reference, track.max_gap)
            for row, (what, _) in enumerate(rows):
                distribution(axes[row, column], getattr(e, what), label=estimator, **style)
    for row, (what, unit) in enumerate(rows):
        for axis in axes[row]:
            axis.set(xlabel=f"{what} error [{unit}]", ylabel="fraction of smaller errors")
        same_range(axes[row])
    legend(figure, axes[0])
    return figure


def _map(axis: Axes, log: Log, view: Array | None) -> None:
    """Draw walls, map objects and reference. ``view`` (2, 2) [m]: lower and upper corner of the axes, None for all."""
    if log.reference is not None:
        axis.plot(*gapped_path(log.reference).T, color="0.75", linewidth=4.0, label="reference", zorder=1)
    walls = np.array(log.world.walls).reshape(-1, 2, 2)
    if len(walls):
        axis.plot(*_joined(walls).T, color="0.45", linewidth=1.0, label="walls", zorder=1)
    for m in sorted(_layers(log), key=lambda m: m.order):
        if len(m.positions):
            style: dict[str, Any] = {"markersize": m.size, "label": m.layer, "zorder": m.order}
            axis.plot(*m.positions[:, :2].T, f"k{m.marker}", markerfacecolor="none", **style)
    axis.set_aspect("equal", adjustable="box")
    axis.set(xlabel="x [m]", ylabel="y [m]")
    if view is not None:
        axis.set(xlim=(view[0, 0], view[1, 0]), ylim=(view[0, 1], view[1, 1]))


def _layers(log: Log) -> list[Marks]:
    """Return the layers of the map that are drawn as individual objects. Layers of many points are omitted."""
    return [m for m in marks(log) if not m.dense]


def _plotted_area(log: Log) -> tuple[Array | None, float]:
    """Return the lower and upper corner (2, 2) [m] of the plotted area, and the height of the figure [100 px]. The
    corners are None for a log without a reference."""
    places = (*(m.positions[:, :2] for m in _layers(log)), np.array(log.world.walls).reshape(-1, 2))
    view = _bounding_box(np.concatenate(places), log.reference)
    return view, 8.5 if view is None else float(np.clip(7.0 * np.divide(*(view[1] - view[0])[::-1]) + 1.5, 5.0, 14.0))


def _joined(segments: Array) -> Array:
    """Return W segments (W, 2, 2) as one polyline (3 W, 2) with a row of NaN after each segment."""
    return np.insert(segments, 2, np.nan, axis=1).reshape(-1, 2)


def _bounding_box(places: Array, reference: Trajectory | None) -> Array | None:
    """Return the lower and upper corner (2, 2) of a box around the points ``places`` (N, 2) and the reference, with a
    margin. None without a reference."""
    if reference is None or not len(reference):
        return None
    points = np.concatenate((places, reference.poses[:, :2]))
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.08 * max(*(high - low), 1.0)
    return np.array((low - margin, high + margin))


def _band(axis: Axes, trajectory: Trajectory, e: Errors, row: int) -> None:
    """Plot a component of the errors ``e`` of a trajectory over time, and a band of two standard deviations around 0.

    ``row``: the component, 0 for x, 1 for y, 2 for the heading.
    """
    t = trajectory.t
    axis.axhline(0.0, color="0.5", linewidth=0.8)
    if trajectory.covariances is not None:
        at, sigma = with_pauses(t, np.sqrt(trajectory.covariances[:, row, row]))
        axis.fill_between(at, -2.0 * sigma, 2.0 * sigma, color=COLOURS[5], alpha=0.45, linewidth=0.0, label="2 sigma")
    axis.plot(
        *with_pauses(e.t, e.difference[:, row]), color=COLOURS[0], linewidth=1.0, label="error (gaps: no reference)"
    )
    axis.set_xlim(t[0], max(t[-1], t[0] + 1e-3))


def _extent(e: Errors, trajectory: Trajectory, row: int) -> float:
    """Return the upper end of the y axis of a plot of errors and 2-sigma bands. The lower end is its negative. The axis
    shows 99.5 % of the errors ``e`` and band limits. ``row``: the component, 0 for x, 1 for y, 2 for the heading."""
    values = np.abs(e.difference[:, row])
    if trajectory.covariances is not None:
        values = np.concatenate((values, 2.0 * np.sqrt(trajectory.covariances[:, row, row])))
    values = values[np.isfinite(values)]
    return 1.15 * float(np.percentile(values, 99.5)) + 1e-6 if len(values) else 1.0


def distribution(axis: Axes, values: Array, **style: Any) -> None:
    """Plot the cumulative distribution of ``values`` on a logarithmic axis. ``style``: keyword arguments of
    matplotlib's plot."""
    values = np.sort(values[np.isfinite(values)])
    axis.set(xscale="log", ylim=(0.0, 1.0))
    if len(values):
        # a logarithmic axis has no 0
        axis.plot(np.maximum(values, 1e-6), np.arange(1, len(values) + 1) / len(values), linewidth=2.0, **style)


def same_range(axes: Any) -> None:
    """Give all axes the same x range, which contains at least 99 % of the plotted values."""
    drawn = [line.get_xdata() for axis in axes for line in axis.lines]
    if drawn:
        low = min(float(np.percentile(x, 1.0)) for x in drawn)
        high = max(float(np.max(x)) for x in drawn)
        for axis in axes:
            axis.set_xlim(low, max(high * 1.1, low * 1.1))
