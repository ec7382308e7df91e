"""Plots of what a calibration left over, as PNG images for its report."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from factorgraph_loc.calibration.learn import Knowledge
from factorgraph_loc.drawing.figures import COLOURS, grid, legend, png
from factorgraph_loc.sensors.odometry.calibration.noise import BLACKOUT, LENGTHS
from factorgraph_loc.sensors.odometry.calibration.windows import cut
from factorgraph_loc.sensors.odometry.model import odometry_model
from factorgraph_loc.text import plain
from factors.landmarks import model as bearing_range
from factors.se2 import Array

_SHOWN = 3000  # dots of a log in a panel
_VIEW = 5.0  # robust standard deviations; what lies beyond is drawn at the edge


def sightings_figure(knowledge: Knowledge) -> bytes:
    """Residuals of range and bearing: their distribution, over range, and over time."""
    settings = knowledge.rig.bearing_range
    assert settings is not None
    errors = [one.errors(settings) for one in knowledge.seen]
    rows = [(0, "range", "m"), (1, "bearing", "rad")]
    rows = [row for row in rows if any(np.isfinite(e[:, row[0]]).any() for e in errors)]
    figure, axes = grid(len(rows), 3, 4.0 * len(rows))
    for panels, (column, what, unit) in zip(axes, rows, strict=True):
        typical = np.concatenate(
            [bearing_range.sigmas(settings.model(), one.ranges)[:, column] for one in knowledge.seen]
        )
        limit = _VIEW * float(np.median(typical))
        edges = np.linspace(-limit, limit, 61)
        for i, (one, error) in enumerate(zip(knowledge.seen, errors, strict=True)):
            values = np.clip(error[:, column], -limit, limit)
            dots = slice(None, None, max(1, len(values) // _SHOWN))
            style = {"color": COLOURS[i % len(COLOURS)], "label": one.log.name}
            panels[0].hist(values[np.isfinite(values)], edges, density=True, histtype="step", linewidth=1.5, **style)
            panels[1].plot(one.ranges[dots], values[dots], ".", markersize=2, **style)
            panels[2].plot(one.t[dots], values[dots], ".", markersize=2, **style)
        density = np.mean(np.exp(-0.5 * (edges[:, None] / typical) ** 2) / (typical * np.sqrt(2.0 * np.pi)), axis=1)
        panels[0].plot(edges, density, color="0.3", linestyle="--", label="fitted scatter")
        far = np.nanmax(np.concatenate([one.ranges for one in knowledge.seen]))
        distance = np.linspace(0.0, far, 50) if np.isfinite(far) else np.zeros(0)
        scatter = bearing_range.sigmas(settings.model(), distance)[:, column]
        for sign in (-2.0, 2.0):
            panels[1].plot(distance, sign * scatter, color="0.3", linestyle="--", label="2 sigma of the scatter")
        panels[0].set(xlabel=f"{what} residual [{unit}]", ylabel=f"density [1/{unit}]")
        panels[1].set(xlabel="measured range [m]", ylabel=f"{what} residual [{unit}]")
        panels[2].set(xlabel="time [s]", ylabel=f"{what} residual [{unit}]")
    legend(figure, axes.flat, markers=3.0)
    return png(figure)


def correlation_figure(knowledge: Knowledge) -> bytes:
    """Autocorrelation of the residuals of one landmark, of each log."""
    columns = [(0, "range"), (1, "bearing")]
    columns = [c for c in columns if any(np.isfinite(one.function[:, c[0]]).any() for one in knowledge.correlations)]
    figure, axes = grid(1, max(1, len(columns)), 4.0)
    for axis, (column, what) in zip(axes[0], columns, strict=False):
        for i, (one, seen) in enumerate(zip(knowledge.correlations, knowledge.seen, strict=True)):
            known = np.isfinite(one.function[:, column])
            colour = COLOURS[i % len(COLOURS)]
            axis.plot(
                one.lags[known],
                one.function[known, column],
                "o-",
                color=colour,
                label=plain(seen.log.name.lstrip("_"), 40) or "log",
            )
        axis.axhline(np.exp(-1.0), color="0.3", linestyle="--", label="1/e")
        axis.axhline(0.0, color="0.5", linewidth=0.8)
        axis.set_xscale("log")
        axis.set(xlabel="time between two sightings of a landmark [s]", ylabel=f"correlation of {what} residuals")
    legend(figure, axes.flat, markers=3.0)
    return png(figure)


def odometry_figure(knowledge: Knowledge) -> bytes:
    """Residuals of the odometry over windows: in time, over distance, and how they grow with the length of the window."""
    model = odometry_model(knowledge.rig)
    figure, axes = grid(3, 3, 12.0)
    residuals = [one.residuals(model) for one in knowledge.windows]
    lengths = (*LENGTHS, BLACKOUT)
    growth = [_growth([cut(one.log, length) for one in knowledge.windows], model) for length in lengths]
    for row, (panels, (what, unit)) in enumerate(
        zip(axes, (("along", "m"), ("lateral", "m"), ("heading", "rad")), strict=True)
    ):
        for i, (one, residual) in enumerate(zip(knowledge.windows, residuals, strict=True)):
            start, end = one.states(model)
            limit = max(_VIEW * 1.4826 * float(np.median(np.abs(residual[:, row]))), 1e-3)
            values = np.clip(residual[:, row], -limit, limit)
            style = {"color": COLOURS[i % len(COLOURS)], "label": one.log.name}
            panels[0].plot(one.begin, values, ".", markersize=3, **style)
            panels[1].plot((end - start)[:, 4], values, ".", markersize=3, **style)
        panels[2].plot(
            lengths, [g[0][row] for g in growth], "o-", color=COLOURS[0], label="residuals, root mean square"
        )
        panels[2].plot(lengths, [g[1][row] for g in growth], "s--", color="0.3", label="noise in the rig")
        panels[2].set_xscale("log")
        panels[2].set_yscale("log")
        panels[0].set(xlabel="time [s]", ylabel=f"{what} [{unit}] in 2 s")
        panels[1].set(xlabel="distance [m] in 2 s", ylabel=f"{what} [{unit}] in 2 s")
        panels[2].set(xlabel="length of the window [s]", ylabel=f"{what} [{unit}]")
    legend(figure, axes.flat, markers=3.0)
    return png(figure)


def _growth(windows: Sequence[Any], model: Any) -> tuple[Array, Array]:
    """Root mean squares (3,) of the residuals and of what the model says they are."""
    squares = np.concatenate([one.residuals(model) for one in windows]) ** 2
    stated = np.concatenate([np.diagonal(one.covariances(model), axis1=1, axis2=2) for one in windows])
    if not len(squares):
        return np.full(3, np.nan), np.full(3, np.nan)
    return np.sqrt(np.mean(squares, axis=0)), np.sqrt(np.mean(stated, axis=0))
