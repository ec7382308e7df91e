"""The whole run as one nonlinear least-squares problem, solved in one piece.

Levenberg-Marquardt in Python. Our factors are linearised here, where the values are at hand, because each callback from GTSAM would
copy all of them. A row of poses is solved by compiled code, anything else with GTSAM's sparse elimination.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np

from factorgraph_loc.fusion.graph.chained import Chained
from factorgraph_loc.fusion.graph.marginals import Covariances, covariances
from factors.graph import GTSAM_ERRORS, Factor, Values, gather, gaussian_factor, jacobian_factors, retract
from factors.least_squares import LEAST, MAX_ITERATIONS, descended


@dataclass(frozen=True)
class Solution:
    """Values of all variables, the cost, and how many iterations it took."""

    values: Values
    cost: float
    iterations: int


class Problem:
    """Factors, each with the keys of its variables."""

    def __init__(self, factors: Sequence[tuple[Factor, tuple[int, ...]]]) -> None:
        self._factors = factors

    @cached_property
    def _chain(self) -> Chained | None:
        """The problem as a row of poses, None where it is none."""
        chain = Chained(self._factors)
        return chain if chain.fits else None

    def solve(self, values: Values, max_iterations: int = MAX_ITERATIONS) -> Solution:
        """The optimum found from a guess, or where ``max_iterations`` lead."""
        chain = self._chain
        begin = None if chain is None else chain.begin(values)
        if chain is not None and begin is not None:
            state, cost, iterations = descended(chain.cost, chain.moved, begin, max_iterations)
            return Solution(values | chain.values(state), cost, iterations)
        return Solution(*descended(self.cost, self._moved, values, max_iterations))

    def _moved(self, values: Values, damping: float) -> tuple[Values, float] | None:
        """The values after a step of Levenberg and Marquardt, and the largest component of the step; None where the problem is
        nearly singular."""
        linear = self.linearize(values)
        curvature = {key: np.full(len(value), LEAST) for key, value in values.items()}
        for i in range(linear.size()):
            factor = linear.at(i)
            columns, end = np.square(factor.jacobian()[0]).sum(axis=0), 0
            for key in factor.keys():  # noqa: SIM118
                begin, end = end, end + len(curvature[key])
                curvature[key] += columns[begin:end]
        for key, diagonal in curvature.items():
            linear.add(gaussian_factor((key,), np.zeros(len(diagonal)), (np.diag(np.sqrt(damping * diagonal)),)))
        try:
            step = linear.optimize()
        except GTSAM_ERRORS:
            return None
        largest = max((float(np.abs(step.at(key)).max()) for key in values), default=0.0)
        return {key: retract(key, value, step.at(key)) for key, value in values.items()}, largest

    def cost(self, values: Values) -> float:
        """The robust cost, infinite where it is not a number."""
        cost = sum(factor.cost(gather(values, keys)) for factor, keys in self._factors)
        return math.inf if math.isnan(cost) else cost

    def linearize(self, values: Values) -> gtsam.GaussianFactorGraph:
        """All factors, linearised with their robust weights."""
        graph = gtsam.GaussianFactorGraph()
        for factor in jacobian_factors(self._factors, values):
            graph.add(factor)
        return graph

    def covariances(self, values: Values, keys: Iterable[int]) -> Covariances:
        """Marginal covariances of variables at a solution, poses in the body frame. IndeterminateError if there are none."""
        marginals = None if self._chain is None else self._chain.covariances(values)
        if marginals is not None:
            return marginals
        return covariances(self.linearize(values), {key: len(value) for key, value in values.items()}, list(keys))
