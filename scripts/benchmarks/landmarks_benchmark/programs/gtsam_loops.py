"""Localization by GTSAM in plain loops. There is a keyframe at each measurement of landmarks, whose positions are known.

``lag`` and ``full`` estimate the same constants as this project: the bias of the gyro, and four constants of the landmark sensor.
Their factors are written in numpy. ``batch`` uses GTSAM's own factors. It starts from dead reckoning and runs Levenberg-Marquardt
with a Huber loss, then again with a Geman-McClure loss. At the end it computes marginal covariances.
"""

from __future__ import annotations

import math
import time
from typing import Any

import gtsam
import numpy as np

from landmarks_benchmark.programs.plain import MOTION, SIGHTING, Found, Motion, Problem, composed, turned, wrapped

LAG = 10.0  # s
HUBER, GEMAN_MCCLURE = 1.345, 4.0
BIAS, SENSOR = gtsam.symbol("b", 0), gtsam.symbol("s", 0)
ROBUST = gtsam.noiseModel.Robust.Create(
    gtsam.noiseModel.mEstimator.Huber.Create(HUBER), gtsam.noiseModel.Unit.Create(2)
)


def lag(problem: Problem) -> Found:
    """Run GTSAM's fixed-lag smoother."""
    return _incremental(problem, gtsam.IncrementalFixedLagSmoother(LAG, _parameters()))


def full(problem: Problem) -> Found:
    """Run iSAM2 with the full history."""
    return _incremental(problem, gtsam.ISAM2(_parameters()))


def _parameters() -> Any:
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(0.05)
    parameters.relinearizeSkip = 10
    parameters.setFactorization("QR")
    return parameters


def _incremental(problem: Problem, solver: Any) -> Found:
    fixed = isinstance(solver, gtsam.IncrementalFixedLagSmoother)
    graph, values, stamps = gtsam.NonlinearFactorGraph(), gtsam.Values(), {}
    motion, found = Motion(problem.growth), Found()
    gyro, *sensor = problem.constants.tolist()
    _start(problem, graph, values)
    for key, sigmas in ((BIAS, (gyro,)), (SENSOR, sensor)):
        sigma = np.maximum(sigmas, 1e-9)
        graph.add(gtsam.PriorFactorVector(key, np.zeros(len(sigma)), gtsam.noiseModel.Diagonal.Sigmas(sigma)))
        values.insert(key, np.zeros(len(sigma)))
    stamps = {_x(0): problem.start}
    k, pose, last, bias = 0, gtsam.Pose2(*problem.pose), problem.start, 0.0
    for kind, t, what in problem.events(raw=True):
        if kind == MOTION:
            motion.add(*what)
        elif kind == SIGHTING:
            started = time.process_time()
            x, y, h, q = motion.take()
            k += 1
            graph.add(_odometry(_x(k - 1), _x(k), (x, y, h), t - last, q))
            pose = pose.compose(gtsam.Pose2(x, y, h - bias * (t - last)))
            values.insert(_x(k), pose)
            last = t
            for row in what:
                graph.add(_sighting(_x(k), row, problem.sensor.tolist()))
            if fixed:
                stamps[_x(k)] = stamps[BIAS] = stamps[SENSOR] = t
                solver.update(graph, values, stamps)
                stamps.clear()
            else:
                solver.update(graph, values)
            graph.resize(0)
            values.clear()
            pose = solver.calculateEstimatePose2(_x(k))
            bias = solver.calculateEstimateVector(BIAS)[0]
            solver.marginalCovariance(_x(k))
            found.updates.append(time.process_time() - started)
        else:
            x, y, h = motion.so_far()
            found.t.append(t)
            found.poses.append(composed((pose.x(), pose.y(), pose.theta()), (x, y, h - bias * (t - last))))
    return found


def _x(k: int) -> int:
    return int(gtsam.symbol("x", k))


def _start(problem: Problem, graph: Any, values: Any) -> None:
    pose = gtsam.Pose2(*problem.pose)
    noise = gtsam.noiseModel.Gaussian.Covariance(turned(problem.covariance, problem.pose[2]))
    graph.add(gtsam.PriorFactorPose2(_x(0), pose, noise))
    values.insert(_x(0), pose)


def _odometry(i: int, j: int, move: tuple[float, float, float], duration: float, q: Any) -> Any:
    """Return the factor of the motion between two poses. The bias of the turn rate is a variable.

    ``i``, ``j``: keys of the poses. ``move``: the measured motion. ``duration`` [s]. ``q`` (3, 3): its covariance.
    """
    arc = gtsam.Pose2.Logmap(gtsam.Pose2(*move))

    def error(_: Any, values: Any, jacobians: Any) -> Any:
        bent = arc.copy()
        bent[2] -= values.atVector(BIAS)[0] * duration
        between = values.atPose2(i).between(values.atPose2(j))
        if jacobians is not None:
            jacobians[0] = -between.inverse().AdjointMap()
            jacobians[1] = np.eye(3)
            # last column of the right Jacobian of the exponential map, to first order
            jacobians[2] = np.array(((0.5 * bent[1] * duration,), (-0.5 * bent[0] * duration,), (duration,)))
        return gtsam.Pose2.Logmap(gtsam.Pose2.Expmap(bent).between(between))

    return gtsam.CustomFactor(gtsam.noiseModel.Gaussian.Covariance(q), [i, j, BIAS], error)


def _sighting(key: int, row: tuple[float, ...], sensor: list[float]) -> Any:
    """Return the factor of depth and bearing of a landmark. Position, bearing bias, scale and depth axis of the sensor are
    variables."""
    lx, ly, depth, bearing, s_depth, s_bearing = row
    place, scale = sensor
    ir, ib = 1.0 / s_depth, 1.0 / s_bearing

    def error(_: Any, values: Any, jacobians: Any) -> Any:
        pose, off = values.atPose2(key), values.atVector(SENSOR)
        x, y, h = pose.x(), pose.y(), pose.theta()
        c, s = math.cos(h), math.sin(h)
        rx, ry = c * (lx - x) + s * (ly - y), c * (ly - y) - s * (lx - x)
        u, w = rx - place - off[0], ry
        ca, sa, k = math.cos(off[3]), math.sin(off[3]), scale * (1.0 + off[2])
        d2 = u * u + w * w
        if jacobians is not None:
            a, b, e, f = k * ca * ir, k * sa * ir, -w / d2 * ib, u / d2 * ib
            jacobians[0] = np.array(((-a, -b, a * ry - b * rx), (-e, -f, e * ry - f * rx)))
            by_scale, by_axis = scale * (ca * u + sa * w) * ir, k * (ca * w - sa * u) * ir
            jacobians[1] = np.array(((-a, 0.0, by_scale, by_axis), (-e, ib, 0.0, 0.0)))
        return np.array(((k * (ca * u + sa * w) - depth) * ir, wrapped(math.atan2(w, u) + off[1] - bearing) * ib))

    return gtsam.CustomFactor(ROBUST, [key, SENSOR], error)


def batch(problem: Problem) -> Found:
    """Estimate the whole trajectory by Levenberg-Marquardt."""
    graph, values, motion, found = gtsam.NonlinearFactorGraph(), gtsam.Values(), Motion(problem.growth), Found()
    _start(problem, graph, values)
    k, pose, asked = 0, gtsam.Pose2(*problem.pose), []
    known: dict[tuple[float, float], int] = {}
    tight = gtsam.noiseModel.Isotropic.Sigma(2, 1e-4)
    huber = gtsam.noiseModel.mEstimator.Huber.Create(HUBER)
    for kind, t, what in problem.events():
        if kind == MOTION:
            motion.add(*what)
        elif kind == SIGHTING:
            x, y, h, q = motion.take()
            k += 1
            move = gtsam.Pose2(x, y, h)
            graph.add(gtsam.BetweenFactorPose2(_x(k - 1), _x(k), move, gtsam.noiseModel.Gaussian.Covariance(q)))
            pose = pose.compose(move)
            values.insert(_x(k), pose)
            for lx, ly, distance, bearing, s_distance, s_bearing in what:
                place = np.array((lx, ly))
                if (lx, ly) not in known:
                    known[lx, ly] = int(gtsam.symbol("l", len(known)))
                    values.insert(known[lx, ly], place)
                    graph.add(gtsam.PriorFactorPoint2(known[lx, ly], place, tight))
                noise = gtsam.noiseModel.Diagonal.Sigmas(np.array((s_bearing, s_distance)))
                robust = gtsam.noiseModel.Robust.Create(huber, noise)
                at = _x(k), known[lx, ly]
                graph.add(gtsam.BearingRangeFactor2D(*at, gtsam.Rot2(bearing), distance, robust))
        else:
            asked.append((t, k, motion.so_far()))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    graph = _levelled(graph)
    solved = gtsam.LevenbergMarquardtOptimizer(graph, solved).optimize()
    marginals = gtsam.Marginals(graph, solved)
    for i in range(k + 1):
        marginals.marginalCovariance(_x(i))
    for t, i, since in asked:
        there = solved.atPose2(_x(i))
        found.t.append(t)
        found.poses.append(composed((there.x(), there.y(), there.theta()), since))
    return found


def _levelled(graph: Any) -> Any:
    """Return the graph with a Geman-McClure loss, which is bounded, in place of the Huber loss."""
    loss, made = gtsam.noiseModel.mEstimator.GemanMcClure.Create(GEMAN_MCCLURE), gtsam.NonlinearFactorGraph()
    for i in range(graph.size()):
        factor = graph.at(i)
        if isinstance(factor, gtsam.BearingRangeFactor2D):
            robust: Any = factor.noiseModel()
            factor = factor.cloneWithNewNoiseModel(gtsam.noiseModel.Robust.Create(loss, robust.noise()))
        made.add(factor)
    return made
