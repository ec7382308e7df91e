"""Calibration of wheel odometry: constants and noise are estimated from the motion of a reference in time windows.

The noise grows with distance, rotation and time (:class:`factors.odometry.model.Growth`). The covariance of a relative
motion is linear in the variances per metre, radian and second. These variances are estimated as non-negative variance
components (Searle, Casella, McCulloch, "Variance Components", 1992, chapter 6). Windows of several lengths separate
errors of the odometry, which grow with time, from errors of the reference, which do not grow.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from factorgraph_loc.errors import InputError
from factorgraph_loc.fitting.posterior import Parameter, robust_sigma
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.calibrating import ConstantsCalibrator, Residuals, SensorKnowledge
from factorgraph_loc.sensors.motion import integrated, odometry_model, odometry_of, overlap
from factorgraph_loc.sensors.odometry.measurement import VelocityStream
from factorgraph_loc.sensors.odometry.settings import (
    GrowthSettings,
    OdometryNoise,
    OdometrySettings,
)
from factorgraph_loc.sensors.smoothed import REFERENCE_GAP, Traced
from factorgraph_loc.text import Notice, notice
from factors import chi_squared, se2
from factors.odometry.model import (
    MINIMUM_HEADING_VARIANCE,
    MINIMUM_POSITION_VARIANCE,
    Growth,
    OdometryModel,
)
from factors.se2 import Array

LEAD = 1.0  # s; odometry must be complete for this time before a window, because the wheels respond with a lag
WINDOW = 2.0  # s; length of the windows for the estimation of constants
# m, m, rad; assumed errors of the reference over a window, the minimum of ``Windows.sigmas``
REFERENCE_SIGMAS = np.array((0.005, 0.005, 0.003))
MOVING = np.array((0.05, 0.1))  # m/s, rad/s; the robot moves in a window if it is faster than one of these
MIN_WINDOWS = 15
LENGTHS = (1.0, 3.0, 10.0)  # s; lengths of the windows for the estimation of noise
BLACKOUT = 30.0  # s; length of the windows that determine the overall size of the noise
MIN_BLACKOUTS = 10
MOST_OUTLIERS = 0.05  # fraction of the windows; more outliers cause a warning
ERRORS = {"along": "m", "lateral": "m", "heading": "rad"}
FITS = 3  # number of fits of the noise; each fit omits the outliers of the previous fit
GATE = chi_squared.quantile(0.9999, 3)  # a window with a larger squared Mahalanobis distance is an outlier
_SMALLEST = 1e-8  # smaller variances per metre, radian or second are set to zero
# minimum noise of wheels; rows: along, lateral, heading; columns: per root of distance, rotation, time.
# Fits are lower if the reference was computed with the odometry.
FLOOR = np.array(((0.01, 0.0, 0.0), (0.005, 0.0, 0.0), (0.003, 0.005, 0.0)))


@dataclass(frozen=True)
class Windows:
    """M time windows of a log, for comparison of odometry and reference. ``begin``, ``end`` (M,): their first and last
    time [s]. ``motion`` (M, 3): the motion of the reference in each window, in the robot frame at ``begin``. ``sigmas``
    (M, 3): standard deviations of the errors of the odometry [m, m, rad]."""

    log: Log
    begin: Array
    end: Array
    motion: Array
    sigmas: Array = field(default_factory=lambda: np.ones(3))

    @property
    def t(self) -> Array:
        return self.begin

    def states(self, model: OdometryModel) -> tuple[Array, Array]:
        """Return the odometry states (M, 8) at the start and (M, 8) at the end of each window. The columns are the
        fields of :class:`factors.motion.ChainState`: time, x, y, heading, path, turn, unknown and still."""
        chain = integrated(self.log, model)
        return chain.states(self.begin), chain.states(self.end)

    def errors(self, model: OdometryModel) -> Array:
        """Return the errors (M, 3) of the odometry in each window [m, m, rad]. An error is the body-frame perturbation
        that moves the final pose by odometry to the final pose of the reference."""
        start, end = self.states(model)
        odometry = se2.between(start[:, 1:4], end[:, 1:4])
        return se2.log(se2.between(odometry, self.motion))

    def residuals(self, settings: OdometrySettings) -> Array:
        """Return :meth:`errors` (M, 3), divided by ``sigmas``. ``settings``: the settings of the odometry."""
        return self.errors(self.model(settings)) / self.sigmas

    def model(self, settings: OdometrySettings) -> OdometryModel:
        """Return the odometry model of the log's rig with other ``settings`` of the odometry."""
        return odometry_model(self.log.rig.model_copy(update={"odometry": settings}))

    def covariances(self, model: OdometryModel) -> Array:
        """Return the covariances (M, 3, 3) that ``model`` predicts for :meth:`errors`."""
        chain, no_constants = integrated(self.log, model), np.zeros(0)
        return chain.relatives(chain.states(self.begin), chain.states(self.end), no_constants)[1]


def cut(log: Log, length: float) -> Windows:
    """Return the consecutive windows of ``length`` [s] of a log. Windows with a gap of the odometry are omitted, and
    windows without a reference pose at the start or the end."""
    assert log.reference is not None
    first, last = overlap(log)
    edges = np.arange(first + LEAD, last, length)
    begin, end = edges[:-1], edges[1:]
    poses = log.reference.at(edges, max_gap=REFERENCE_GAP)
    motion = se2.between(poses[:-1], poses[1:])
    chain = integrated(log, odometry_model(log.rig))
    gap = chain.states(end)[:, 6] - chain.states(begin - LEAD)[:, 6]
    good = np.isfinite(motion[:, 0]) & (gap < 1e-6)
    return Windows(log, begin[good], end[good], motion[good])


@dataclass(frozen=True)
class NoiseFit:
    """The estimated noise of the odometry.

    ``growth``: the noise of each error, by name ("along", "lateral", "heading"). ``outliers``: the fraction of windows
    that are outliers. ``widened``: a factor, already included in ``growth``, that explains larger errors in long
    windows. ``floored``: names of the errors with noise that was raised to its lower bound.
    """

    growth: Mapping[str, Growth]
    outliers: float
    widened: float
    floored: tuple[str, ...]


def with_noise(model: OdometryModel, sigmas: Array) -> OdometryModel:
    """Return a copy of ``model`` with other noise. ``sigmas`` (3, 3): standard deviations of the longitudinal, lateral
    and heading errors (rows) per square root of distance, rotation and time (columns)."""
    along, lateral, heading = (Growth(*row) for row in sigmas.tolist())
    return replace(model, along=along, lateral=lateral, heading=heading)


def fit_noise(logs: Sequence[Log], model: OdometryModel) -> NoiseFit:
    """Return the noise of the odometry, fitted to its errors in windows of several lengths in ``logs``, without
    outliers.

    ``model``: the constants of the odometry. Its noise is not used. The fitted noise is enlarged if errors in windows
    of :data:`BLACKOUT` seconds are larger than it predicts.
    """
    windows = [cut(log, length) for log in logs for length in LENGTHS]
    bases = np.concatenate([_unit_covariances(part, model) for part in windows])
    residuals = np.concatenate([part.errors(model) for part in windows])
    lengths = np.concatenate([part.end - part.begin for part in windows])
    weights = lengths / lengths.mean()
    size = np.median(np.abs(residuals), axis=0) ** 2 / np.median(lengths)
    variances = np.concatenate([np.repeat(size, 3), (1e-6, 1e-6)])
    for _ in range(FITS):
        inside = _squared(bases, residuals, variances)[0] < GATE
        variances = _maximise(bases[inside], residuals[inside], weights[inside], variances)
    outliers = float(np.mean(_squared(bases, residuals, variances)[0] >= GATE))
    sigmas = np.sqrt(np.where(variances[:9] > _SMALLEST, variances[:9], 0.0)).reshape(3, 3)
    floored = tuple(error for error, row, floor in zip(ERRORS, sigmas, FLOOR, strict=True) if np.all(row <= floor))
    sigmas = np.maximum(sigmas, FLOOR)
    widened = _noise_factor(logs, with_noise(model, sigmas))
    growth = {error: Growth(*row) for error, row in zip(ERRORS, (widened * sigmas).tolist(), strict=True)}
    return NoiseFit(growth, outliers, widened, floored)


def _noise_factor(logs: Sequence[Log], model: OdometryModel) -> float:
    """Return the ratio of observed to predicted errors in windows of :data:`BLACKOUT` seconds. Returns 1 if the ratio
    is below 1, or if there are too few windows."""
    windows = [cut(log, BLACKOUT) for log in logs]
    residuals = np.concatenate([part.errors(model) for part in windows])
    if len(residuals) < MIN_BLACKOUTS:
        return 1.0
    covariances = np.concatenate([part.covariances(model) for part in windows])
    squared = np.einsum("mi,mi->m", residuals, np.linalg.solve(covariances, residuals[..., None])[..., 0])
    return max(1.0, float(np.sqrt(np.median(squared) / chi_squared.quantile(0.5, 3))))


def _unit_covariances(windows: Windows, model: OdometryModel) -> Array:
    """Return the covariances (M, 11, 3, 3) of the errors in each window if one of 11 variances is 1 and all others 0.
    The first nine are the variances of longitudinal, lateral and heading errors, each per distance, rotation and time.
    The last two are the variances of position and heading of the reference."""
    start, end = windows.states(model)
    drivers = np.abs(end - start)[:, [4, 5, 0]]  # distance, rotation, time in motion
    drivers[:, 2] -= end[:, 7] - start[:, 7]
    moved = drivers[:, 2] > 0.0
    floor = np.diag((MINIMUM_POSITION_VARIANCE, MINIMUM_POSITION_VARIANCE, MINIMUM_HEADING_VARIANCE))
    known = replace(model, unknown_distance=0.0, unknown_rotation=0.0)
    out = np.zeros((len(start), 11, 3, 3))
    for i in range(3):
        by_time = np.zeros((3, 3))
        by_time[i, 2] = 1.0
        unit = windows.covariances(with_noise(known, by_time)) - floor
        unit[moved] /= drivers[moved, 2, None, None]
        unit[~moved] = 0.0
        out[:, 3 * i : 3 * i + 3] = drivers[:, :, None, None] * unit[:, None]
    out[:, 9] = 2.0 * np.diag((1.0, 1.0, 0.0))
    out[:, 10] = 2.0 * np.diag((0.0, 0.0, 1.0))
    return out


def _squared(bases: Array, residuals: Array, variances: Array) -> tuple[Array, Array]:
    """Return squared Mahalanobis distances (M,) of ``residuals`` (M, 3), and log-determinants (M,) of their
    covariances. A covariance is the sum of ``variances`` (11,) times ``bases`` (M, 11, 3, 3), see
    :func:`_unit_covariances`."""
    floor = np.diag((MINIMUM_POSITION_VARIANCE, MINIMUM_POSITION_VARIANCE, MINIMUM_HEADING_VARIANCE))
    covariance = np.tensordot(bases, variances, (1, 0)) + floor
    solved = np.linalg.solve(covariance, residuals[..., None])[..., 0]
    return np.sum(residuals * solved, axis=1), np.linalg.slogdet(covariance)[1]


def _maximise(bases: Array, residuals: Array, weights: Array, start: Array) -> Array:
    """Return the variances (11,) that maximise the Gaussian likelihood of ``residuals`` (M, 3) with ``weights`` (M,).
    ``start`` (11,): initial values. ``bases``: the result of :func:`_unit_covariances`."""

    def cost(logarithms: Array) -> float:
        squared, log_determinant = _squared(bases, residuals, np.exp(logarithms))
        return float(weights @ (squared + log_determinant) / len(weights))

    bounds = [(np.log(1e-14), np.log(25.0))] * len(start)
    result = minimize(cost, np.log(np.maximum(start, 1e-10)), method="L-BFGS-B", bounds=bounds)
    return np.asarray(np.exp(result.x))


class OdometryCalibrator(ConstantsCalibrator):
    """Estimates the constants and the noise of wheel odometry."""

    section, channel, senses = "odometry", "odometry", False

    def learn(
        self, traced: Sequence[Traced], rig: Rig, first: Rig, grids: Path | None, like: SensorKnowledge | None = None
    ) -> SensorKnowledge:
        """Return constants and noise of the odometry, estimated from the logs ``traced``. The result is an empty
        :class:`SensorKnowledge` if the reference has no headings. For other arguments see :meth:`Calibrator.learn`."""
        reference = traced[0].log.reference
        has_heading = reference is not None and reference.has_heading
        return super().learn(traced, rig, first, grids, like) if has_heading else SensorKnowledge()

    def part(self, log: Log) -> Windows:
        """Return the windows of a log, each WINDOW [s] long. Raises InputError if the log has fewer than
        MIN_WINDOWS."""
        windows = cut(log, WINDOW)
        if len(windows.begin) < MIN_WINDOWS:
            raise InputError(
                f"{log.name}: odometry and reference overlap in {len(windows.begin)} windows of {WINDOW:g} s, expected "
                f"{MIN_WINDOWS} or more"
            )
        return windows

    def parameters(self, parts: Sequence[Windows], settings: OdometrySettings) -> list[Parameter]:
        """Return the constants to estimate, with priors around their values in ``settings``. For logs with commanded
        velocities, they include delay, lag and slowdown, and the priors of the biases are wider. ``parts``: the windows
        of each log."""
        commanded = isinstance(odometry_of(parts[0].log), VelocityStream)
        by_speed, by_turn = (0.005, 0.002) if commanded else (0.0005, 0.0005)  # m/s, rad/s; prior sigmas
        priors = {
            "scale_distance": (0.05, 0.2, 5.0),
            "scale_rotation": (0.05, 0.2, 5.0),
            "speed_bias": (by_speed, -1.0, 1.0),
            "heading_rate_bias": (by_turn, -1.0, 1.0),
            "heading_drift": (0.03, -1.0, 1.0),
            "direction": (0.1, -np.pi, np.pi),
        }
        if commanded:
            priors |= {"delay": (0.1, 0.0, 2.0), "lag": (0.1, 0.0, 5.0), "turn_slowdown": (0.05, 0.0, 5.0)}
        return [Parameter(name, getattr(settings, name), *prior) for name, prior in priors.items()]

    def with_noise(
        self, parts: Sequence[Windows], settings: OdometrySettings
    ) -> tuple[Sequence[Windows], OdometrySettings]:
        """Return ``parts``, the windows of each log, with new ``sigmas``, and the unchanged ``settings``. The standard
        deviations are robust estimates from the errors, one for all windows in motion and one for all windows at
        rest."""
        errors, moves = [], []
        for part in parts:
            start, end = part.states(part.model(settings))
            moves.append(np.any((end - start)[:, 4:6] > MOVING * (end - start)[:, :1], axis=1))
            errors.append(part.errors(part.model(settings)))
        every, moving = np.concatenate(errors), np.concatenate(moves)
        scatter = [robust_sigma(every[rows]) if rows.any() else np.zeros(3) for rows in (~moving, moving)]
        sigmas = np.maximum(scatter, REFERENCE_SIGMAS)
        weighted = [replace(part, sigmas=sigmas[rows.astype(int)]) for part, rows in zip(parts, moves, strict=True)]
        return weighted, settings

    def finished(self, parts: Sequence[Windows], rig: Rig, knowledge: SensorKnowledge) -> SensorKnowledge:
        """Return ``knowledge``, the fitted constants, with the noise of the calibrated odometry, warnings and
        residuals. ``parts``: the windows of each log. ``rig``: the rig with the fitted constants."""
        noise = fit_noise([part.log for part in parts], odometry_model(rig))
        growth = {error: GrowthSettings.bounded(**asdict(g)) for error, g in noise.growth.items()}
        settings = rig.odometry.model_copy(update={"noise": OdometryNoise(**growth)})
        model = odometry_model(rig.model_copy(update={self.section: settings}))
        return replace(
            knowledge,
            sections={self.section: settings},
            notes=_warnings(noise),
            figures={
                "outliers": noise.outliers,
                "noise_factor": noise.widened,
                **_wheels(settings),
                "noise": [{"error": error} | asdict(g) for error, g in noise.growth.items()],
            },
            residuals=[_residuals(part, model) for part in parts],
        )


def _residuals(windows: Windows, model: OdometryModel) -> Residuals:
    """Return the errors of the odometry in each window, for plots. ``model``: the odometry model with fitted
    constants."""
    start, end = windows.states(model)
    sigmas = np.sqrt(np.diagonal(windows.covariances(model), axis1=1, axis2=2))
    return Residuals(windows.log.name, ERRORS, windows.t, end[:, 4] - start[:, 4], windows.errors(model), sigmas)


def _warnings(noise: NoiseFit) -> list[Notice]:
    """Return warnings about outliers and implausibly low noise."""
    notes = []
    if noise.outliers > MOST_OUTLIERS:
        sentence = "{percent:.0f} % of the odometry windows are outliers: check for slip, collisions, and gaps in the reference."
        notes.append(notice("outliers", sentence, 100.0 * noise.outliers))
    if noise.floored:
        sentence = (
            "The fitted noise of the odometry ({errors}) is lower than wheels can achieve and was raised: "
            "the reference is probably not independent of the odometry."
        )
        notes.append(notice("low_noise", sentence, ", ".join(noise.floored)))
    return notes


def _wheels(settings: OdometrySettings) -> dict[str, float]:
    """Return the calibrated radius and track width [m] of the wheels, or {} if the rig has no wheels."""
    if (drive := settings.wheels) is None:
        return {}
    radius, track = drive.corrected(settings.scale_distance, settings.scale_rotation)
    return ({} if radius is None else {"radius": radius}) | {"track": track}


CALIBRATOR = OdometryCalibrator()
