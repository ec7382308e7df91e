"""Nonlinear least squares by the steps of Levenberg and Marquardt, for a problem that linearises itself."""

import math
from collections.abc import Callable, Mapping
from typing import TypeVar

import gtsam
import numpy as np

from factorgraph_loc.fusion.graph.variables import GTSAM_ERRORS

MAX_ITERATIONS = 100
CONVERGED_GAIN = 1e-6  # of the cost
INITIAL_DAMPING = 1e-4
MAX_DAMPING = 1e8
UNITS = {size: gtsam.noiseModel.Unit.Create(size) for size in range(1, 10)}
State = TypeVar("State")


def optimum(
    cost_of: Callable[[State], float],
    moved: Callable[[State, float], State | None],
    state: State,
    max_iterations: int = MAX_ITERATIONS,
) -> tuple[State, float, int]:
    """The optimum, its cost, and how many steps there were. ``moved``: the state after a step with some damping; None where that
    is not determined.
    """
    damping, cost, iteration = INITIAL_DAMPING, cost_of(state), 0
    while iteration < max_iterations and damping < MAX_DAMPING:
        iteration += 1
        new = moved(state, damping)
        new_cost = math.inf if new is None else cost_of(new)
        if new is None or not (math.isfinite(new_cost) and new_cost <= cost):
            damping *= 10.0
            continue
        gained = cost - new_cost
        state, cost, damping = new, new_cost, damping / 10.0
        if gained <= CONVERGED_GAIN * cost:
            break
    return state, cost, iteration


def damped_step(
    linear: gtsam.GaussianFactorGraph, sizes: Mapping[int, int], damping: float
) -> gtsam.VectorValues | None:
    """The step of a linear problem, to which ``damping`` is added, in variables of ``sizes``; None where it is nearly singular."""
    graph = gtsam.GaussianFactorGraph()
    graph.push_back(linear)
    for key, size in sizes.items():
        graph.add(gtsam.JacobianFactor(key, np.sqrt(damping) * np.eye(size), np.zeros(size), UNITS[size]))
    try:
        return graph.optimize()
    except GTSAM_ERRORS:
        return None
