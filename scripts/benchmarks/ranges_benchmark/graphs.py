"""Solutions of the factor graph of a PyFG file by GTSAM alone: a batch solution from the true poses, and an incremental
solution."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Array = NDArray[np.float64]
Range = tuple[str, float, float]  # to a beacon, with its variance

EVERY, READ_EVERY = 25, 200  # number of poses between two updates, and between two estimates of all poses
# a beacon is located after WAITING ranges. While another position is about as likely, it waits for up to PATIENCE ranges
WAITING, PATIENCE = 100, 400
STARTS = 12  # number of initial positions around the path
# another position is an alternative if it is ALTERNATIVE m away from the best one and its cost is less than BETTER times as large
ALTERNATIVE, BETTER = 3.0, 1.5


@dataclass
class Graph:
    """The content of a PyFG file.

    ``poses`` (N, 3): the true poses. ``beacons``: the true positions by name. ``steps``: the measured motions between consecutive
    poses, with their noise. ``ranges``: the measured ranges by number of the pose.
    """

    poses: Array
    beacons: dict[str, Array]
    steps: list[tuple[gtsam.Pose2, gtsam.noiseModel.Base]]
    ranges: dict[int, list[Range]] = field(default_factory=lambda: defaultdict(list))

    @staticmethod
    def of(path: Path) -> Graph:
        """Read a PyFG file."""
        poses, numbers, beacons, steps = [], {}, {}, []
        ranges: dict[int, list[Range]] = defaultdict(list)
        for kind, *cells in (line.split() for line in path.read_text(encoding="utf-8").splitlines() if line.strip()):
            if kind == "VERTEX_SE2":
                numbers[cells[1]] = len(poses)
                poses.append([float(cell) for cell in cells[2:]])
            elif kind == "VERTEX_XY":
                beacons[cells[0]] = np.array(cells[1:], dtype=float)
            elif kind == "EDGE_SE2":
                move, upper = (np.array(part, dtype=float) for part in (cells[3:6], cells[6:]))
                covariance = np.zeros((3, 3))
                covariance[np.triu_indices(3)] = upper
                covariance += np.triu(covariance, 1).T
                steps.append((gtsam.Pose2(*move), gtsam.noiseModel.Gaussian.Covariance(covariance)))
            else:
                ranges[numbers[cells[1]]].append((cells[2], float(cells[3]), float(cells[4])))
        return Graph(np.array(poses), beacons, steps, ranges)

    def start(self, pose: gtsam.Pose2) -> gtsam.NonlinearFactor:
        """Return a prior that fixes the first pose."""
        return gtsam.PriorFactorPose2(key("x", 0), pose, gtsam.noiseModel.Isotropic.Sigma(3, 1e-3))

    def step(self, i: int) -> gtsam.NonlinearFactor:
        """Return the factor of the motion to pose number ``i``."""
        move, noise = self.steps[i - 1]
        return gtsam.BetweenFactorPose2(key("x", i - 1), key("x", i), move, noise)

    def range(self, i: int, measured: Range) -> gtsam.NonlinearFactor:
        """Return the factor of a range from pose number ``i``."""
        name, distance, variance = measured
        return gtsam.RangeFactor2D(
            key("x", i), self.beacon(name), distance, gtsam.noiseModel.Isotropic.Variance(1, variance)
        )

    def beacon(self, name: str) -> int:
        """Return the key of the position of a beacon."""
        return key("l", list(self.beacons).index(name))


def key(letter: str, number: int) -> int:
    """Return GTSAM's key of a variable."""
    return int(gtsam.symbol(letter, number))


def from_truth(graph: Graph) -> Array:
    """Solve the graph by Levenberg-Marquardt, starting at the true poses and beacons. Returns the positions (N, 2) of the poses."""
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    factors.add(graph.start(gtsam.Pose2(*graph.poses[0])))
    for i, pose in enumerate(graph.poses):
        values.insert(key("x", i), gtsam.Pose2(*pose))
        if i:
            factors.add(graph.step(i))
        for measured in graph.ranges[i]:
            factors.add(graph.range(i, measured))
    for name, position in graph.beacons.items():
        values.insert(graph.beacon(name), position)
    solved = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
    return np.array([solved.atPose2(key("x", i)).translation() for i in range(len(graph.poses))])


def incremental(graph: Graph) -> Array:
    """Solve the graph by iSAM2, without true values. Returns the positions (N, 2) of the poses.

    The initial position of a beacon is computed by least squares, starting from several positions around the path.
    """
    isam, factors, values = gtsam.ISAM2(gtsam.ISAM2Params()), gtsam.NonlinearFactorGraph(), gtsam.Values()
    known: set[str] = set()
    waiting: dict[str, list[tuple[int, Range]]] = defaultdict(list)
    estimates = [gtsam.Pose2(0.0, 0.0, 0.0)]
    values.insert(key("x", 0), estimates[0])
    factors.add(graph.start(estimates[0]))
    last = len(graph.poses) - 1
    for i in range(1, last + 1):
        factors.add(graph.step(i))
        estimates.append(estimates[-1].compose(graph.steps[i - 1][0]))
        values.insert(key("x", i), estimates[-1])
        for measured in graph.ranges[i]:
            name = measured[0]
            if name in known:
                factors.add(graph.range(i, measured))
                continue
            rows = waiting[name]
            rows.append((i, measured))
            position = located(estimates, rows) if len(rows) >= WAITING else None
            if position is not None:
                known.add(name)
                values.insert(graph.beacon(name), position)
                for number, earlier in rows:
                    factors.add(graph.range(number, earlier))
        if i % EVERY == 0 or i == last:
            isam.update(factors, values)
            isam.update()
            factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
            solved = isam.calculateEstimate()
            if i % READ_EVERY == 0:
                estimates = [solved.atPose2(key("x", number)) for number in range(i + 1)]
            estimates[-1] = solved.atPose2(key("x", i))
    for _ in range(10):
        isam.update()
    solved = isam.calculateBestEstimate()
    return np.array([solved.atPose2(key("x", i)).translation() for i in range(last + 1)])


def located(poses: list[gtsam.Pose2], rows: list[tuple[int, Range]]) -> Array | None:
    """Locate a beacon by its ranges. Returns its position (2,), or None if another position explains the ranges nearly as well.

    ``rows``: pairs of the number of a pose and a range. ``poses``: the current estimates.
    """
    places = np.array([poses[i].translation() for i, _ in rows])
    distances = np.array([distance for _, (_, distance, _) in rows])
    angles = np.arange(STARTS) * 2.0 * np.pi / STARTS

    def residuals(point: Array) -> Array:
        return np.asarray(np.hypot(*(places - point).T) - distances)

    starts = places.mean(axis=0) + distances.mean() * np.column_stack((np.cos(angles), np.sin(angles)))
    found = sorted((least_squares(residuals, start, loss="soft_l1") for start in starts), key=lambda fit: fit.cost)
    best = found[0]
    others = [fit.cost for fit in found if np.hypot(*(fit.x - best.x)) > ALTERNATIVE]
    if others and others[0] <= BETTER * best.cost and len(rows) <= PATIENCE:
        return None
    return np.asarray(best.x)
