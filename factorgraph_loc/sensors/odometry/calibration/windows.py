"""Segments of a log with the motion of reference and odometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.odometry.measurement import IncrementStream, VelocityStream
from factorgraph_loc.sensors.odometry.motion import odometry_model
from factors import se2
from factors.motion import ChainState
from factors.odometry.chain import OdometryChain
from factors.odometry.model import OdometryModel, relative_motion
from factors.se2 import Array

REFERENCE_GAP = 0.35  # s; longest interpolated gap between reference poses
BEFORE = 1.0  # s before a window in which the odometry must be complete too, because of its lag


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
