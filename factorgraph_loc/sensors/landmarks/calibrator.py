"""Calibration of constants and noise of a landmark sensor, from sightings along trajectories."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import nnls

from factorgraph_loc.drawing.figures import COLOURS, grid, legend, png
from factorgraph_loc.drawing.pages import Part, Picture
from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import bounds
from factorgraph_loc.fitting.posterior import (
    LikelihoodTerms,
    Parameter,
    Posterior,
    blocks,
    independent_share,
    least_squares,
    spread,
)
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.calibrating import ConstantsCalibrator, SensorKnowledge, upper_bounds
from factorgraph_loc.sensors.landmarks.measurement import (
    BearingRangeSettings,
    BearingRangeStream,
    BearingRangeUncertainty,
)
from factorgraph_loc.sensors.smoothed import REFERENCE_GAP
from factorgraph_loc.text import number
from factors import se2
from factors.landmarks import model as bearing_range
from factors.se2 import Array

MAX_OFFSET = 0.5  # s between the clocks of the sensor and the reference
GROSS = 4.0  # least standard deviation of gross errors, in those of the others
SEPARATIONS = 20  # steps of expectation-maximisation
SMALLEST = 1e-3  # m, rad, m per m; standard deviation


@dataclass(frozen=True)
class Sightings:
    """K sightings of landmarks of the map: timestamps ``t`` (K,) by the sensor's clock, ``points`` (K, 2), ``ranges`` and
    ``bearings`` (K,). ``sound`` (K, 2): probability of range and bearing not to be gross errors."""

    log: Log
    t: Array
    points: Array
    ranges: Array
    bearings: Array
    sound: Array

    def thinned(self, count: int) -> Sightings:
        """About ``count`` of the sightings, by keeping every n-th timestamp."""
        _, stamp = np.unique(self.t, return_inverse=True)
        rows = stamp % max(1, round(len(self.t) / count)) == 0
        columns = ("t", "points", "ranges", "bearings", "sound")
        return replace(self, **{name: getattr(self, name)[rows] for name in columns})

    def whitened(self, settings: BearingRangeSettings, moved: Array | float = 0.0) -> Array:
        """Range and bearing residuals (K, 2), predicted minus measured, in standard deviations; zero if not measured. ``moved``
        (3,): a body-frame perturbation of the poses."""
        assert self.log.reference is not None
        poses = self.log.reference.at(self.t + settings.time_offset)
        if np.any(moved):
            poses = se2.compose(poses, np.asarray(moved))
        return bearing_range.residuals(settings.model(), poses, self.points, self.ranges, self.bearings)

    def residuals(self, settings: BearingRangeSettings, moved: Array | float = 0.0) -> Array:
        """Those, weighted by the probability not to be gross."""
        return np.sqrt(self.sound) * self.whitened(settings, moved)

    def errors(self, settings: BearingRangeSettings) -> Array:
        """The residuals in m and rad, NaN if not measured."""
        out = self.whitened(settings) * bearing_range.sigmas(settings.model(), self.ranges)
        out[np.isnan(self.ranges), 0] = np.nan
        out[np.isnan(self.bearings), 1] = np.nan
        return out


def sightings_of(log: Log) -> Sightings:
    """The sightings of mapped landmarks within the reference, with a margin for clock offsets; InputError if there are too few."""
    stream = log.streams["bearing_range"]
    assert isinstance(stream, BearingRangeStream)
    assert log.reference is not None
    numbers = {name: i for i, name in enumerate(log.world.landmarks)}
    landmark = np.array([numbers.get(name, -1) for name in stream.landmark], dtype=np.int64)
    good = (landmark >= 0) & np.isfinite(log.reference.at(stream.t, max_gap=REFERENCE_GAP)[:, 0])
    good &= (stream.t > log.reference.t[0] + MAX_OFFSET) & (stream.t < log.reference.t[-1] - MAX_OFFSET)
    bearings = stream.bearing if log.reference.has_heading else np.full_like(stream.bearing, np.nan)
    good &= np.isfinite(stream.range) | np.isfinite(bearings)
    if (count := np.count_nonzero(good)) < MIN_SIGHTINGS:
        found = f"has {count} sightings of mapped landmarks within the reference"
        raise InputError(f"{log.name}: {found}, expected {MIN_SIGHTINGS} or more")
    points = log.world.positions()[landmark[good]]
    return Sightings(log, stream.t[good], points, stream.range[good], bearings[good], np.ones((count, 2)))


def parameters_of(seen: Sequence[Sightings], settings: BearingRangeSettings) -> list[Parameter]:
    """The constants, with priors about the rig's values; only the range scale without reference headings."""
    has_range = any(np.isfinite(one.ranges).any() for one in seen)
    has_bearing = any(np.isfinite(one.bearings).any() for one in seen)
    has_heading = all(one.log.reference is not None and one.log.reference.has_heading for one in seen)
    candidates = (
        (has_heading, "x", 0.2, -10.0, 10.0),
        (has_heading, "y", 0.2, -10.0, 10.0),
        (has_bearing, "bearing_bias", 0.1, -np.pi, np.pi),
        (has_range, "range_scale", 0.1, 0.2, 5.0),
        (settings.range_kind == "depth", "depth_axis", 0.1, -np.pi, np.pi),
        (has_heading, "time_offset", 0.1, -MAX_OFFSET, MAX_OFFSET),
    )
    return [Parameter(name, getattr(settings, name), *scale) for use, name, *scale in candidates if use]


def with_scatter(
    seen: Sequence[Sightings], settings: BearingRangeSettings
) -> tuple[list[Sightings], BearingRangeSettings]:
    """The sightings with their probabilities not to be gross, and the settings with the scatter of the others as noise."""
    errors = np.concatenate([one.errors(settings) for one in seen])
    ranges = np.nan_to_num(np.concatenate([one.ranges for one in seen]))
    found, sound = dict[str, float](), np.ones(errors.shape)
    if np.isfinite(errors[:, 0]).any():
        (constant, relative), sound[:, 0] = separated(errors[:, 0], ranges)
        found |= {"range_sigma": constant, "range_sigma_relative": relative if relative > 1e-3 else 0.0}
    if np.isfinite(errors[:, 1]).any():
        (sigma, _), sound[:, 1] = separated(errors[:, 1], 0.0 * ranges)
        found["bearing_sigma"] = sigma
    ends = np.cumsum([len(one.t) for one in seen])[:-1]
    parts = [replace(one, sound=rows) for one, rows in zip(seen, np.split(sound, ends), strict=True)]
    return parts, settings.model_copy(update=_bounded(found))


def _bounded(values: Mapping[str, float]) -> dict[str, float]:
    """Standard deviations within the bounds of the settings."""
    kind = BearingRangeSettings.model_fields
    return {name: float(np.clip(value, *bounds(kind[name].metadata))) for name, value in values.items()}


def separated(errors: Array, ranges: Array) -> tuple[tuple[float, float], Array]:
    """Standard deviation of errors (K,), constant and relative to ``ranges`` (K,), and the probability (K,) of each not to be
    gross; NaN is not measured.

    A mixture of two Gaussians about zero, by expectation-maximisation from the median absolute error (McLachlan and Peel,
    "Finite mixture models", 2000, section 3.2). The wider one has the gross errors.
    """
    known = np.isfinite(errors)
    error, near = errors[known], ranges[known]
    constant, relative = max(float(spread(error[:, None])[0]), SMALLEST), SMALLEST
    gross, wide = 0.05, GROSS**2 * np.mean(np.hypot(constant, relative * near) ** 2) + np.mean(error**2)
    inside = np.ones(len(error))
    for _ in range(SEPARATIONS):
        variance = constant**2 + (relative * near) ** 2
        likely = (1.0 - gross) * np.exp(-0.5 * error**2 / variance) / np.sqrt(variance)
        unlikely = gross * np.exp(-0.5 * error**2 / wide) / np.sqrt(wide)
        inside = likely / np.maximum(likely + unlikely, 1e-300)
        gross = float(np.clip(np.mean(1.0 - inside), 1e-4, 0.9))
        constant, relative = _scatter(error, near, inside, (constant, relative))
        widest = GROSS**2 * np.mean(constant**2 + (relative * near) ** 2)
        wide = max(float(np.sum((1.0 - inside) * error**2) / max(np.sum(1.0 - inside), 1e-9)), widest)
    out = np.ones(len(errors))
    out[known] = inside
    return (constant, relative), out


def _scatter(errors: Array, ranges: Array, weights: Array, start: tuple[float, float]) -> tuple[float, float]:
    """Standard deviation of weighted errors: constant and relative part, by scoring (Nelder and Pregibon, "An extended
    quasi-likelihood function", Biometrika 74(2), 1987)."""
    design = np.column_stack((np.ones(len(errors)), ranges**2))
    variances = np.array((start[0] ** 2, start[1] ** 2))
    for _ in range(3):
        weight = weights / (design @ variances) ** 2
        variances = nnls((design * np.sqrt(weight)[:, None]), errors**2 * np.sqrt(weight))[0]
        variances[0] = max(variances[0], SMALLEST**2)
    return float(np.sqrt(variances[0])), float(np.sqrt(variances[1]))


MIN_SIGHTINGS = 100
MOST_SIGHTINGS = 12000  # per log
BETTER_KIND = 0.9  # share of the spread below which ranges are of the other kind, distance or depth
SIGMAS = {"range_sigma": "m", "range_sigma_relative": "m per m", "bearing_sigma": "rad"}
WINDOW = 10.0  # s; errors of the sightings in different windows are independent
FIRST = BearingRangeSettings(range_sigma=0.1)  # settings of an unknown sensor
_SHOWN = 3000  # dots per log and panel
_VIEW = 5.0  # robust standard deviations; larger residuals are drawn at the edge


@dataclass(frozen=True)
class SensorFit:
    """The sightings ``seen``, the settings with their ``scatter`` as noise, and the ``share`` of independent ones."""

    seen: Sequence[Sightings]
    scatter: BearingRangeSettings
    share: float


class LandmarkCalibrator(ConstantsCalibrator):
    """The calibrator of a landmark sensor."""

    section, channel = "bearing_range", "bearing_range"
    uncertain, rounds = upper_bounds(BearingRangeUncertainty), 4
    first = FIRST

    def part(self, log: Log) -> Sightings:
        """The sightings of mapped landmarks; InputError if there are too few."""
        return sightings_of(log).thinned(MOST_SIGHTINGS)

    def parameters(self, parts: Sequence[Sightings], settings: BearingRangeSettings) -> list[Parameter]:
        """The constants of the sensor."""
        return parameters_of(parts, settings)

    def with_noise(
        self, parts: Sequence[Sightings], settings: BearingRangeSettings
    ) -> tuple[Sequence[Sightings], BearingRangeSettings]:
        """The settings with the scatter of the sightings."""
        return with_scatter(parts, settings)

    def estimated(
        self, parts: Sequence[Sightings], settings: BearingRangeSettings
    ) -> tuple[Sequence[Sightings], BearingRangeSettings, Posterior | None]:
        """Those for the kind of ranges, distance or depth, that has the smaller scatter."""
        found = super().estimated(parts, settings)
        if not any(np.any(np.isfinite(one.ranges) & np.isfinite(one.bearings)) for one in parts):
            return found
        kind = "distance" if settings.range_kind == "depth" else "depth"
        other = super().estimated(parts, settings.model_copy(update={"range_kind": kind}))
        new, old = (spread(np.concatenate([p.errors(one[1]) for p in parts]))[0] for one in (other, found))
        return other if new < BETTER_KIND * old else found

    def finished(
        self, _logs: Sequence[Log], parts: Sequence[Sightings], rig: Rig, learnt: SensorKnowledge
    ) -> SensorKnowledge:
        """The result with the scatter widened for errors that are correlated."""
        scatter = rig.bearing_range
        share = pose_share(parts, scatter)
        wider = _bounded({name: share**-0.5 * getattr(scatter, name) for name in SIGMAS})
        return replace(
            learnt,
            sections={self.section: scatter.model_copy(update=wider)},
            details=SensorFit(parts, scatter, share),
        )

    def document(self, found: SensorKnowledge, _rig: Rig) -> dict[str, Any]:
        """The factor on the noise."""
        return {"noise_factor": None if found.details is None else found.details.share**-0.5}

    def report(self, found: SensorKnowledge, rig: Rig) -> dict[str, Sequence[Part]]:
        """The scatter and the noise in the rig, and the residuals of the sightings."""
        if found.details is None:
            return {}
        fit: SensorFit = found.details
        rows: list[tuple[str, ...]] = [
            (f"{n} [{unit}]", number(getattr(fit.scatter, n)), number(getattr(rig.bearing_range, n)))
            for n, unit in SIGMAS.items()
        ]
        text = (
            f"Errors of sightings are correlated: {1.0 / fit.share:.1f} sightings contain as much information on the pose as an "
            "independent one. Estimators assume independence, so that the noise in the rig is larger than the scatter."
        )
        return {
            "Noise": [(("noise of the sightings", "scatter", "in the rig"), rows), text],
            "Residuals of the sightings": [sightings_figure(fit.seen, fit.scatter)],
        }


CALIBRATOR = LandmarkCalibrator()


def pose_share(seen: Sequence[Sightings], settings: BearingRangeSettings) -> float:
    """The share of independent information on the pose in the sightings: see :func:`independent_share`."""

    def scored(one: Sightings) -> LikelihoodTerms:
        dimensions = [Parameter(name, 0.0, 1.0) for name in ("x", "y", "heading")]
        evidence = least_squares(lambda moved: one.residuals(settings, moved), dimensions, blocks([one.t], WINDOW))
        return evidence(np.zeros(3))

    found = [scored(one) for one in seen]
    return independent_share(
        np.concatenate([one.scores for one in found]), np.sum([one.information for one in found], axis=0)
    )


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
