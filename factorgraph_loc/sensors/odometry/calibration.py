"""Fits of wheel odometry to the relative motion of a reference over segments of a log: its constants, and the growth of its errors.

The covariance of relative motion is linear in the variances of :class:`factors.odometry.model.Growth`, so the noise is a sum of
non-negative variance components (Searle, Casella, McCulloch, "Variance Components", 1992, chapter 6). Windows of several
lengths separate growing errors from the constant ones of the reference.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import minimize

from factorgraph_loc.fitting.posterior import Parameter, spread
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.motion import odometry_model
from factorgraph_loc.sensors.odometry.measurement import IncrementStream, VelocityStream
from factorgraph_loc.sensors.odometry.settings import OdometrySettings
from factorgraph_loc.sensors.smoothed import REFERENCE_GAP
from factors import chi_squared, se2
from factors.motion import ChainState
from factors.odometry.chain import OdometryChain
from factors.odometry.model import (
    MINIMUM_HEADING_VARIANCE,
    MINIMUM_POSITION_VARIANCE,
    Growth,
    OdometryModel,
    relative_motion,
)
from factors.se2 import Array

BEFORE = 1.0  # s before a window in which the odometry must be complete too, because of its lag
WINDOW = 2.0  # s; length of a window that constants are estimated from
# error of the reference over a window: m, m, rad; lower bound of the residuals' standard deviations
REFERENCE_SIGMAS = np.array((0.005, 0.005, 0.003))
MOVING = np.array((0.05, 0.1))  # m/s, rad/s above which the robot moves in a window


@dataclass(frozen=True)
class Windows:
    """M segments of a log: ``begin`` and ``end`` (M,) [s], and ``motion`` (M, 3) of the reference over them. ``sigmas`` (M, 3) of
    the residuals."""

    log: Log
    begin: Array
    end: Array
    motion: Array
    sigmas: Array = field(default_factory=lambda: np.ones(3))

    @property
    def t(self) -> Array:
        return self.begin

    def states(self, model: OdometryModel) -> tuple[Array, Array]:
        """States of the odometry (M, 8) at both ends."""
        chain = integrated(self.log, model)
        return chain.states(self.begin), chain.states(self.end)

    def errors(self, model: OdometryModel) -> Array:
        """Motion of the reference relative to the odometry (M, 3): a body-frame perturbation at the end, [m, m, rad]."""
        start, end = self.states(model)
        odometry = se2.between(start[:, 1:4], end[:, 1:4])
        return se2.log(se2.between(odometry, self.motion))

    def residuals(self, settings: OdometrySettings) -> Array:
        """The errors (M, 3) in standard deviations."""
        return self.errors(self.model(settings)) / self.sigmas

    def model(self, settings: OdometrySettings) -> OdometryModel:
        """The model with these settings."""
        return odometry_model(self.log.rig.model_copy(update={"odometry": settings}))

    def covariances(self, model: OdometryModel) -> Array:
        """The model's covariances (M, 3, 3) of the residuals."""
        start, end = self.states(model)
        pairs = zip(start.tolist(), end.tolist(), strict=True)
        found = [relative_motion(model, ChainState(*a), ChainState(*b)).covariance for a, b in pairs]
        return np.array(found).reshape(-1, 3, 3)


def cut(log: Log, length: float) -> Windows:
    """Consecutive windows of ``length`` seconds with reference poses at both ends and without odometry gaps."""
    assert log.reference is not None
    first = max(float(log.reference.t[0]), float(odometry_of(log).t[0]) + log.rig.time_offset("odometry"))
    last = min(float(log.reference.t[-1]), float(odometry_of(log).t[-1]) + log.rig.time_offset("odometry"))
    edges = np.arange(first + BEFORE, last, length)
    begin, end = edges[:-1], edges[1:]
    poses = log.reference.at(edges, max_gap=REFERENCE_GAP)
    motion = se2.between(poses[:-1], poses[1:])
    chain = integrated(log, odometry_model(log.rig))
    gap = chain.states(end)[:, 6] - chain.states(begin - BEFORE)[:, 6]
    good = np.isfinite(motion[:, 0]) & (gap < 1e-6)
    return Windows(log, begin[good], end[good], motion[good])


def odometry_of(log: Log) -> VelocityStream | IncrementStream:
    """The odometry stream."""
    stream = log.streams["odometry"]
    assert isinstance(stream, VelocityStream | IncrementStream)
    return stream


def integrated(log: Log, model: OdometryModel) -> OdometryChain:
    """The integrated odometry of a log."""
    chain = OdometryChain(model, horizon=np.inf)
    stream = odometry_of(log)
    t = stream.t + log.rig.time_offset("odometry")
    if isinstance(stream, VelocityStream):
        chain.add_velocities(t, stream.v, stream.w)
    else:
        chain.add_increments(t, stream.dx, stream.dy, stream.dtheta)
    return chain


def with_scatter(windows: Sequence[Windows], settings: OdometrySettings) -> list[Windows]:
    """The windows with robust standard deviations of their errors, apart for motion and rest. Weights are equal in motion: those
    of the noise model would favour windows with little motion."""
    errors, moves = [], []
    for one in windows:
        start, end = one.states(one.model(settings))
        moves.append(np.any((end - start)[:, 4:6] > MOVING * (end - start)[:, :1], axis=1))
        errors.append(one.errors(one.model(settings)))
    every, moving = np.concatenate(errors), np.concatenate(moves)
    sigmas = [spread(every[mine]) if mine.any() else np.zeros(3) for mine in (~moving, moving)]
    known = np.maximum(sigmas, REFERENCE_SIGMAS)
    return [replace(one, sigmas=known[mine.astype(int)]) for one, mine in zip(windows, moves, strict=True)]


def parameters_of(windows: Windows, settings: OdometrySettings) -> list[Parameter]:
    """The constants, with priors about the rig's values: wheels that report turns have hardly any bias by time."""
    commanded = isinstance(odometry_of(windows.log), VelocityStream)
    by_speed, by_turn = (0.005, 0.002) if commanded else (0.0005, 0.0005)  # m/s, rad/s
    found = [
        Parameter("scale_distance", settings.scale_distance, 0.05, 0.2, 5.0),
        Parameter("scale_rotation", settings.scale_rotation, 0.05, 0.2, 5.0),
        Parameter("speed_bias", settings.speed_bias, by_speed, -1.0, 1.0),
        Parameter("heading_rate_bias", settings.heading_rate_bias, by_turn, -1.0, 1.0),
        Parameter("heading_drift", settings.heading_drift, 0.03, -1.0, 1.0),
        Parameter("direction", settings.direction, 0.1, -np.pi, np.pi),
    ]
    if commanded:
        found += [
            Parameter("delay", settings.delay, 0.1, 0.0, 2.0),
            Parameter("lag", settings.lag, 0.1, 0.0, 5.0),
            Parameter("turn_slowdown", settings.turn_slowdown, 0.05, 0.0, 5.0),
        ]
    return found


LENGTHS = (1.0, 3.0, 10.0)  # s
BLACKOUT = 30.0  # s
MIN_BLACKOUTS = 10
ERRORS = ("along", "lateral", "heading")
STUDENT = 5.0  # degrees of freedom of the robust initial fit
GATE = chi_squared.quantile(0.9999, 3)  # squared error above which a window is an outlier
_SMALLEST = 1e-8  # variance per unit below which a component is zero
# Lower bounds for wheels, by error and driver. A reference that depends on the odometry gives lower values.
FLOOR = np.array(((0.01, 0.0, 0.0), (0.005, 0.0, 0.0), (0.003, 0.005, 0.0)))


@dataclass(frozen=True)
class NoiseFit:
    """``growth`` by error; ``reference`` (2,): standard deviations of reference position [m] and heading [rad] at the ends of
    windows; ``outliers``: share of windows outside the gate; ``widened``: factor already included in the growth, because errors
    of wheels are correlated and grow faster than a random walk; ``floored``: errors raised to the lower bound."""

    growth: Mapping[str, Growth]
    reference: Array
    outliers: float
    widened: float
    floored: tuple[str, ...]


def with_noise(model: OdometryModel, growth: Mapping[str, Growth]) -> OdometryModel:
    """The model with a different noise, by error."""
    return replace(model, along=growth["along"], lateral=growth["lateral"], heading=growth["heading"])


def fit_noise(logs: Sequence[Log], model: OdometryModel) -> NoiseFit:
    """Fit the noise of the odometry ``model`` to the residuals of windows of several lengths with equal weight.

    First with a Student density, which is robust to outliers; then with a Gaussian density without outliers. Finally the noise is
    widened so that the median error over half a minute, the length of a blackout, is correct.
    """
    windows = [cut(log, length) for log in logs for length in LENGTHS]
    bases = np.concatenate([_bases(one, model) for one in windows])
    residuals = np.concatenate([one.errors(model) for one in windows])
    lengths = np.concatenate([one.end - one.begin for one in windows])
    weights = lengths / lengths.mean()
    size = np.median(np.abs(residuals), axis=0) ** 2 / np.median(lengths)
    variances = np.concatenate([np.repeat(size, 3), (1e-6, 1e-6)])
    variances = _maximise(bases, residuals, weights, variances, STUDENT)
    for _ in range(2):
        inside = _squared(bases, residuals, variances)[0] < GATE
        variances = _maximise(bases[inside], residuals[inside], weights[inside], variances, None)
    outliers = float(np.mean(_squared(bases, residuals, variances)[0] >= GATE))
    sigmas = np.sqrt(np.where(variances[:9] > _SMALLEST, variances[:9], 0.0)).reshape(3, 3)
    floored = tuple(error for error, row, floor in zip(ERRORS, sigmas, FLOOR, strict=True) if np.all(row <= floor))
    sigmas = np.maximum(sigmas, FLOOR)
    widened = _widening(logs, with_noise(model, _growth(sigmas)))
    return NoiseFit(_growth(widened * sigmas), np.sqrt(variances[9:]), outliers, widened, floored)


def _widening(logs: Sequence[Log], model: OdometryModel) -> float:
    """Factor by which the errors over a blackout exceed the model; 1 if they do not or there are too few windows."""
    windows = [cut(log, BLACKOUT) for log in logs]
    residuals = np.concatenate([one.errors(model) for one in windows])
    if len(residuals) < MIN_BLACKOUTS:
        return 1.0
    covariances = np.concatenate([one.covariances(model) for one in windows])
    squared = np.einsum("mi,mi->m", residuals, np.linalg.solve(covariances, residuals[..., None])[..., 0])
    return max(1.0, float(np.sqrt(np.median(squared) / chi_squared.quantile(0.5, 3))))


def _growth(sigmas: Array) -> dict[str, Growth]:
    """``sigmas`` (3, 3) of longitudinal, lateral and heading errors, by distance, rotation and time."""
    return {error: Growth(*row) for error, row in zip(ERRORS, sigmas.tolist(), strict=True)}


def _bases(windows: Windows, model: OdometryModel) -> Array:
    """Covariances (M, 11, 3, 3) for unit variances: three drivers of each error, then position and heading of the reference."""
    start, end = windows.states(model)
    drivers = np.abs(end - start)[:, [4, 5, 0]]  # distance, rotation, time in motion
    drivers[:, 2] -= end[:, 7] - start[:, 7]
    moved = drivers[:, 2] > 0.0
    floor = np.diag((MINIMUM_POSITION_VARIANCE, MINIMUM_POSITION_VARIANCE, MINIMUM_HEADING_VARIANCE))
    known = replace(model, unknown_distance=0.0, unknown_rotation=0.0)
    out = np.zeros((len(start), 11, 3, 3))
    for i, error in enumerate(ERRORS):
        alone = {e: Growth(per_time=1.0 if e == error else 0.0) for e in ERRORS}
        unit = windows.covariances(with_noise(known, alone)) - floor
        unit[moved] /= drivers[moved, 2, None, None]
        unit[~moved] = 0.0
        out[:, 3 * i : 3 * i + 3] = drivers[:, :, None, None] * unit[:, None]
    out[:, 9] = 2.0 * np.diag((1.0, 1.0, 0.0))
    out[:, 10] = 2.0 * np.diag((0.0, 0.0, 1.0))
    return out


def _squared(bases: Array, residuals: Array, variances: Array) -> tuple[Array, Array, Array]:
    """Squared Mahalanobis distances (M,), log-determinants (M,) and inverse covariances (M, 3, 3)."""
    floor = np.diag((MINIMUM_POSITION_VARIANCE, MINIMUM_POSITION_VARIANCE, MINIMUM_HEADING_VARIANCE))
    covariance = np.einsum("mkij,k->mij", bases, variances) + floor
    inverse = np.linalg.inv(covariance)
    squared = np.einsum("mi,mij,mj->m", residuals, inverse, residuals)
    return squared, np.linalg.slogdet(covariance)[1], inverse


def _maximise(bases: Array, residuals: Array, weights: Array, start: Array, student: float | None) -> Array:
    """Variances (11,) that maximise the likelihood; optimised as logarithms with the exact gradient."""

    def cost(logs: Array) -> tuple[float, Array]:
        variances = np.exp(logs)
        squared, log_determinant, inverse = _squared(bases, residuals, variances)
        solved = np.einsum("mij,mj->mi", inverse, residuals)
        if student is None:
            penalty, slope = 0.5 * squared, np.full(len(squared), 0.5)
        else:
            penalty = 0.5 * (student + 3.0) * np.log1p(squared / student)
            slope = 0.5 * (student + 3.0) / (student + squared)
        by_variance = 0.5 * np.einsum("mij,mkji->mk", inverse, bases)
        by_variance -= slope[:, None] * np.einsum("mi,mkij,mj->mk", solved, bases, solved)
        total = weights @ (penalty + 0.5 * log_determinant)
        return float(total / len(weights)), (weights @ by_variance) * variances / len(weights)

    bounds = [(np.log(1e-14), np.log(25.0))] * len(start)
    found = minimize(cost, np.log(np.maximum(start, 1e-10)), jac=True, method="L-BFGS-B", bounds=bounds)
    return np.asarray(np.exp(found.x))
