"""Plots of the residuals of the odometry calibration, as PNG images."""

from collections.abc import Sequence

import numpy as np

from factorgraph_loc.drawing.figures import COLOURS, grid, legend, png
from factorgraph_loc.sensors.odometry.calibration.noise import BLACKOUT, LENGTHS
from factorgraph_loc.sensors.odometry.calibration.windows import Windows, cut
from factors.odometry.model import OdometryModel
from factors.se2 import Array

_VIEW = 5.0  # robust standard deviations; larger residuals are drawn at the edge


def odometry_figure(windows: Sequence[Windows], model: OdometryModel) -> bytes:
    """Residuals over windows: in time, over distance, and their growth with the length of the window."""
    figure, axes = grid(3, 3, 12.0)
    residuals = [one.residuals(model) for one in windows]
    lengths = (*LENGTHS, BLACKOUT)
    growth = [_growth([cut(one.log, length) for one in windows], model) for length in lengths]
    for row, (panels, (what, unit)) in enumerate(
        zip(axes, (("along", "m"), ("lateral", "m"), ("heading", "rad")), strict=True)
    ):
        for i, (one, residual) in enumerate(zip(windows, residuals, strict=True)):
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


def _growth(windows: Sequence[Windows], model: OdometryModel) -> tuple[Array, Array]:
    """Root mean squares (3,) of the residuals and of the model's prediction for them."""
    squares = np.concatenate([one.residuals(model) for one in windows]) ** 2
    stated = np.concatenate([np.diagonal(one.covariances(model), axis1=1, axis2=2) for one in windows])
    if not len(squares):
        return np.full(3, np.nan), np.full(3, np.nan)
    return np.sqrt(np.mean(squares, axis=0)), np.sqrt(np.mean(stated, axis=0))
