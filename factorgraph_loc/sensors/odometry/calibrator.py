"""The calibrator of wheel odometry, from the motion of the reference over short windows."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_loc.drawing.figures import COLOURS, grid, legend, png
from factorgraph_loc.drawing.pages import Part, Picture, Rows
from factorgraph_loc.errors import InputError
from factorgraph_loc.fitting.posterior import Parameter
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.calibrating import ConstantsCalibrator, SensorKnowledge, upper_bounds
from factorgraph_loc.sensors.motion import odometry_model
from factorgraph_loc.sensors.odometry import calibration as odometry
from factorgraph_loc.sensors.odometry.calibration import (
    BLACKOUT,
    LENGTHS,
    NoiseFit,
    Windows,
    cut,
    fit_noise,
    odometry_of,
)
from factorgraph_loc.sensors.odometry.measurement import IncrementStream, VelocityStream
from factorgraph_loc.sensors.odometry.settings import (
    GrowthSettings,
    OdometryNoise,
    OdometrySettings,
    OdometryUncertainty,
)
from factorgraph_loc.sensors.smoothed import Traced
from factorgraph_loc.text import number
from factors.odometry.model import OdometryModel
from factors.se2 import Array

MIN_WINDOWS = 15
MOST_OUTLIERS = 0.05  # share of the windows
KINDS = {VelocityStream: "velocities", IncrementStream: "increments"}
_VIEW = 5.0  # robust standard deviations; larger residuals are drawn at the edge


@dataclass(frozen=True)
class WheelsFit:
    """The ``windows`` of 2 s, and the ``noise`` of the odometry ``model``."""

    windows: Sequence[Windows]
    model: OdometryModel
    noise: NoiseFit


class OdometryCalibrator(ConstantsCalibrator):
    """The calibrator of wheel odometry."""

    section, channel, senses = "odometry", "odometry", False
    uncertain = upper_bounds(OdometryUncertainty)

    def check_alike(self, first: Log, log: Log) -> None:
        """InputError if one log reports velocities and the other increments."""
        ours, theirs = (KINDS[type(odometry_of(one))] for one in (log, first))
        if ours != theirs:
            raise InputError(
                f"{log.name}: its odometry has {ours}, that of {first.name} {theirs}; expected logs of one robot type"
            )

    def learn(
        self, traced: Sequence[Traced], rig: Rig, first: Rig, grids: Path | None, like: SensorKnowledge | None = None
    ) -> SensorKnowledge:
        """The constants and the noise, if the reference has headings."""
        reference = traced[0].log.reference
        has_heading = reference is not None and reference.has_heading
        return super().learn(traced, rig, first, grids, like) if has_heading else SensorKnowledge()

    def part(self, log: Log) -> Windows:
        """Windows of the log; InputError if there are too few."""
        found = cut(log, odometry.WINDOW)
        if len(found.begin) < MIN_WINDOWS:
            raise InputError(
                f"{log.name}: odometry and reference overlap in {len(found.begin)} windows of {odometry.WINDOW:g} s, expected "
                f"{MIN_WINDOWS} or more"
            )
        return found

    def parameters(self, parts: Sequence[Windows], settings: OdometrySettings) -> list[Parameter]:
        """The constants, of velocities also their delay, lag and slowdown."""
        return odometry.parameters_of(parts[0], settings)

    def with_noise(
        self, parts: Sequence[Windows], settings: OdometrySettings
    ) -> tuple[Sequence[Windows], OdometrySettings]:
        """The windows with the scatter of their errors."""
        return odometry.with_scatter(parts, settings), settings

    def finished(
        self, logs: Sequence[Log], parts: Sequence[Windows], rig: Rig, learnt: SensorKnowledge
    ) -> SensorKnowledge:
        """The result with the noise that remains."""
        noise = fit_noise(logs, odometry_model(rig))
        growth = {
            error: GrowthSettings.bounded(per_distance=g.per_distance, per_rotation=g.per_rotation, per_time=g.per_time)
            for error, g in noise.growth.items()
        }
        settings = rig.odometry.model_copy(update={"noise": OdometryNoise(**growth)})
        details = WheelsFit(parts, odometry_model(rig.model_copy(update={"odometry": settings})), noise)
        return replace(learnt, sections={self.section: settings}, details=details)

    def doubts(self, found: SensorKnowledge) -> list[str]:
        """Warnings about outliers and implausibly low noise."""
        doubts = []
        noise = None if found.details is None else found.details.noise
        if noise is not None and noise.outliers > MOST_OUTLIERS:
            doubts.append(
                f"{100.0 * noise.outliers:.0f} % of the odometry windows are outliers: check for slip, collisions, and gaps in "
                "the reference."
            )
        if noise is not None and noise.floored:
            doubts.append(
                f"The fitted noise of the odometry ({', '.join(noise.floored)}) is lower than wheels can achieve and was raised: "
                "the reference is probably not independent of the odometry."
            )
        return doubts

    def document(self, found: SensorKnowledge, rig: Rig) -> dict[str, Any]:
        """The share of outliers, and the factor by which the noise was widened."""
        noise = None if found.details is None else found.details.noise
        return {
            "odometry_outliers": None if noise is None else noise.outliers,
            "odometry_widened": None if noise is None else noise.widened,
            "wheels": {name: calibrated for name, _, calibrated in _wheels(rig)} or None,
        }

    def report(self, found: SensorKnowledge, rig: Rig) -> dict[str, Sequence[Part]]:
        """The growth of each error, and plots of the residuals of the windows."""
        if found.details is None:
            return {}
        noise: NoiseFit = found.details.noise
        rows = [
            (error, *(number(v) for v in (g.per_distance, g.per_rotation, g.per_time)))
            for error, g in noise.growth.items()
        ]
        header = ("error of the odometry [m, m, rad]", "per sqrt(m)", "per sqrt(rad)", "per sqrt(s)")
        text = (
            f"{100.0 * noise.outliers:.1f} % of the windows were outliers. The odometry's noise was multiplied by "
            f"{noise.widened:.2f}, so that it is valid for half a minute without landmarks."
        )
        figure = odometry_figure(found.details.windows, found.details.model)
        return {"Noise": [(header, rows), *_wheels_table(rig), text], "Residuals of the odometry": [figure]}


def _wheels(rig: Rig) -> list[tuple[str, float, float]]:
    """Name, value in the rig and calibrated value [m] of what is known of the wheels."""
    settings = rig.of(OdometrySettings)
    if (drive := settings.wheels) is None:
        return []
    radius, track = drive.corrected(settings.scale_distance, settings.scale_rotation)
    known = [] if drive.radius is None or radius is None else [("radius", drive.radius, radius)]
    return [*known, ("track", drive.track, track)]


def _wheels_table(rig: Rig) -> list[Rows]:
    """Radius and track of the wheels, if the rig has them."""
    rows: list[tuple[str, ...]] = [(f"{name} [m]", number(given), number(found)) for name, given, found in _wheels(rig)]
    return [(("wheels", "in the rig", "with its scales"), rows)] if rows else []


CALIBRATOR = OdometryCalibrator()


def odometry_figure(windows: Sequence[Windows], model: OdometryModel) -> Picture:
    """Residuals over windows: in time, over distance, and their growth with the length of the window."""
    figure, axes = grid(3, 3, 12.0)
    residuals = [one.errors(model) for one in windows]
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
        panels[2].set(xscale="log", yscale="log")
        panels[0].set(xlabel="time [s]", ylabel=f"{what} [{unit}] in 2 s")
        panels[1].set(xlabel="distance [m] in 2 s", ylabel=f"{what} [{unit}] in 2 s")
        panels[2].set(xlabel="length of the window [s]", ylabel=f"{what} [{unit}]")
    legend(figure, axes.flat, markers=3.0)
    return png(figure)


def _growth(windows: Sequence[Windows], model: OdometryModel) -> tuple[Array, Array]:
    """Root mean squares (3,) of the residuals and of the model's prediction for them."""
    squares = np.concatenate([one.errors(model) for one in windows]) ** 2
    stated = np.concatenate([np.diagonal(one.covariances(model), axis1=1, axis2=2) for one in windows])
    if not len(squares):
        return np.full(3, np.nan), np.full(3, np.nan)
    return np.sqrt(np.mean(squares, axis=0)), np.sqrt(np.mean(stated, axis=0))
