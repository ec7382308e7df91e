"""Filters of Stone Soup. Usage: python -m speed_benchmark.programs.stonesoup_filters PROBLEM ekf|particles

It has no motion that odometry drives, and no bearing that turns with the state: both are models of one's own.
"""

from __future__ import annotations

import math
import time
from datetime import datetime, timedelta
from typing import Any

import numpy as np
from stonesoup.base import Property
from stonesoup.models.base import GaussianModel
from stonesoup.models.measurement.base import MeasurementModel
from stonesoup.models.transition.base import TransitionModel
from stonesoup.predictor.kalman import ExtendedKalmanPredictor
from stonesoup.predictor.particle import ParticlePredictor
from stonesoup.resampler.particle import ESSResampler
from stonesoup.types.angle import Bearing
from stonesoup.types.array import CovarianceMatrix, StateVector, StateVectors
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState, ParticleState
from stonesoup.updater.kalman import ExtendedKalmanUpdater
from stonesoup.updater.particle import ParticleUpdater

from speed_benchmark.programs.plain import MOTION, SIGHTING, Found, Motion, Problem, command, turned, wrapped

PARTICLES, SEED, ROBUST = 5000, 0, 4.0
GATE = 9.21  # 99 % of chi-square with two degrees of freedom
EPOCH = datetime(2020, 1, 1)


class Drive(TransitionModel, GaussianModel):
    """``step``: the motion of the next prediction in the robot's frame; ``q``: its covariance at its end."""

    step: Any = None
    q: Any = None
    heading: float = 0.0

    @property
    def ndim_state(self) -> int:
        return 3

    @property
    def ndim(self) -> int:
        return 3

    def function(self, state: Any, noise: object = False, **_: object) -> Any:
        x, (dx, dy, dh) = state.state_vector, self.step
        if noise is True:
            n = np.random.multivariate_normal(np.zeros(3), self.q, x.shape[1]).T  # noqa: NPY002 - as its own models do
            c, s = math.cos(dh), math.sin(dh)
            dx, dy, dh = dx + c * n[0] - s * n[1], dy + s * n[0] + c * n[1], dh + n[2]
        h = np.asarray(x[2, :], dtype=float)
        c, s = np.cos(h), np.sin(h)
        to = np.vstack((np.asarray(x[0, :]) + c * dx - s * dy, np.asarray(x[1, :]) + s * dx + c * dy, h + dh))
        return StateVectors(to) if to.shape[1] > 1 else StateVector(to.ravel())

    def jacobian(self, state: Any, **_: object) -> Any:
        dx, dy, _h = self.step
        self.heading = float(state.state_vector[2, 0])
        c, s = math.cos(self.heading), math.sin(self.heading)
        return np.array(((1.0, 0.0, -(s * dx + c * dy)), (0.0, 1.0, c * dx - s * dy), (0.0, 0.0, 1.0)))

    def covar(self, **_: object) -> Any:
        return CovarianceMatrix(turned(self.q, -(self.heading + self.step[2])))


class ToLandmark(MeasurementModel, GaussianModel):
    """Bearing and range."""

    landmark: tuple = Property()
    noise_covar: CovarianceMatrix = Property()

    @property
    def ndim_meas(self) -> int:
        return 2

    def covar(self, **_: object) -> Any:
        return self.noise_covar

    def function(self, state: Any, noise: object = False, **_: object) -> Any:
        x = np.asarray(state.state_vector, dtype=float)
        dx, dy = self.landmark[0] - x[0], self.landmark[1] - x[1]
        bearing, distance = wrapped(np.arctan2(dy, dx) - x[2]), np.hypot(dx, dy)
        if x.shape[1] == 1:
            return StateVector([Bearing(bearing[0]), distance[0]])
        return StateVectors(np.vstack((bearing, distance)))

    def jacobian(self, state: Any, **_: object) -> Any:
        x = np.asarray(state.state_vector, dtype=float)[:, 0]
        dx, dy = self.landmark[0] - x[0], self.landmark[1] - x[1]
        d2 = dx * dx + dy * dy
        d = math.sqrt(d2)
        return np.array(((dy / d2, -dx / d2, -1.0), (-dx / d, -dy / d, 0.0)))

    def rvs(self, *_: object, **__: object) -> Any:
        raise NotImplementedError

    def logpdf(self, state1: Any, state2: Any, **_: object) -> Any:
        """With the loss of Geman and McClure: one outlier would lose all particles."""
        off = np.asarray(state1.state_vector, dtype=float) - np.asarray(self.function(state2), dtype=float)
        off[0] = wrapped(off[0])
        squared = off[0] ** 2 / self.noise_covar[0, 0] + off[1] ** 2 / self.noise_covar[1, 1]
        return -0.5 * squared / (1.0 + squared / ROBUST**2)


def ekf(problem: Problem) -> Found:
    start = GaussianState(
        StateVector(problem.pose), CovarianceMatrix(problem.covariance), timestamp=_stamp(problem.start)
    )
    model = Drive()
    tools = model, ExtendedKalmanPredictor(model), ExtendedKalmanUpdater(None)
    return _run(problem, start, *tools, lambda now: tuple(float(v) for v in now.state_vector))


def particles(problem: Problem) -> Found:
    np.random.seed(SEED)  # noqa: NPY002 - what it draws from
    x = np.random.multivariate_normal(problem.pose, problem.covariance, PARTICLES).T  # noqa: NPY002
    even = np.full(PARTICLES, -math.log(PARTICLES))
    start = ParticleState(StateVectors(x), log_weight=even, timestamp=_stamp(problem.start))
    model = Drive()
    return _run(
        problem, start, model, ParticlePredictor(model), ParticleUpdater(None, ESSResampler(PARTICLES / 2)), _mean
    )


def _mean(now: Any) -> tuple[float, float, float]:
    w, x = np.exp(np.asarray(now.log_weight, dtype=float)), np.asarray(now.state_vector, dtype=float)
    w /= w.sum()
    return float(x[0] @ w), float(x[1] @ w), math.atan2(float(np.sin(x[2]) @ w), float(np.cos(x[2]) @ w))


def _fits(updater: Any, hypothesis: Any, seen: ToLandmark) -> bool:
    """Whether a detection lies within the gate of a Gaussian."""
    expected = updater.predict_measurement(hypothesis.prediction, seen)
    off = np.asarray(hypothesis.measurement.state_vector - expected.state_vector, dtype=float).ravel()
    hypothesis.measurement_prediction = expected
    return float(off @ np.linalg.solve(np.asarray(expected.covar, dtype=float), off)) <= GATE


def _run(problem: Problem, now: Any, model: Drive, predictor: Any, updater: Any, pose_of: Any) -> Found:
    motion, found, gated = Motion(problem.growth), Found(), isinstance(now, GaussianState)
    for kind, t, what in problem.events():
        if kind == MOTION:
            motion.add(*what)
            continue
        started = time.process_time()
        *model.step, model.q = motion.take()
        now = predictor.predict(now, timestamp=_stamp(t))
        if kind == SIGHTING:
            for lx, ly, distance, bearing, s_distance, s_bearing in what:
                noise = CovarianceMatrix(np.diag((s_bearing**2, s_distance**2)))
                seen = ToLandmark(landmark=(lx, ly), noise_covar=noise, ndim_state=3, mapping=(0, 1, 2))
                vector = StateVector([Bearing(bearing), distance])
                detection = Detection(vector, timestamp=_stamp(t), measurement_model=seen)
                hypothesis = SingleHypothesis(now, detection)
                if gated and not _fits(updater, hypothesis, seen):
                    continue
                now = updater.update(hypothesis)
            found.updates.append(time.process_time() - started)
        else:
            found.t.append(t)
            found.poses.append(pose_of(now))
    return found


def _stamp(t: float) -> datetime:
    return EPOCH + timedelta(seconds=t)


if __name__ == "__main__":
    command({"ekf": ekf, "particles": particles})
