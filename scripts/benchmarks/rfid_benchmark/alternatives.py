"""The compressed factor compared with two others in the same batch problem: same logs, initial values and solver."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from benchmarking.ensemble import Series, series
from benchmarking.report import Options, Report, pooled

from factorgraph_loc.experiments.preparation import resolve_prior
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion.problem import Problem
from factorgraph_loc.fusion.variables import Values, constants_key, pose_key
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.odometry.motion import OdometryMotion
from factorgraph_loc.sensors.rfid.known_tags import KnownTags
from factorgraph_loc.sensors.rfid.measurement import RfidScan
from factorgraph_loc.simulation import simulate
from factorgraph_loc.simulation.settings import preset
from factors import se2
from factors.graph import Factor, PriorFactor, VectorPriorFactor
from factors.odometry.model import OdometryFactor
from factors.rfid.counts import TagReadCounts
from factors.rfid.detection import RfidLikelihood
from factors.rfid.factor import RfidFactor
from factors.se2 import Array

SEEDS = 10
FIRST = 3000
DURATION = 120.0  # s
SENSORS = ("odometry", "rfid")
ODOMETRY_KEY = constants_key(0)
STEP = 1e-5  # of numerical derivatives
CELL = 0.1  # m, of the sums over the antenna's field


class StackedFactor:
    """One row sqrt(2 nll) for each antenna and tag, with numerical derivatives."""

    def __init__(self, likelihood: RfidLikelihood, looks: TagReadCounts) -> None:
        self._likelihood, self._looks = likelihood, looks.listing(np.arange(len(likelihood.tags.points)))

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        steps = STEP * np.concatenate((np.eye(3), -np.eye(3)))
        rows = self._rows(se2.compose(values[0], se2.exp(np.concatenate((np.zeros((1, 3)), steps)))))
        return rows[0], [(rows[1:4] - rows[4:]).T / (2.0 * STEP)]

    def cost(self, values: Sequence[Array]) -> float:
        return 0.5 * float(np.sum(self._rows(np.atleast_2d(values[0])) ** 2))

    def _rows(self, poses: Array) -> Array:
        """Residuals (N, A * T) at poses (N, 3)."""
        looks, tempering = self._looks, self._likelihood.model.tempering
        nll = []
        for offset, antenna, rounds, hits in zip(looks.offsets, looks.antennas, looks.rounds, looks.hits, strict=True):
            q = self._likelihood.probabilities(se2.compose(poses, offset), int(antenna))
            nll.append(-hits * np.log(q) - (rounds - hits) * np.log1p(-q))
        return np.sqrt(2.0 * tempering * np.concatenate(nll, axis=1))


class GaussianFactor:
    """Each detection as a measured position of its tag in the antenna's frame, with mean and covariance of the detection field by
    moment matching. Missed reads are ignored."""

    def __init__(self, likelihood: RfidLikelihood, looks: TagReadCounts, fields: Sequence[tuple[Array, Array]]) -> None:
        rows, tags = np.nonzero(looks.hits)
        antennas = looks.antennas[rows]
        self._points = likelihood.tags.points[looks.listed[tags], :2]
        places = np.array([(a.x, a.y, a.yaw) for a in likelihood.model.antennas])
        self._places = se2.compose(looks.offsets[rows], places[antennas]) if len(rows) else np.empty((0, 3))
        self._means = np.array([fields[a][0] for a in antennas]).reshape(-1, 2)
        roots = np.array([np.linalg.inv(np.linalg.cholesky(fields[a][1])) for a in antennas]).reshape(-1, 2, 2)
        self._roots = roots * np.sqrt(likelihood.model.tempering * looks.hits[rows, tags])[:, None, None]

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        if not len(self._points):
            return np.zeros(1), [np.zeros((1, 3))]
        seen = se2.transform_to(values[0], self._points)
        by_pose = np.zeros((len(seen), 2, 3))
        by_pose[:, 0, 0] = by_pose[:, 1, 1] = -1.0
        by_pose[:, 0, 2], by_pose[:, 1, 2] = seen[:, 1], -seen[:, 0]
        c, s = np.cos(self._places[:, 2]), np.sin(self._places[:, 2])
        turn: Array = np.moveaxis(np.array(((c, s), (-s, c))), 2, 0)
        residual = self._roots @ (turn @ (seen - self._places[:, :2])[..., None] - self._means[..., None])
        return residual.ravel(), [(self._roots @ turn @ by_pose).reshape(-1, 3)]

    def cost(self, values: Sequence[Array]) -> float:
        return 0.5 * float(np.sum(self.linearize(values)[0] ** 2))


def field_moments(likelihood: RfidLikelihood, antenna: int) -> tuple[Array, Array]:
    """Mean (2,) and covariance (2, 2) of the position of a read tag in the antenna's frame, for a uniform prior."""
    mounted, model = likelihood.model.antennas[antenna], likelihood.model
    reach = model.models[mounted.model].reach
    axis = np.arange(-reach, reach, CELL)
    points = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    # the antenna at each pose sees the first tag at one of the points
    tag = likelihood.tags.points[0, :2]
    at = se2.compose(np.array((*tag, 0.0)), np.column_stack((-points, np.zeros(len(points)))))
    poses = se2.compose(at, se2.inverse(np.array((mounted.x, mounted.y, mounted.yaw))))
    q = np.maximum(likelihood.probabilities(poses, antenna)[:, 0] - model.false_read, 0.0)
    q /= q.sum()
    mean = q @ points
    return mean, ((points - mean) * q[:, None]).T @ (points - mean)


Maker = Callable[[RfidLikelihood, TagReadCounts], Factor]


def makers(likelihood: RfidLikelihood) -> dict[str, Maker]:
    fields = [field_moments(likelihood, antenna) for antenna in range(len(likelihood.model.antennas))]
    return {
        "compressed (four rows)": RfidFactor,
        "stacked sqrt(2 nll)": StackedFactor,
        "Gaussian place per detection": lambda lik, looks: GaussianFactor(lik, looks, fields),
    }


@dataclass(frozen=True)
class Solved:
    final: Series
    seconds: float
    iterations: int


def solve_all(seed: int) -> dict[str, Solved]:
    """Each alternative on one log, with keyframes at the scans, and the smoother's causal estimates as initial values."""
    log = simulate(preset("office", {"drive": {"duration": DURATION}}), seed)
    causal = run(log, RunConfig("smoother", {"smooth": False})).causal()
    assert causal is not None
    tags = KnownTags(Setup(log.rig, log.world, SENSORS, np.random.default_rng(0)), Diagnostics())
    assert tags.likelihood is not None
    found = {}
    for label, make in makers(tags.likelihood).items():
        for warm in (True, False):  # exclude compilation from the time
            problem, values, t = problem_of(log, causal, tags, make)
            started = time.perf_counter()
            solution = problem.solve(values, 1 if warm else 100)
            seconds = time.perf_counter() - started
        poses = np.array([solution.values[pose_key(k)] for k in range(len(t))])
        found[label] = Solved(series(Trajectory(t, poses), log), seconds, solution.iterations)
    return found


def problem_of(log: Log, causal: Trajectory, tags: KnownTags, make: Maker) -> tuple[Problem, Values, Array]:
    """The whole log as one problem, initial values of all variables, and the times of the keyframes."""
    prior, _ = resolve_prior(log, "log")
    assert prior is not None
    assert tags.likelihood is not None
    motion = OdometryMotion(log.rig, SENSORS, Diagnostics(), self_calibration=True)
    constants = log.rig.estimated("odometry")
    factors: list[tuple[Factor, tuple[int, ...]]] = [
        (PriorFactor(prior.pose, se2.world_to_body(prior.pose, prior.covariance)), (pose_key(0),)),
        (VectorPriorFactor(np.zeros(len(constants.names)), constants.sigmas), (constants_key(0),)),
    ]
    t, before = [prior.t], None
    for m in log.measurements(SENSORS):
        if m.is_motion:
            motion.add(m)
            before = before or motion.state(prior.t)
        elif isinstance(m, RfidScan) and before is not None and (looks := tags.looks(m)) is not None:
            state, k = motion.state(m.t), len(t)
            between = OdometryFactor(motion.relative(before, state), constants.indices)
            factors.append((between, (pose_key(k - 1), pose_key(k), constants_key(0))))
            factors.append((make(tags.likelihood, looks), (pose_key(k),)))
            t.append(m.t)
            before = state
    guess = causal.at(np.clip(np.array(t), causal.t[0], causal.t[-1]))
    values: Values = {pose_key(k): pose for k, pose in enumerate(guess)}
    return Problem(factors), values | {constants_key(0): np.zeros(len(constants.names))}, np.array(t)


def section(options: Options) -> Report:
    report = Report("alternatives", options)
    seeds = list(range(FIRST, FIRST + options.count(SEEDS)))
    outcomes = report.collect(solve_all, seeds, [f"seed {seed}" for seed in seeds])
    report.say(
        f"`office`, {len(outcomes)} worlds of {DURATION:.0f} s, batch with a keyframe at each scan, from the same guess"
    )
    labels = list(next(iter(outcomes.values()), {}))
    rows = []
    for label in labels:
        solved = [outcome[label] for outcome in outcomes.values()]
        position, heading = pooled([one.final for one in solved])
        median = np.median([one.seconds for one in solved])
        iterations = np.median([one.iterations for one in solved])
        rows.append((label, f"{position:.3f}", f"{heading:.2f}", f"{median:.2f}", f"{iterations:.0f}"))
    report.table(("factor", "final RMSE [m]", "heading [deg]", "seconds", "iterations"), rows)
    return report
