"""Calibration of constants and noise of a landmark sensor, from sightings at reference poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from factorgraph_loc.fitting.robust import Constant, Integers, spread
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.calibrating import REFERENCE_GAP
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeStream
from factorgraph_loc.sensors.landmarks.settings import BearingRangeSettings
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
        half = len(self.t) // 2
        early = np.arange(len(self.t)) < half
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
    """The sightings of mapped landmarks within the reference, with a margin for clock offsets."""
    stream = log.streams["bearing_range"]
    assert isinstance(stream, BearingRangeStream)
    assert log.reference is not None
    numbers = {name: i for i, name in enumerate(log.world.landmarks)}
    track = np.array([numbers.get(name, -1) for name in stream.landmark], dtype=np.int64)
    good = (track >= 0) & np.isfinite(log.reference.at(stream.t, max_gap=REFERENCE_GAP)[:, 0])
    good &= (stream.t > log.reference.t[0] + MAX_OFFSET) & (stream.t < log.reference.t[-1] - MAX_OFFSET)
    bearings = stream.bearing if log.reference.has_heading else np.full_like(stream.bearing, np.nan)
    good &= np.isfinite(stream.range) | np.isfinite(bearings)
    points = log.world.positions()[track[good]]
    return Sightings(log, stream.t[good], points, stream.range[good], bearings[good], track[good])


def constants_of(seen: Sequence[Sightings], settings: BearingRangeSettings) -> tuple[Constant, ...]:
    """The constants that may be fitted, with the rig's values as neutral ones; only the range scale without reference headings."""
    has_range = any(np.isfinite(one.ranges).any() for one in seen)
    has_bearing = any(np.isfinite(one.bearings).any() for one in seen)
    has_heading = all(one.log.reference is not None and one.log.reference.has_heading for one in seen)
    found = []
    if has_heading:
        found += [Constant("x", settings.x, 0.05, -10.0, 10.0), Constant("y", settings.y, 0.05, -10.0, 10.0)]
    if has_bearing:
        found += [Constant("bearing_bias", settings.bearing_bias, 0.02, -np.pi, np.pi)]
    if has_range:
        found += [Constant("range_scale", settings.range_scale, 0.02, 0.2, 5.0)]
    if settings.range_kind == "depth":
        found += [Constant("depth_axis", settings.depth_axis, 0.02, -np.pi, np.pi)]
    if has_heading:
        found += [Constant("time_offset", settings.time_offset, 0.05, -MAX_OFFSET, MAX_OFFSET)]
    return tuple(found)


def could_be_depths(seen: Sequence[Sightings]) -> bool:
    """Whether distances and depths can be distinguished, which requires bearings and ranges."""
    return any(np.any(np.isfinite(one.ranges) & np.isfinite(one.bearings)) for one in seen)


def range_spread(seen: Sequence[Sightings], settings: BearingRangeSettings) -> float:
    """Robust standard deviation of the range residuals [m]."""
    return float(spread(np.concatenate([one.errors(settings) for one in seen]))[0])


def with_scatter(seen: Sequence[Sightings], settings: BearingRangeSettings) -> BearingRangeSettings:
    """The settings with noise set to the maximum-likelihood scatter of the inliers.

    The variance of a range is that of a constant error plus that of an error proportional to the range.
    """
    errors = np.concatenate([one.errors(settings) for one in seen])
    ranges = np.concatenate([one.ranges for one in seen])
    found: dict[str, float] = {}
    measured = np.isfinite(errors[:, 0])
    if measured.any():
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
        rows = np.flatnonzero(seen.track == track)
        t, values = seen.t[rows], whitened[rows]
        for step in range(1, min(NEIGHBOURS, len(rows))):
            product = values[step:] * values[:-step]
            bins = np.searchsorted(LAGS, t[step:] - t[:-step]) - 1
            good = np.isfinite(product) & ((bins >= 0) & (bins < count))[:, None]
            for column in range(2):
                use = good[:, column]
                np.add.at(products[:, column], bins[use], product[use, column])
                np.add.at(pairs[:, column], bins[use], 1.0)
            if step == 1:
                neighbour += np.nansum(product, axis=0)
                neighbours += np.isfinite(product).sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        variance = np.nansum(whitened**2, axis=0) / np.isfinite(whitened).sum(axis=0)
        function = np.where(pairs >= MIN_PAIRS, products / pairs, np.nan) / variance
        next_one = np.where(neighbours >= MIN_PAIRS, neighbour / neighbours, np.nan) / variance
    lags = 0.5 * (LAGS[1:] + LAGS[:-1])
    return Correlation(next_one, np.array([_falls(lags, function[:, i]) for i in range(2)]), lags, function)


def _falls(lags: Array, function: Array) -> float:
    """The lag at which the correlation falls below 1/e, or the last lag."""
    known = np.flatnonzero(np.isfinite(function))
    if not len(known):
        return float("nan")
    below = known[function[known] < np.exp(-1.0)]
    if not len(below):
        return float(lags[known[-1]])
    before = known[known < below[0]]
    if not len(before):
        return float(lags[below[0]])
    i, j = int(before[-1]), int(below[0])
    share = (function[i] - np.exp(-1.0)) / (function[i] - function[j])
    return float(lags[i] + share * (lags[j] - lags[i]))


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
