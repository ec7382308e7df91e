"""The whole run as one nonlinear least-squares problem, solved at once.

Levenberg-Marquardt in Python with GTSAM's sparse elimination: our factors are linearised here, where the values are at hand,
because each callback from GTSAM would copy all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from factorgraph_loc.estimators.base import PosePrior
from factors import se2
from factors.graph import Factor, PriorFactor, jacobian_factor
from factors.se2 import Array

PARAMETERS_KEY = gtsam.symbol("c", 0)

MAX_ITERATIONS = 100
CONVERGED_GAIN = 1e-6  # of the cost
INITIAL_DAMPING = 1e-4
MAX_DAMPING = 1e8
UNIT3 = gtsam.noiseModel.Unit.Create(3)


def pose_key(index: int) -> int:
    """The key of the pose of keyframe ``index``."""
    return int(gtsam.symbol("x", index))


@dataclass(frozen=True)
class Solution:
    """Poses (M, 3) of the keyframes, parameters (P,), the cost, and how many iterations it took."""

    poses: Array
    parameters: Array
    cost: float
    iterations: int


class Problem:
    """Factors over M poses and, as one more variable, the P estimated constants of the odometry.

    ``unary``: pairs (keyframe, factor on its pose). ``odometry``: the M-1 factors between neighbours, which take the constants too
    where P is not zero.
    """

    def __init__(
        self,
        prior: PosePrior,
        parameter_sigmas: Array,
        odometry: Sequence[Factor],
        unary: Sequence[tuple[int, Factor]],
    ) -> None:
        self._count = len(odometry) + 1
        self._has_parameters = len(parameter_sigmas) > 0
        body = se2.world_to_body(prior.pose, prior.covariance)
        self._factors: list[tuple[Factor, tuple[int, ...]]] = [(PriorFactor(prior.pose, body), (0,))]
        self._factors += [(factor, (i, i + 1)) for i, factor in enumerate(odometry)]
        self._factors += [(factor, (index,)) for index, factor in unary]
        self._parameter_sigmas = parameter_sigmas
        self._first_binary, self._after_binary = 1, 1 + len(odometry)

    def solve(self, poses: Array, parameters: Array, max_iterations: int = MAX_ITERATIONS) -> Solution:
        """The optimum found from a guess, or where ``max_iterations`` lead."""
        damping, cost = INITIAL_DAMPING, self.cost(poses, parameters)
        iteration = 0
        while iteration < max_iterations and damping < MAX_DAMPING:
            iteration += 1
            graph = self.linearize(poses, parameters)
            for i in range(self._count):
                graph.add(gtsam.JacobianFactor(pose_key(i), np.sqrt(damping) * np.eye(3), np.zeros(3), UNIT3))
            step = graph.optimize()
            d_poses = np.array([step.at(pose_key(i)) for i in range(self._count)])
            d_parameters = step.at(PARAMETERS_KEY) if self._has_parameters else np.zeros(0)
            new_poses, new_parameters = se2.compose(poses, se2.exp(d_poses)), parameters + d_parameters
            new_cost = self.cost(new_poses, new_parameters)
            if new_cost > cost:
                damping *= 10.0
                continue
            gained = cost - new_cost
            poses, parameters, cost, damping = new_poses, new_parameters, new_cost, damping / 10.0
            if gained < CONVERGED_GAIN * cost:
                break
        return Solution(poses, parameters, cost, iteration)

    def cost(self, poses: Array, parameters: Array) -> float:
        """The robust cost."""
        total = 0.5 * float(np.sum((parameters / self._parameter_sigmas) ** 2)) if self._has_parameters else 0.0
        return total + sum(
            f.cost(self._values(i, where, poses, parameters)) for i, (f, where) in enumerate(self._factors)
        )

    def linearize(self, poses: Array, parameters: Array) -> gtsam.GaussianFactorGraph:
        """All factors, linearised with their robust weights."""
        graph = gtsam.GaussianFactorGraph()
        for i, (factor, where) in enumerate(self._factors):
            keys = [pose_key(index) for index in where]
            if self._takes_parameters(i):
                keys.append(PARAMETERS_KEY)
            graph.add(jacobian_factor(factor, keys, self._values(i, where, poses, parameters)))
        if self._has_parameters:
            whitener = np.diag(1.0 / self._parameter_sigmas)
            unit = gtsam.noiseModel.Unit.Create(len(parameters))
            graph.add(gtsam.JacobianFactor(PARAMETERS_KEY, whitener, -whitener @ parameters, unit))
        return graph

    def covariances(self, poses: Array, parameters: Array) -> tuple[Array, Array]:
        """Body-frame covariances (M, 3, 3) of the poses and (P, P) of the parameters at a solution."""
        values = gtsam.Values()
        for i, pose in enumerate(poses):
            values.insert(pose_key(i), gtsam.Pose2(*pose))
        if self._has_parameters:
            values.insert(PARAMETERS_KEY, parameters)
        marginals = gtsam.Marginals(self.linearize(poses, parameters), values)
        each = np.array([marginals.marginalCovariance(pose_key(i)) for i in range(self._count)])
        shared = marginals.marginalCovariance(PARAMETERS_KEY) if self._has_parameters else np.zeros((0, 0))
        return each, shared

    def _takes_parameters(self, factor: int) -> bool:
        return self._has_parameters and self._first_binary <= factor < self._after_binary

    def _values(self, factor: int, where: tuple[int, ...], poses: Array, parameters: Array) -> list[Array]:
        values = [poses[index] for index in where]
        return [*values, parameters] if self._takes_parameters(factor) else values
