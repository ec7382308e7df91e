"""The optimum of a whole problem whose losses have many: from the start, and by graduated non-convexity.

The losses begin wide and narrow to their own scale (Yang, Antonante, Tzoumas, Carlone, RA-L 5(2), 2020, here for the Geman-McClure
loss). Those of links between poses, of which most may be false, begin so wide that they are convex.
"""

import numpy as np

from factorgraph_loc.fusion.graph.graph import Graph
from factorgraph_loc.fusion.graph.problem import Problem, Solution
from factorgraph_loc.fusion.graph.variables import Values
from factors.se2 import Array

ITERATIONS_PER_WIDTH = 5
NARROWED = 0.5  # width of a loss after a step, relative to the width before


def best_optimum(graph: Graph, start: Values, widest: float) -> tuple[Problem, Solution]:
    """The problem of a graph and the best optimum found from ``start``: directly, or with losses that begin ``widest`` times as
    wide."""
    problem = graph.problem()
    best = problem.solve(start)
    width = max(widest, graph.convex_width(start))
    if width <= 1.0:
        return problem, best
    values = start
    while width > 1.0:
        values = graph.problem(min(width, widest), width).solve(values, ITERATIONS_PER_WIDTH).values
        width *= NARROWED
    # either way may end in the worse optimum
    return problem, min(best, problem.solve(values), key=lambda s: s.cost)


def settled(graph: Graph, problem: Problem, solution: Solution) -> tuple[Array, Array]:
    """Take over a solution: poses (M, 3) and body-frame covariances (M, 3, 3) of all keyframes."""
    covariances = graph.settle(problem, solution.values)
    return np.array([solution.values[k.key] for k in graph.keyframes]), covariances
