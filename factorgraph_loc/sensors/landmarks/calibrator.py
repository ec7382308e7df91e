"""The calibrator of a landmark sensor, from sightings at reference poses and the EKF's errors."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from factorgraph_loc.drawing.figures import COLOURS, grid, legend, png
from factorgraph_loc.drawing.pages import Part, Picture, Rows
from factorgraph_loc.errors import InputError
from factorgraph_loc.fitting.constants import FittedConstant
from factorgraph_loc.fitting.robust import Fit, folds, gains
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.calibrating import BLOCKS, ConstantsCalibrator, ConstantsFound, Settled, Told, Unit
from factorgraph_loc.sensors.landmarks import calibration as sightings
from factorgraph_loc.sensors.landmarks.calibration import Correlation, Sightings
from factorgraph_loc.sensors.landmarks.settings import BearingRangeSettings
from factorgraph_loc.text import number, plain
from factors.landmarks import model as bearing_range

MIN_SIGHTINGS = 100
MOST_SIGHTINGS = 12000  # per log in fits
# ranges are of the other kind, distance or depth, if that reduces their spread below this share
BETTER_KIND = 0.9
ROUNDS = 2  # of fitting constants and scatter in turn
RANGE_KIND = "range_kind"
SIGMAS = {"range_sigma": "m", "range_sigma_relative": "m per m", "bearing_sigma": "rad"}
FIRST = BearingRangeSettings(range_sigma=0.1)  # settings of an unknown sensor
SCATTER = Unit("bearing_range", tuple(SIGMAS))
_SHOWN = 3000  # dots per log and panel
_VIEW = 5.0  # robust standard deviations; larger residuals are drawn at the edge


@dataclass(frozen=True)
class SensorFit(ConstantsFound):
    """The parts are thinned from all sightings ``seen``. ``settings``: with all constants and the scatter, for the kind of ranges
    that fits best."""

    settings: BearingRangeSettings = FIRST
    seen: tuple[Sightings, ...] = ()


class LandmarkCalibrator(ConstantsCalibrator):
    """The calibrator of a landmark sensor."""

    section, channel, is_consistent = "bearing_range", "bearing_range", True
    noise = (SCATTER,)
    uncertain = {"x": 10.0, "y": 10.0} | dict.fromkeys(
        ("bearing_bias", "range_scale", "depth_axis", "time_offset"), 1.0
    )
    together = (("x", "y"),)
    units: ClassVar[Mapping[str, str]] = {
        "x": "m",
        "y": "m",
        "bearing_bias": "rad",
        "depth_axis": "rad",
        "time_offset": "s",
    }
    first = FIRST

    def learn(self, logs: Sequence[Log], rig: Rig, _grids: Path | None, _like: Any) -> SensorFit | None:
        """The constants of the sensor, from logs with sightings."""
        if self.channel not in logs[0].streams:
            return None
        seen, before = tuple(_sightings(log) for log in logs), self.settings(rig)
        thinned = [one.thinned(MOST_SIGHTINGS) for one in seen]
        everything, settings = self._fit_and_scatter(thinned, before)
        if sightings.could_be_depths(thinned):
            other = before.model_copy(update={RANGE_KIND: "distance" if before.range_kind == "depth" else "depth"})
            found, changed = self._fit_and_scatter(thinned, other)
            if sightings.range_spread(thinned, changed) < BETTER_KIND * sightings.range_spread(thinned, settings):
                everything, settings = found, changed
        gain = gains(everything, folds([one.t for one in thinned], BLOCKS))
        return SensorFit(tuple(thinned), everything, gain, everything.as_dict(), (), settings, seen)

    def _fit_and_scatter(
        self, seen: Sequence[Sightings], before: BearingRangeSettings
    ) -> tuple[Fit, BearingRangeSettings]:
        """Fit all constants and the scatter in turn."""
        constants = sightings.constants_of(seen, before)
        start = {c.name: c.neutral for c in constants}
        settings = sightings.with_scatter(seen, before)
        for _ in range(ROUNDS):
            everything = self.fit(None, seen, settings, constants, start)
            start = everything.as_dict()
            settings = sightings.with_scatter(seen, self.changed(settings, start))
        return everything, settings

    def base(self, found: SensorFit, rig: Rig, accepted: Collection[str] | None) -> BearingRangeSettings:
        """The settings with the scatter of all constants, for the accepted kind of ranges."""
        settings = found.settings.model_copy(update={c.name: c.neutral for c in found.everything.constants})
        if accepted is None or f"{self.section}.{RANGE_KIND}" in accepted:
            return settings
        return settings.model_copy(update={RANGE_KIND: self.settings(rig).range_kind})

    def finished(
        self,
        found: SensorFit,
        _logs: Sequence[Log],
        rig: Rig,
        base: BearingRangeSettings,
        learnt: Sequence[FittedConstant],
        *,
        by_log: bool,
    ) -> Settled:
        """The result with the remaining scatter and the autocorrelation of errors."""
        settings = sightings.with_scatter(found.parts, base)
        before, notes = rig.bearing_range, []
        if before is not None and settings.range_kind != before.range_kind:
            notes.append(f"The ranges fit better as the {settings.range_kind} than as the {before.range_kind}.")
        correlations = tuple(sightings.correlation(one, settings) for one in found.seen if by_log)
        return Settled({self.section: settings}, learnt, notes, correlations)

    def constant_units(
        self, found: SensorFit, kept: Sequence[FittedConstant], learnt: Rig, start: Rig
    ) -> dict[Unit, float]:
        """The units; constants of another kind of ranges are left out."""
        if learnt.bearing_range.range_kind == self.settings(start).range_kind:
            return super().constant_units(found, kept, learnt, start)
        return {Unit(self.section, (*(c.name for c in kept), RANGE_KIND)): float("inf")}

    def inflated(self, rig: Rig, factor: float) -> Rig:
        """The rig with the sensor's standard deviations multiplied, limited to their bounds."""
        settings = rig.bearing_range
        update = {name: factor * getattr(settings, name) for name in SIGMAS}
        return rig.model_copy(update={self.section: settings.model_copy(update=update)})

    def document(self, told: Told) -> dict[str, Any]:
        """The factor on the noise, and the autocorrelation of errors."""
        return {
            "noise_factor": None if told.trial is None else told.trial.factor,
            "correlation": {
                log: {"next": c.next_one.tolist(), "time": c.time.tolist()}
                for log, c in zip(told.logs, told.details or (), strict=False)
            },
        }

    def report(self, told: Told) -> dict[str, Sequence[Part]]:
        """The scatter and the noise in the rig; the residuals of the sightings and their autocorrelation."""
        scatter, settings, trial = told.learnt.bearing_range, told.rig.bearing_range, told.trial
        if told.found is None or scatter is None or settings is None:
            return {}
        out: list[Part] = []
        if SCATTER not in told.accepted:
            out.append("The noise of the sightings is rejected: the rig keeps that of the input.")
        rows: list[tuple[str, ...]] = [
            (f"{n} [{unit}]", number(getattr(scatter, n)), number(getattr(settings, n))) for n, unit in SIGMAS.items()
        ]
        out.append((("noise of the sightings", "scatter", "in the rig"), rows))
        if trial is not None and SCATTER in told.accepted:
            out.append(
                f"The scatter was multiplied by {trial.factor:.2f} to make the EKF consistent "
                f"(ANEES over its ideal value: {trial.causal:.2f} causal, {trial.final:.2f} final)."
            )
        explained = (
            "Estimators assume independent errors. If the correlation is far above 0, many sightings contain little more "
            "information than one, and the noise in the rig must be larger than the scatter."
        )
        return {
            "Noise": out,
            "Correlation of consecutive errors": [explained, _correlations(told)],
            "Residuals of the sightings": [
                sightings_figure(told.found.seen, told.learnt.bearing_range),
                correlation_figure(told.found.seen, told.details),
            ],
        }


def _sightings(log: Log) -> Sightings:
    """The sightings of a log; InputError if there are too few."""
    seen = sightings.sightings_of(log)
    if len(seen.t) < MIN_SIGHTINGS:
        raise InputError(
            f"{log.name}: has {len(seen.t)} sightings of mapped landmarks within the reference, "
            f"expected {MIN_SIGHTINGS} or more"
        )
    return seen


def _correlations(told: Told) -> Rows:
    header = ("log", "range: next sighting", "falls to 1/e in [s]", "bearing: next sighting", "falls to 1/e in [s]")
    rows: list[tuple[str, ...]] = [
        (log, number(c.next_one[0], 2), number(c.time[0], 1), number(c.next_one[1], 2), number(c.time[1], 1))
        for log, c in zip(told.logs, told.details, strict=True)
    ]
    return header, rows


CALIBRATOR = LandmarkCalibrator()


def sightings_figure(seen: Sequence[Sightings], settings: BearingRangeSettings) -> Picture:
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


def correlation_figure(seen: Sequence[Sightings], correlations: Sequence[Correlation]) -> Picture:
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
        axis.set(
            xscale="log",
            xlabel="time between two sightings of a landmark [s]",
            ylabel=f"correlation of {what} residuals",
        )
    legend(figure, axes.flat, markers=3.0)
    return png(figure)
