"""Calibration of a landmark sensor: constants and noise are estimated from sightings along reference trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import nnls

from factorgraph_loc.errors import InputError
from factorgraph_loc.fitting.posterior import (
    Parameter,
    Posterior,
    blocks,
    independent_share,
    least_squares,
    robust_sigma,
)
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.calibrating import ConstantsCalibrator, Residuals, SensorKnowledge
from factorgraph_loc.sensors.landmarks.measurement import (
    BearingRangeSettings,
    BearingRangeStream,
    points_of,
)
from factorgraph_loc.sensors.smoothed import REFERENCE_GAP
from factors import se2
from factors.landmarks import model as bearing_range
from factors.se2 import Array

MAX_OFFSET = 0.5  # s; largest offset between the clocks of the sensor and the reference
GROSS = 4.0  # minimum standard deviation of gross errors, as a multiple of that of normal errors
SEPARATIONS = 20  # number of iterations of expectation-maximisation
SMALLEST = 1e-3  # m, rad, m per m; minimum standard deviation
MIN_SIGHTINGS = 100
MOST_SIGHTINGS = 12000  # largest number of sightings that are used per log
# the setting ``range_kind`` (distance or depth) is changed if this reduces the range errors to less than this fraction
BETTER_KIND = 0.9
SIGMAS = ("range_sigma", "range_sigma_relative", "bearing_sigma")
WINDOW = 10.0  # s; errors of the sightings in different windows are treated as independent
FIRST = BearingRangeSettings(range_sigma=0.1)  # initial settings if the rig lacks the section


@dataclass(frozen=True)
class Sightings:
    """K sightings of mapped landmarks in one log.

    ``t`` (K,): timestamps [s] by the sensor's clock. ``points`` (K, 2): positions of the landmarks [m] in the world
    frame, or (K, 3) with heights above the sensor. ``ranges`` (K,) [m], ``bearings`` (K,) [rad]: NaN if not measured.
    ``sound`` (K, 2): for each range and each bearing, the probability that it is an inlier.
    """

    log: Log
    t: Array
    points: Array
    ranges: Array
    bearings: Array
    sound: Array

    def whitened(self, settings: BearingRangeSettings, moved: Array | float = 0.0) -> Array:
        """Return the residuals (K, 2) of ranges and bearings, predicted minus measured, in standard deviations.
        Residuals of missing values are 0. ``settings``: the sensor model. ``moved`` (3,): a body-frame perturbation
        that is applied to all reference poses."""
        assert self.log.reference is not None
        poses = self.log.reference.at(self.t + settings.time_offset)
        if np.any(moved):
            poses = se2.compose(poses, np.asarray(moved))
        return bearing_range.residuals(settings.model(), poses, self.points, self.ranges, self.bearings)

    def residuals(self, settings: BearingRangeSettings, moved: Array | float = 0.0) -> Array:
        """Return the residuals (K, 2) of :meth:`whitened`, multiplied by the square root of the inlier probabilities
        ``sound``. ``settings``: the sensor model. ``moved`` (3,): a body-frame perturbation of all reference poses."""
        return np.sqrt(self.sound) * self.whitened(settings, moved)

    def errors(self, settings: BearingRangeSettings) -> Array:
        """Return residuals (K, 2) of ranges [m] and bearings [rad], predicted minus measured, NaN if not measured."""
        out = self.whitened(settings) * bearing_range.sigmas(settings.model(), self.ranges)
        out[np.isnan(self.ranges), 0] = np.nan
        out[np.isnan(self.bearings), 1] = np.nan
        return out


def separated(errors: Array, ranges: Array) -> tuple[tuple[float, float], Array]:
    """Return the standard deviation of the inliers among ``errors`` (K,), and their probabilities (K,) of being
    inliers.

    The standard deviation is a pair (constant, relative). At range r it is sqrt(constant^2 + (relative r)^2).
    ``errors`` may include gross errors and NaN. ``ranges`` (K,): measured ranges [m].

    A mixture of two zero-mean Gaussians is fitted by expectation-maximisation (McLachlan and Peel, "Finite mixture
    models", 2000, section 3.2). It starts from the median absolute error. The wider Gaussian models the gross errors.
    """
    known = np.isfinite(errors)
    error, distance = errors[known], ranges[known]
    constant, relative = max(float(robust_sigma(error[:, None])[0]), SMALLEST), SMALLEST
    gross, wide = 0.05, GROSS**2 * np.mean(np.hypot(constant, relative * distance) ** 2) + np.mean(error**2)
    inside = np.ones(len(error))
    for _ in range(SEPARATIONS):
        variance = constant**2 + (relative * distance) ** 2
        likely = (1.0 - gross) * np.exp(-0.5 * error**2 / variance) / np.sqrt(variance)
        unlikely = gross * np.exp(-0.5 * error**2 / wide) / np.sqrt(wide)
        inside = likely / np.maximum(likely + unlikely, 1e-300)
        gross = float(np.clip(np.mean(1.0 - inside), 1e-4, 0.9))
        constant, relative = _scatter(error, distance, inside, (constant, relative))
        widest = GROSS**2 * np.mean(constant**2 + (relative * distance) ** 2)
        wide = max(float(np.sum((1.0 - inside) * error**2) / max(np.sum(1.0 - inside), 1e-9)), widest)
    out = np.ones(len(errors))
    out[known] = inside
    return (constant, relative), out


def _scatter(errors: Array, ranges: Array, weights: Array, start: tuple[float, float]) -> tuple[float, float]:
    """Return the standard deviation of ``errors`` (K,) with ``weights`` (K,) as the pair (constant, relative). At range
    r it is sqrt(constant^2 + (relative r)^2). ``ranges`` (K,): measured ranges [m].

    This is one step of Fisher scoring from ``start``, the pair of the previous step. Source: Nelder and Pregibon, "An
    extended quasi-likelihood function", Biometrika 74(2), 1987.
    """
    design = np.column_stack((np.ones(len(errors)), ranges**2))
    root = np.sqrt(weights) / (design @ np.square(start))
    constant, relative = np.sqrt(nnls(design * root[:, None], errors**2 * root)[0])
    return max(float(constant), SMALLEST), float(relative)


class LandmarkCalibrator(ConstantsCalibrator):
    """Estimates the constants and the noise of a landmark sensor."""

    section, channel = "bearing_range", "bearing_range"
    first, rounds = FIRST, 4

    def part(self, log: Log) -> Sightings:
        """Return the sightings of mapped landmarks with a reference pose. Sightings in the first and last
        ``MAX_OFFSET`` seconds of the reference are omitted. The number is reduced to about ``MOST_SIGHTINGS``. Raises
        InputError for fewer than ``MIN_SIGHTINGS``."""
        stream, reference = log.streams["bearing_range"], log.reference
        assert isinstance(stream, BearingRangeStream)
        assert reference is not None
        numbers = {name: i for i, name in enumerate(log.world.landmarks)}
        landmark = np.array([numbers.get(name, -1) for name in stream.landmark], dtype=np.int64)
        good = (landmark >= 0) & np.isfinite(reference.at(stream.t, max_gap=REFERENCE_GAP)[:, 0])
        good &= (stream.t > reference.t[0] + MAX_OFFSET) & (stream.t < reference.t[-1] - MAX_OFFSET)
        bearings = stream.bearing if reference.has_heading else np.full_like(stream.bearing, np.nan)
        good &= np.isfinite(stream.range) | np.isfinite(bearings)
        if (count := np.count_nonzero(good)) < MIN_SIGHTINGS:
            raise InputError(
                f"{log.name}: has {count} sightings of mapped landmarks within the reference, expected {MIN_SIGHTINGS} or more"
            )
        stamp = np.unique(stream.t[good], return_inverse=True)[1]
        rows = np.flatnonzero(good)[stamp % max(1, round(count / MOST_SIGHTINGS)) == 0]
        settings = log.rig.find(BearingRangeSettings) or FIRST
        points = points_of(log.world.landmarks.values(), settings.z)[landmark[rows]]
        return Sightings(log, stream.t[rows], points, stream.range[rows], bearings[rows], np.ones((len(rows), 2)))

    def parameters(self, parts: Sequence[Sightings], settings: BearingRangeSettings) -> list[Parameter]:
        """Return the constants to estimate, each with a prior around its value in ``settings``. ``parts``: the
        sightings of each log. If the reference has no headings, the position on the robot and the time offset are not
        estimated."""
        has_range = any(np.isfinite(part.ranges).any() for part in parts)
        has_bearing = any(np.isfinite(part.bearings).any() for part in parts)
        has_heading = all(part.log.reference is not None and part.log.reference.has_heading for part in parts)
        candidates = (
            (has_heading, "x", 0.2, -10.0, 10.0),
            (has_heading, "y", 0.2, -10.0, 10.0),
            (has_bearing, "bearing_bias", 0.1, -np.pi, np.pi),
            (has_range, "range_scale", 0.1, 0.2, 5.0),
            (settings.range_kind == "depth", "depth_axis", 0.1, -np.pi, np.pi),
            (has_heading, "time_offset", 0.1, -MAX_OFFSET, MAX_OFFSET),
        )
        return [Parameter(name, getattr(settings, name), *scale) for use, name, *scale in candidates if use]

    def with_noise(
        self, parts: Sequence[Sightings], settings: BearingRangeSettings
    ) -> tuple[Sequence[Sightings], BearingRangeSettings]:
        """Return ``parts``, the sightings of each log, with new inlier probabilities ``sound``, and the settings with
        new noise. The noise is estimated without gross errors."""
        errors = np.concatenate([part.errors(settings) for part in parts])
        ranges = np.nan_to_num(np.concatenate([part.ranges for part in parts]))
        sigmas, sound = dict[str, float](), np.ones(errors.shape)
        if np.isfinite(errors[:, 0]).any():
            (constant, relative), sound[:, 0] = separated(errors[:, 0], ranges)
            sigmas |= {"range_sigma": constant, "range_sigma_relative": relative if relative > 1e-3 else 0.0}
        if np.isfinite(errors[:, 1]).any():
            (sigmas["bearing_sigma"], _), sound[:, 1] = separated(errors[:, 1], 0.0 * ranges)
        ends = np.cumsum([len(part.t) for part in parts])[:-1]
        weighted = [replace(part, sound=rows) for part, rows in zip(parts, np.split(sound, ends), strict=True)]
        return weighted, settings.model_copy(update=sigmas)

    def estimated(
        self, parts: Sequence[Sightings], settings: BearingRangeSettings
    ) -> tuple[Sequence[Sightings], BearingRangeSettings, Posterior | None]:
        """Return ``parts`` and ``settings``, both updated with the best fit, and the posterior of the constants.

        ``parts``: the sightings of each log. The fit is repeated with the other ``range_kind``, distance or depth. The
        better of the two fits is returned. The posterior is None if no constants are estimated.
        """
        given = super().estimated(parts, settings)
        if not any(np.any(np.isfinite(part.ranges) & np.isfinite(part.bearings)) for part in parts):
            return given
        kind = "distance" if settings.range_kind == "depth" else "depth"
        changed = super().estimated(parts, settings.model_copy(update={"range_kind": kind}))
        new, old = (robust_sigma(np.concatenate([p.errors(fit[1]) for p in parts]))[0] for fit in (changed, given))
        return changed if new < BETTER_KIND * old else given

    def finished(self, parts: Sequence[Sightings], rig: Rig, knowledge: SensorKnowledge) -> SensorKnowledge:
        """Return ``knowledge``, the fitted constants, with enlarged noise, because the errors in a time window are
        correlated. ``parts``: the sightings of each log. ``rig``: the rig with the fitted constants. See
        :func:`pose_share`."""
        scatter: BearingRangeSettings = rig.bearing_range
        factor = pose_share(parts, scatter) ** -0.5
        wider = {name: factor * getattr(scatter, name) for name in SIGMAS}
        return replace(
            knowledge,
            sections={self.section: scatter.model_copy(update=wider)},
            figures={"noise_factor": factor},
            residuals=[_residuals(part, scatter) for part in parts],
        )


def _residuals(part: Sightings, settings: BearingRangeSettings) -> Residuals:
    """Return the errors of ranges and bearings in one log, for plots."""
    sigmas = bearing_range.sigmas(settings.model(), part.ranges)
    units = {"range": "m", "bearing": "rad"}
    return Residuals(part.log.name, units, part.t, part.ranges, part.errors(settings), sigmas)


CALIBRATOR = LandmarkCalibrator()


def pose_share(parts: Sequence[Sightings], settings: BearingRangeSettings) -> float:
    """Return the Fisher information of the sightings on the pose, divided by its value for independent errors. The
    result is at most 1. ``parts``: the sightings of each log. See :func:`independent_share`."""

    def residuals(moved: Array) -> Array:
        return np.concatenate([part.residuals(settings, moved) for part in parts])

    dimensions = [Parameter(name, 0.0, 1.0) for name in ("x", "y", "heading")]
    terms = least_squares(residuals, dimensions, blocks([part.t for part in parts], WINDOW))(np.zeros(3))
    return independent_share(terms.scores, terms.information)
