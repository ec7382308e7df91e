"""Calibration of constants and noise of a landmark sensor, from sightings at reference poses and the EKF's errors."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from factorgraph_loc.drawing.figures import COLOURS, grid, legend, png
from factorgraph_loc.drawing.pages import Part, Picture
from factorgraph_loc.errors import InputError
from factorgraph_loc.fitting.constants import FittedConstant
from factorgraph_loc.fitting.robust import Constant, Fit, Integers, folds, gains, spread
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
from factorgraph_loc.sensors.landmarks.measurement import (
    BearingRangeSettings,
    BearingRangeStream,
    BearingRangeUncertainty,
)
from factorgraph_loc.sensors.smoothed import REFERENCE_GAP
from factorgraph_loc.text import number, plain
from factors.landmarks import model as bearing_range
from factors.se2 import Array

MAX_OFFSET = 0.5  # s between the clocks of the sensor and the reference
INLIER = 4.0  # standard deviations above which a sighting is excluded from the scatter
LAGS = np.concatenate(([0.0], np.geomspace(0.15, 60.0, 16)))  # s, edges of the bins of the autocorrelation
NEIGHBOURS = 200  # sightings of the same landmark used for the autocorrelation of each
MIN_PAIRS = 30  # minimum number per bin


@dataclass(frozen=True)
class Sightings:
    """K sightings of landmarks of the map: timestamps ``t`` (K,) by the sensor's clock, ``points`` (K, 2), ``ranges`` and
    ``bearings`` (K,), and ``track`` (K,), the index of the landmark in the map."""

    log: Log
    t: Array
    points: Array
    ranges: Array
    bearings: Array
    track: Integers

    def thinned(self, count: int) -> Sightings:
        """About ``count`` of the sightings, by keeping every n-th timestamp."""
        _, stamp = np.unique(self.t, return_inverse=True)
        return self._part(stamp % max(1, round(len(self.t) / count)) == 0)

    def halves(self) -> tuple[Sightings, Sightings]:
        """The first and the second half in time."""
        early = np.arange(len(self.t)) < len(self.t) // 2
        return self._part(early), self._part(~early)

    def residuals(self, settings: BearingRangeSettings) -> Array:
        """Range and bearing residuals (K, 2), predicted minus measured, in standard deviations; zero if not measured."""
        assert self.log.reference is not None
        poses = self.log.reference.at(self.t + settings.time_offset)
        return bearing_range.residuals(settings.model(), poses, self.points, self.ranges, self.bearings)

    def errors(self, settings: BearingRangeSettings) -> Array:
        """The residuals in m and rad, NaN if not measured."""
        out = self.residuals(settings) * bearing_range.sigmas(settings.model(), self.ranges)
        out[np.isnan(self.ranges), 0] = np.nan
        out[np.isnan(self.bearings), 1] = np.nan
        return out

    def _part(self, rows: NDArray[np.bool_]) -> Sightings:
        ranges, bearings = self.ranges[rows], self.bearings[rows]
        return Sightings(self.log, self.t[rows], self.points[rows], ranges, bearings, self.track[rows])


@dataclass(frozen=True)
class Correlation:
    """Autocorrelation of the residuals of a landmark, for range and bearing (2,).

    ``next_one``: correlation of consecutive sightings; ``time`` [s]: until it falls below 1/e; ``lags`` (B,) [s] and ``function``
    (B, 2). NaN if there are too few sightings.
    """

    next_one: Array
    time: Array
    lags: Array
    function: Array


def sightings_of(log: Log) -> Sightings:
    """The sightings of mapped landmarks within the reference, with a margin for clock offsets; InputError if there are too few."""
    stream = log.streams["bearing_range"]
    assert isinstance(stream, BearingRangeStream)
    assert log.reference is not None
    numbers = {name: i for i, name in enumerate(log.world.landmarks)}
    track = np.array([numbers.get(name, -1) for name in stream.landmark], dtype=np.int64)
    good = (track >= 0) & np.isfinite(log.reference.at(stream.t, max_gap=REFERENCE_GAP)[:, 0])
    good &= (stream.t > log.reference.t[0] + MAX_OFFSET) & (stream.t < log.reference.t[-1] - MAX_OFFSET)
    bearings = stream.bearing if log.reference.has_heading else np.full_like(stream.bearing, np.nan)
    good &= np.isfinite(stream.range) | np.isfinite(bearings)
    if (count := np.count_nonzero(good)) < MIN_SIGHTINGS:
        found = f"has {count} sightings of mapped landmarks within the reference"
        raise InputError(f"{log.name}: {found}, expected {MIN_SIGHTINGS} or more")
    points = log.world.positions()[track[good]]
    return Sightings(log, stream.t[good], points, stream.range[good], bearings[good], track[good])


def constants_of(seen: Sequence[Sightings], settings: BearingRangeSettings) -> tuple[Constant, ...]:
    """The constants that may be fitted, with the rig's values as neutral ones; only the range scale without reference headings."""
    has_range = any(np.isfinite(one.ranges).any() for one in seen)
    has_bearing = any(np.isfinite(one.bearings).any() for one in seen)
    has_heading = all(one.log.reference is not None and one.log.reference.has_heading for one in seen)
    candidates = (
        (has_heading, "x", 0.05, -10.0, 10.0),
        (has_heading, "y", 0.05, -10.0, 10.0),
        (has_bearing, "bearing_bias", 0.02, -np.pi, np.pi),
        (has_range, "range_scale", 0.02, 0.2, 5.0),
        (settings.range_kind == "depth", "depth_axis", 0.02, -np.pi, np.pi),
        (has_heading, "time_offset", 0.05, -MAX_OFFSET, MAX_OFFSET),
    )
    return tuple(Constant(name, getattr(settings, name), *scale) for use, name, *scale in candidates if use)


def with_scatter(seen: Sequence[Sightings], settings: BearingRangeSettings) -> BearingRangeSettings:
    """The settings with noise set to the maximum-likelihood scatter of the inliers.

    The variance of a range is that of a constant error plus that of an error proportional to the range.
    """
    errors = np.concatenate([one.errors(settings) for one in seen])
    ranges = np.concatenate([one.ranges for one in seen])
    found: dict[str, float] = {}
    if (measured := np.isfinite(errors[:, 0])).any():
        constant, relative = _range_scatter(errors[measured, 0], ranges[measured])
        found |= {"range_sigma": constant, "range_sigma_relative": relative}
    bearings = errors[np.isfinite(errors[:, 1]), 1]
    if len(bearings):
        sigma = float(spread(bearings[:, None])[0])
        for _ in range(5):
            sigma = float(np.std(bearings[np.abs(bearings) < INLIER * sigma]))
        found |= {"bearing_sigma": float(np.clip(sigma, 1e-4, 0.5))}
    return settings.model_copy(update=found)


def correlation(seen: Sightings, settings: BearingRangeSettings) -> Correlation:
    """Autocorrelation of the residuals of each landmark in one log, without outliers."""
    whitened = seen.errors(settings) / bearing_range.sigmas(settings.model(), seen.ranges)
    whitened[np.abs(whitened) > INLIER] = np.nan
    count = len(LAGS) - 1
    products, pairs = np.zeros((count, 2)), np.zeros((count, 2))
    neighbour, neighbours = np.zeros(2), np.zeros(2)
    for track in np.unique(seen.track):
        t, values = seen.t[seen.track == track], whitened[seen.track == track]
        for step in range(1, min(NEIGHBOURS, len(t))):
            product = values[step:] * values[:-step]
            bins = np.searchsorted(LAGS, t[step:] - t[:-step]) - 1
            inside, known = (bins >= 0) & (bins < count), np.isfinite(product)
            np.add.at(products, bins[inside], np.nan_to_num(product[inside]))
            np.add.at(pairs, bins[inside], known[inside])
            if step == 1:
                neighbour += np.nansum(product, axis=0)
                neighbours += known.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        variance = np.nansum(whitened**2, axis=0) / np.isfinite(whitened).sum(axis=0)
        function = np.where(pairs >= MIN_PAIRS, products / pairs, np.nan) / variance
        next_one = np.where(neighbours >= MIN_PAIRS, neighbour / neighbours, np.nan) / variance
    lags = 0.5 * (LAGS[1:] + LAGS[:-1])
    return Correlation(next_one, np.array([_falls(lags, values) for values in function.T]), lags, function)


def _falls(lags: Array, function: Array) -> float:
    """The lag at which the correlation falls below 1/e, or the last lag."""
    known = np.flatnonzero(np.isfinite(function))
    if not len(known):
        return float("nan")
    below = known[function[known] < np.exp(-1.0)][:1]
    if not len(below):
        return float(lags[known[-1]])
    rows = [*below, *known[known < below][-1:]]
    return float(np.interp(np.exp(-1.0), function[rows], lags[rows]))


def _range_scatter(errors: Array, ranges: Array) -> tuple[float, float]:
    """Standard deviation of a range: constant part [m] and relative part."""
    constant, relative = float(spread(errors[:, None])[0]), 0.0
    for _ in range(5):
        inside = np.abs(errors) < INLIER * np.hypot(constant, relative * ranges)
        inliers, near = errors[inside], ranges[inside]

        def cost(logs: Array, inliers: Array = inliers, near: Array = near) -> float:
            variance = np.exp(2.0 * logs[0]) + np.exp(2.0 * logs[1]) * near**2
            return float(np.mean(np.log(variance) + inliers**2 / variance))

        start = np.log((max(constant, 1e-3), max(relative, 0.01)))
        constant, relative = np.exp(minimize(cost, start, method="Nelder-Mead").x).tolist()
    return float(np.clip(constant, 1e-3, 10.0)), 0.0 if relative < 1e-3 else min(relative, 1.0)


MIN_SIGHTINGS = 100
MOST_SIGHTINGS = 12000  # per log in fits
BETTER_KIND = 0.9  # share of the spread below which ranges are of the other kind, distance or depth
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
    uncertain = upper_bounds(BearingRangeUncertainty)
    together = (("x", "y"),)
    first = FIRST

    def learn(self, logs: Sequence[Log], rig: Rig, _grids: Path | None, _like: Any) -> SensorFit | None:
        """The constants of the sensor, from logs with sightings."""
        if self.channel not in logs[0].streams:
            return None
        seen, before = tuple(map(sightings_of, logs)), self.settings(rig)
        thinned = [one.thinned(MOST_SIGHTINGS) for one in seen]
        everything, settings = self._fitted(thinned, before)
        if any(np.any(np.isfinite(one.ranges) & np.isfinite(one.bearings)) for one in thinned):
            other = before.model_copy(update={RANGE_KIND: "distance" if before.range_kind == "depth" else "depth"})
            found, changed = self._fitted(thinned, other)
            new, old = (spread(np.concatenate([one.errors(s) for one in thinned]))[0] for s in (changed, settings))
            if new < BETTER_KIND * old:
                everything, settings = found, changed
        gain = gains(everything, folds([one.t for one in thinned], BLOCKS))
        return SensorFit(tuple(thinned), everything, gain, everything.as_dict(), (), settings, seen)

    def _fitted(self, seen: Sequence[Sightings], before: BearingRangeSettings) -> tuple[Fit, BearingRangeSettings]:
        """Fit all constants and the scatter in turn."""
        constants = constants_of(seen, before)
        start = {c.name: c.neutral for c in constants}
        settings = with_scatter(seen, before)
        for _ in range(ROUNDS):
            everything = self.fit(None, seen, settings, constants, start)
            start = everything.as_dict()
            settings = with_scatter(seen, self.changed(settings, start))
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
        settings = with_scatter(found.parts, base)
        before, notes = rig.bearing_range, []
        if before is not None and settings.range_kind != before.range_kind:
            notes.append(f"The ranges fit better as the {settings.range_kind} than as the {before.range_kind}.")
        correlations = tuple(correlation(one, settings) for one in found.seen if by_log)
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
        header = ("log", "range: next sighting", "falls to 1/e in [s]", "bearing: next sighting", "falls to 1/e in [s]")
        rows = [
            (log, number(c.next_one[0], 2), number(c.time[0], 1), number(c.next_one[1], 2), number(c.time[1], 1))
            for log, c in zip(told.logs, told.details, strict=True)
        ]
        return {
            "Noise": out,
            "Correlation of consecutive errors": [explained, (header, rows)],
            "Residuals of the sightings": [
                sightings_figure(told.found.seen, told.learnt.bearing_range),
                correlation_figure(told.found.seen, told.details),
            ],
        }


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
            known, colour = np.isfinite(one.function[:, column]), COLOURS[i % len(COLOURS)]
            label = plain(of.log.name.lstrip("_"), 40) or "log"
            axis.plot(one.lags[known], one.function[known, column], "o-", color=colour, label=label)
        axis.axhline(np.exp(-1.0), color="0.3", linestyle="--", label="1/e")
        axis.axhline(0.0, color="0.5", linewidth=0.8)
        time = "time between two sightings of a landmark [s]"
        axis.set(xscale="log", xlabel=time, ylabel=f"correlation of {what} residuals")
    legend(figure, axes.flat, markers=3.0)
    return png(figure)
