"""The calibrator of wheel odometry, from the motion of the reference over short windows."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_loc.drawing.figures import COLOURS, grid, legend, png
from factorgraph_loc.drawing.pages import Part, Picture, Rows
from factorgraph_loc.errors import InputError
from factorgraph_loc.fitting.constants import FittedConstant
from factorgraph_loc.fitting.robust import Constant, Fit, folds, gains
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.calibrating import (
    BLOCKS,
    ConstantsCalibrator,
    ConstantsFound,
    Settled,
    Told,
    Unit,
    upper_bounds,
)
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
from factorgraph_loc.text import number
from factors.odometry.model import OdometryModel
from factors.se2 import Array

MIN_WINDOWS = 20
ROUNDS = 2  # of fitting constants and scatter in turn
MOST_OUTLIERS = 0.05  # share of the windows
NOISE = Unit("odometry", ("noise",))
KINDS = {VelocityStream: "velocities", IncrementStream: "increments"}
_VIEW = 5.0  # robust standard deviations; larger residuals are drawn at the edge


@dataclass(frozen=True)
class WheelsFit(ConstantsFound):
    """The parts are windows of 2 s. ``sigmas`` (3,) of the residuals."""

    sigmas: Array = field(default_factory=lambda: np.ones(3))


class OdometryCalibrator(ConstantsCalibrator):
    """The calibrator of wheel odometry."""

    section, channel, senses = "odometry", "odometry", False
    noise = (NOISE,)
    uncertain = upper_bounds(OdometryUncertainty)
    together = (("delay", "lag"),)

    def check_alike(self, first: Log, log: Log) -> None:
        """InputError if one log reports velocities and the other increments."""
        ours, theirs = (KINDS[type(odometry_of(one))] for one in (log, first))
        if ours != theirs:
            raise InputError(
                f"{log.name}: its odometry has {ours}, that of {first.name} {theirs}; expected logs of one robot type"
            )

    def learn(self, logs: Sequence[Log], rig: Rig, _grids: Path | None, _like: Any) -> WheelsFit | None:
        """Fit the constants of the odometry if the reference has headings."""
        if logs[0].reference is None or not logs[0].reference.has_heading:
            return None
        windows = tuple(cut(log, odometry.WINDOW) for log in logs)
        for one in windows:
            if len(one.begin) < MIN_WINDOWS:
                raise InputError(
                    f"{one.log.name}: odometry and reference overlap in {len(one.begin)} windows of {odometry.WINDOW:g} s, "
                    f"expected {MIN_WINDOWS} or more"
                )
        constants, model = odometry.constants_of(windows[0], rig.odometry), odometry_model(rig)
        start = {c.name: c.neutral for c in constants}
        start |= {name: max(start[name], odometry.LAGGING_START) for name in ("delay", "lag") if name in start}
        for _ in range(ROUNDS):
            sigmas = odometry.scatter(windows, odometry.with_constants(model, start))
            everything = odometry.fit_odometry(windows, model, constants, sigmas, start)
            start = everything.as_dict()
        denied = odometry.denied_at_rest(everything, windows)
        gain = gains(everything, folds([one.begin for one in windows], BLOCKS), denied)
        return WheelsFit(windows, everything, gain, start, denied, sigmas)

    def base(self, _found: WheelsFit, rig: Rig, _accepted: Collection[str] | None) -> OdometryModel:
        """The odometry model of the input rig."""
        return odometry_model(rig)

    def changed(self, base: OdometryModel, values: Mapping[str, float]) -> OdometryModel:
        """The model with changed constants."""
        return odometry.with_constants(base, values)

    def fit(
        self,
        found: WheelsFit,
        parts: Sequence[Windows],
        base: OdometryModel,
        constants: Sequence[Constant],
        start: Mapping[str, float],
    ) -> Fit:
        """Fit with the scatter of all constants."""
        return odometry.fit_odometry(parts, base, constants, found.sigmas, start)

    def finished(
        self,
        _found: WheelsFit,
        logs: Sequence[Log],
        rig: Rig,
        base: OdometryModel,
        learnt: Sequence[FittedConstant],
        *,
        by_log: bool,
    ) -> Settled:
        """The result with the remaining noise."""
        noise = fit_noise(logs, base)
        growth = {
            error: GrowthSettings.bounded(per_distance=g.per_distance, per_rotation=g.per_rotation, per_time=g.per_time)
            for error, g in noise.growth.items()
        }
        changed: dict[str, Any] = {one.name: one.value for one in learnt} | {"noise": OdometryNoise(**growth)}
        return Settled({"odometry": rig.odometry.model_copy(update=changed)}, learnt, details=noise)

    def doubts(self, _found: WheelsFit, details: NoiseFit | None) -> list[str]:
        """Warnings about outliers and implausibly low noise."""
        doubts = []
        if details is not None and details.outliers > MOST_OUTLIERS:
            doubts.append(
                f"{100.0 * details.outliers:.0f} % of the odometry windows are outliers: check for slip, collisions, and gaps in "
                "the reference."
            )
        if details is not None and details.floored:
            doubts.append(
                f"The fitted noise of the odometry ({', '.join(details.floored)}) is lower than wheels can achieve and was raised: "
                "the reference is probably not independent of the odometry."
            )
        return doubts

    def document(self, told: Told) -> dict[str, Any]:
        """The share of outliers, and the factor by which the noise was widened."""
        noise: NoiseFit | None = told.details
        return {
            "odometry_outliers": None if noise is None else noise.outliers,
            "odometry_widened": None if noise is None else noise.widened,
            "wheels": {name: calibrated for name, _, calibrated in _wheels(told.rig)} or None,
        }

    def tables(self, told: Told) -> list[Rows]:
        """Radius and track of the wheels, if the rig tells of any."""
        rows: list[tuple[str, ...]] = [
            (f"{name} [m]", number(given), number(found)) for name, given, found in _wheels(told.rig)
        ]
        return [(("wheels", "in the rig", "with its scales"), rows)] if rows else []

    def report(self, told: Told) -> dict[str, Sequence[Part]]:
        """The growth of each error, and plots of the residuals of the windows."""
        noise: NoiseFit | None = told.details
        out: list[Part] = []
        if noise is not None:
            if NOISE not in told.accepted:
                out.append("The noise of the odometry below is rejected: the rig keeps that of the input.")
            rows = [
                (error, *(number(v) for v in (g.per_distance, g.per_rotation, g.per_time)))
                for error, g in noise.growth.items()
            ]
            header = ("error of the odometry [m, m, rad]", "per sqrt(m)", "per sqrt(rad)", "per sqrt(s)")
            out += [(header, rows), *self.tables(told)]
            out.append(
                f"{100.0 * noise.outliers:.1f} % of the windows were outliers. The odometry's noise was multiplied by "
                f"{noise.widened:.2f}, so that it is valid for half a minute without landmarks."
            )
        if told.found is None:
            return {"Noise": out}
        figure = odometry_figure(told.found.parts, odometry_model(told.learnt))
        return {"Noise": out, "Residuals of the odometry": [figure]}


def _wheels(rig: Rig) -> list[tuple[str, float, float]]:
    """Name, value in the rig and calibrated value [m] of what is known of the wheels."""
    settings = rig.of(OdometrySettings)
    if (drive := settings.wheels) is None:
        return []
    radius, track = drive.corrected(settings.scale_distance, settings.scale_rotation)
    known = [] if drive.radius is None or radius is None else [("radius", drive.radius, radius)]
    return [*known, ("track", drive.track, track)]


CALIBRATOR = OdometryCalibrator()


def odometry_figure(windows: Sequence[Windows], model: OdometryModel) -> Picture:
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
        panels[2].set(xscale="log", yscale="log")
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
