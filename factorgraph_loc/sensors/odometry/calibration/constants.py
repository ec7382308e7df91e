"""Segments of a log with the motion of reference and odometry, and the fit of the odometry's constants to the relative motion of
the reference over these."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from factorgraph_loc.fitting.robust import Constant, Fit, blocks, fit, loss, spread
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.motion import odometry_model
from factorgraph_loc.sensors.odometry.measurement import IncrementStream, VelocityStream
from factorgraph_loc.sensors.odometry.settings import OdometrySettings
from factors import se2
from factors.motion import ChainState
from factors.odometry.chain import OdometryChain
from factors.odometry.model import OdometryModel, relative_motion
from factors.se2 import Array

REFERENCE_GAP = 0.35  # s; longest interpolated gap between reference poses
BEFORE = 1.0  # s before a window in which the odometry must be complete too, because of its lag
WINDOW = 2.0  # s
BLOCK = 20.0  # s; errors within a block may be correlated
LAGGING_START = 0.05  # s; at a lag of zero the derivative vanishes


# error of the reference over a window: m, m, rad; lower bound of the residuals' standard deviations
REFERENCE_SIGMAS = np.array((0.005, 0.005, 0.003))
MIN_STOOD = 5  # minimum number of windows at rest
MOVING = np.array((0.05, 0.1))  # m/s, rad/s above which a window is used for the scatter


@dataclass(frozen=True)
class Windows:
    """M segments of a log: ``begin`` and ``end`` (M,) [s], and ``motion`` (M, 3) of the reference over them."""

    log: Log
    begin: Array
    end: Array
    motion: Array

    def halves(self) -> tuple[Windows, Windows]:
        """The first and the second half in time."""
        half = len(self.begin) // 2
        first, second = (
            Windows(self.log, self.begin[part], self.end[part], self.motion[part])
            for part in (slice(None, half), slice(half, None))
        )
        return first, second

    def states(self, model: OdometryModel) -> tuple[Array, Array]:
        """States of the odometry (M, 8) at both ends."""
        chain = integrated(self.log, model)
        return chain.states(self.begin), chain.states(self.end)

    def residuals(self, model: OdometryModel) -> Array:
        """Motion of the reference relative to the odometry (M, 3): a body-frame perturbation at the end, [m, m, rad]."""
        start, end = self.states(model)
        odometry = se2.between(start[:, 1:4], end[:, 1:4])
        return se2.log(se2.between(odometry, self.motion))

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


def scatter(windows: Sequence[Windows], model: OdometryModel) -> Array:
    """Robust standard deviations (3,) of the residuals of windows with motion: longitudinal, lateral [m], heading [rad]."""
    each = []
    for one in windows:
        start, end = one.states(model)
        moved = (end - start)[:, 4:6] / (end - start)[:, :1]
        each.append(one.residuals(model)[np.any(moved > MOVING, axis=1)])
    residuals = np.concatenate(each)
    return np.asarray(np.maximum(spread(residuals) if len(residuals) else 0.0, REFERENCE_SIGMAS))


def constants_of(windows: Windows, settings: OdometrySettings) -> tuple[Constant, ...]:
    """The constants that may be fitted, with the rig's values as neutral ones."""
    found = [
        Constant("scale_distance", settings.scale_distance, 0.05, 0.2, 5.0),
        Constant("scale_rotation", settings.scale_rotation, 0.05, 0.2, 5.0),
        Constant("speed_bias", settings.speed_bias, 0.01, -1.0, 1.0),
        Constant("heading_rate_bias", settings.heading_rate_bias, 0.005, -1.0, 1.0),
        Constant("heading_drift", settings.heading_drift, 0.02, -1.0, 1.0),
        Constant("direction", settings.direction, 0.05, -np.pi, np.pi),
    ]
    if isinstance(odometry_of(windows.log), VelocityStream):
        found += [
            Constant("delay", settings.delay, 0.1, 0.0, 2.0),
            Constant("lag", settings.lag, 0.1, 0.0, 5.0),
            Constant("turn_slowdown", settings.turn_slowdown, 0.05, 0.0, 5.0),
        ]
    return tuple(found)


def denied_at_rest(found: Fit, windows: Sequence[Windows]) -> tuple[str, ...]:
    """Names of biases that contradict the windows at rest, where biases are known best.

    ``found``: the fit to all ``windows``. Commanded velocities, for instance, are zero at rest, whatever their error in motion.
    """
    stood = np.all(np.abs(np.concatenate([one.motion for one in windows])) < REFERENCE_SIGMAS, axis=1)
    denied = []
    for p, c in enumerate(found.constants):
        if c.name in ("speed_bias", "heading_rate_bias") and np.sum(stood) >= MIN_STOOD:
            without = found.residuals + found.jacobian[..., p] * (c.neutral - found.values[p])
            if loss(without[stood]) < loss(found.residuals[stood]):
                denied.append(c.name)
    return tuple(denied)


def with_constants(model: OdometryModel, values: Mapping[str, float]) -> OdometryModel:
    """The model with some constants changed."""
    changed: dict[str, Any] = dict(values)
    return replace(model, **changed)


def fit_odometry(
    windows: Sequence[Windows],
    model: OdometryModel,
    constants: Sequence[Constant],
    sigmas: Array,
    start: Mapping[str, float],
) -> Fit:
    """Fit ``constants`` to one or several logs jointly, the others as in ``model``; ``sigmas`` (3,) of the residuals.

    All windows have equal weight; weights from the fitted noise would favour windows with little motion.
    """
    names = [c.name for c in constants]

    def whitened(values: Array) -> Array:
        changed = with_constants(model, dict(zip(names, values.tolist(), strict=True)))
        return np.concatenate([one.residuals(changed) for one in windows]) / sigmas

    return fit(constants, np.array([start[n] for n in names]), whitened, blocks([w.begin for w in windows], BLOCK))
