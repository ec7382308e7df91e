"""Plots of the residuals of the calibration of a landmark sensor, as PNG images."""

from collections.abc import Sequence

import numpy as np

from factorgraph_loc.drawing.figures import COLOURS, grid, legend, png
from factorgraph_loc.sensors.landmarks.calibration import Correlation, Sightings
from factorgraph_loc.sensors.landmarks.settings import BearingRangeSettings
from factorgraph_loc.text import plain
from factors.landmarks import model as bearing_range

_SHOWN = 3000  # dots per log and panel
_VIEW = 5.0  # robust standard deviations; larger residuals are drawn at the edge


def sightings_figure(seen: Sequence[Sightings], settings: BearingRangeSettings) -> bytes:
    """Residuals of range and bearing: their distribution, over range, and over time."""
    errors = [one.errors(settings) for one in seen]
    rows = [(0, "range", "m"), (1, "bearing", "rad")]
    rows = [row for row in rows if any(np.isfinite(e[:, row[0]]).any() for e in errors)]
    figure, axes = grid(len(rows), 3, 4.0 * len(rows))
    for panels, (column, what, unit) in zip(axes, rows, strict=True):
        typical = np.concatenate([bearing_range.sigmas(settings.model(), one.ranges)[:, column] for one in seen])
        limit = _VIEW * float(np.median(typical))
        edges = np.linspace(-limit, limit, 61)
        for i, (one, error) in enumerate(zip(seen, errors, strict=True)):
            values = np.clip(error[:, column], -limit, limit)
            dots = slice(None, None, max(1, len(values) // _SHOWN))
            style = {"color": COLOURS[i % len(COLOURS)], "label": one.log.name}
            panels[0].hist(values[np.isfinite(values)], edges, density=True, histtype="step", linewidth=1.5, **style)
            panels[1].plot(one.ranges[dots], values[dots], ".", markersize=2, **style)
            panels[2].plot(one.t[dots], values[dots], ".", markersize=2, **style)
        density = np.mean(np.exp(-0.5 * (edges[:, None] / typical) ** 2) / (typical * np.sqrt(2.0 * np.pi)), axis=1)
        panels[0].plot(edges, density, color="0.3", linestyle="--", label="fitted scatter")
        far = np.nanmax(np.concatenate([one.ranges for one in seen]))
        distance = np.linspace(0.0, far, 50) if np.isfinite(far) else np.zeros(0)
        scatter = bearing_range.sigmas(settings.model(), distance)[:, column]
        for sign in (-2.0, 2.0):
            panels[1].plot(distance, sign * scatter, color="0.3", linestyle="--", label="2 sigma of the scatter")
        panels[0].set(xlabel=f"{what} residual [{unit}]", ylabel=f"density [1/{unit}]")
        panels[1].set(xlabel="measured range [m]", ylabel=f"{what} residual [{unit}]")
        panels[2].set(xlabel="time [s]", ylabel=f"{what} residual [{unit}]")
    legend(figure, axes.flat, markers=3.0)
    return png(figure)


def correlation_figure(seen: Sequence[Sightings], correlations: Sequence[Correlation]) -> bytes:
    """Autocorrelation of the residuals of one landmark, for each log."""
    columns = [(0, "range"), (1, "bearing")]
    columns = [c for c in columns if any(np.isfinite(one.function[:, c[0]]).any() for one in correlations)]
    figure, axes = grid(1, max(1, len(columns)), 4.0)
    for axis, (column, what) in zip(axes[0], columns, strict=False):
        for i, (one, of) in enumerate(zip(correlations, seen, strict=True)):
            known = np.isfinite(one.function[:, column])
            colour = COLOURS[i % len(COLOURS)]
            axis.plot(
                one.lags[known],
                one.function[known, column],
                "o-",
                color=colour,
                label=plain(of.log.name.lstrip("_"), 40) or "log",
            )
        axis.axhline(np.exp(-1.0), color="0.3", linestyle="--", label="1/e")
        axis.axhline(0.0, color="0.5", linewidth=0.8)
        axis.set_xscale("log")
        axis.set(xlabel="time between two sightings of a landmark [s]", ylabel=f"correlation of {what} residuals")
    legend(figure, axes.flat, markers=3.0)
    return png(figure)
