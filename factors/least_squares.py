"""Minimise costs by the damped steps of Levenberg (1944) and Marquardt (1963).

The damping is relative to the diagonal of the curvature, because metres, radians and scales have different magnitudes.
:func:`minima` solves many small problems with equal numbers of variables together, and :func:`minimum` solves one.
:func:`descended` is for large sparse problems, such as a graph, where the caller computes the steps.
"""

import math
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np

from factors.se2 import Array, Integers

DAMPING, MAX_DAMPING = 1e-3, 1e8
LEAST = 1e-9  # minimum of a diagonal element of the curvature. It is zero if the cost does not depend on a variable
# Limits of `descended`. The gain is relative to the cost; the step is in m, rad or the units of other variables.
MAX_ITERATIONS, CONVERGED_GAIN, CONVERGED_STEP, INITIAL_DAMPING = 100, 1e-6, 1e-6, 1e-8
State = TypeVar("State")


class Minima(NamedTuple):
    """The results of N minimisations: the final ``states`` (N, S), and the ``costs`` (N,), ``gradients`` (N, D) and
    ``curvatures`` (N, D, D) at these states. N is the number of independent costs."""

    states: Array
    costs: Array
    gradients: Array
    curvatures: Array


def minima(
    at: Callable[[Array, Integers], tuple[Array, Array, Array]],
    start: Array,
    iterations: int,
    converged: Array | float,
    *,
    moved: Callable[[Array, Array], Array] = np.add,
    largest: Array | float = np.inf,
) -> Minima:
    """Return the local minima of N independent costs, found by damped Newton steps from initial states.

    ``at(states, which)``: returns costs (n,), gradients (n, D) and curvatures (n, D, D) of the costs with indices
    ``which`` (n,). The curvature is the Fisher information or the Gauss-Newton approximation of the Hessian.
    ``start`` (N, S): initial states.
    ``iterations``: maximum number of iterations.
    ``converged``: scalar or (D,). A minimum is reached when all components of a step are at most this large.
    ``moved(states, steps)``: returns the states (n, S) after steps (n, D).
    ``largest``: scalar or (D,). A step with a larger component is shortened.
    """
    states, which = np.array(start, dtype=float), np.arange(len(start))
    best = Minima(states, *(np.array(part) for part in at(states, which)))
    damping = np.full(len(start), DAMPING)
    for _ in range(iterations):
        _, _, gradient, curvature = (part[which] for part in best)
        scale = np.maximum(np.einsum("nii->ni", curvature), LEAST)
        damped = curvature + (damping[which, None] * scale)[..., None] * np.eye(scale.shape[1])
        step = -np.linalg.solve(damped, gradient[..., None])[..., 0]
        step *= np.minimum(1.0, (largest / np.maximum(np.abs(step), 1e-12)).min(axis=1))[:, None]
        tried = moved(states[which], step)
        trial = Minima(tried, *at(tried, which))
        better = trial.costs <= best.costs[which]
        for part, new in zip(best, trial, strict=True):
            part[which[better]] = new[better]
        damping[which] *= np.where(better, 0.1, 10.0)
        which = which[np.any(np.abs(step) > converged, axis=1) & (damping[which] < MAX_DAMPING)]
        if not len(which):
            break
    return best


def minimum(
    at: Callable[[Array], tuple[float, Array, Array]],
    start: Array,
    iterations: int,
    converged: Array | float,
    *,
    largest: Array | float = np.inf,
    low: Array | float = -np.inf,
    high: Array | float = np.inf,
) -> tuple[Array, float, Array]:
    """Return the state (D,), the cost and the curvature (D, D) at a local minimum of one cost.

    ``at(state)``: returns the cost, gradient (D,) and curvature (D, D). ``start`` (D,): initial state. ``iterations``:
    maximum number of steps. A step of at most ``converged`` ends the search. A step above ``largest`` is shortened.
    ``low``, ``high``: bounds of the state. The last four are scalars or (D,).
    """

    def only(states: Array, _: Integers) -> tuple[Array, Array, Array]:
        cost, gradient, curvature = at(states[0])
        return np.array([cost]), gradient[None], curvature[None]

    def moved(states: Array, steps: Array) -> Array:
        return np.clip(states + steps, low, high)

    solution = minima(only, start[None], iterations, converged, moved=moved, largest=largest)
    return solution.states[0], float(solution.costs[0]), solution.curvatures[0]


def descended(
    cost_of: Callable[[State], float],
    moved: Callable[[State, float], tuple[State, float] | None],
    state: State,
    max_iterations: int = MAX_ITERATIONS,
) -> tuple[State, float, int]:
    """Find a local minimum of a cost. The caller computes the steps.

    ``cost_of(state)``: returns the cost.
    ``moved(state, damping)``: returns the state after one damped step, and the largest absolute component of the step.
    Returns None if the step is not determined. ``damping`` is relative to the diagonal of the curvature.
    ``state``: the initial state. ``max_iterations``: maximum number of steps.

    The search ends when the step is at most :data:`CONVERGED_STEP`, or when it reduces the cost by at most the fraction
    :data:`CONVERGED_GAIN`. Returns the state at the minimum, its cost, and the number of iterations.
    """
    damping, cost, iteration = INITIAL_DAMPING, cost_of(state), 0
    while iteration < max_iterations and damping < MAX_DAMPING:
        iteration += 1
        new = moved(state, damping)
        new_cost = math.inf if new is None else cost_of(new[0])
        if new is None or not (math.isfinite(new_cost) and new_cost <= cost):
            damping *= 10.0
            continue
        gained = cost - new_cost
        (state, step), cost, damping = new, new_cost, damping / 10.0
        if step <= CONVERGED_STEP or gained <= CONVERGED_GAIN * cost:
            break
    return state, cost, iteration
