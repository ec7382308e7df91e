"""The offline optimum: the whole run as one robust least-squares problem, solved after the last measurement.

Robust losses may have several local optima. One is found directly from the initial values. A second one is found by graduated
non-convexity: the scales of the losses are large at first, and decrease to their normal values (Yang, Antonante, Tzoumas, Carlone,
RA-L 5(2), 2020, here for the Geman-McClure loss). Many links between poses, such as loop closures, may be false. Their scales begin
so large that the losses are convex. The result is the better one of the two optima.
"""

from __future__ import annotations

import numpy as np

from factorgraph_loc.fusion.graph.graph import Addition, Graph, Guess, Keyframe
from factorgraph_loc.fusion.graph.problem import IndeterminateError, Problem, Solution
from factors import se2
from factors.graph import Factor, PriorFactor, Values, VectorPriorFactor, gather, is_of_keyframe, is_pose
from factors.se2 import Array

ITERATIONS_PER_WIDTH = 5
WIDEST = 8.0  # the initial factor on the scales of robust losses, if the initial values are rough
NARROWED = 0.5  # each step of graduated non-convexity multiplies the scales by this


def whole_problem(graph: Graph, width: float = 1.0, link_width: float = 1.0) -> Problem:
    """Return a least-squares problem with all measurements of a graph. ``link_width``: a factor on the scales of the
    robust losses of factors between two poses, such as loop closures. ``width``: a factor on the scales of all other
    robust losses."""
    assert graph.prior is not None
    keyframes = list(graph.keyframes.values())
    body = se2.world_to_body(graph.prior.pose, graph.prior.covariance)
    factors: list[tuple[Factor, tuple[int, ...]]] = [(PriorFactor(graph.prior.pose, body), (keyframes[0].key,))]
    means, covariances = graph.constant_priors()
    factors += [(VectorPriorFactor(means[key], np.sqrt(np.diag(covariances[key]))), (key,)) for key in means]
    factors += [graph.odometry_factor(k) for k in keyframes[1:]]
    for node in (node for keyframe in keyframes for node in keyframe.nodes):
        factor, sensor = node.factor, graph.sensors.get(node.sensor)
        assert factor is not None
        final = factor if sensor is None else sensor.at_end(factor, link_width if sensor.links else width)
        if final is not None:
            factors.append((final, node.keys))
    return Problem(factors)


def convex_width(graph: Graph, values: Values) -> float:
    """Return a factor on the scales of robust losses, at least 1. It is the smallest that makes all losses of factors
    between two poses, such as loop closures, convex at ``values``."""
    linked = {name: sensor for name, sensor in graph.sensors.items() if sensor.links}
    nodes = (node for k in graph.keyframes.values() for node in k.nodes if linked and node.sensor in linked)
    return max(
        (linked[n.sensor].convex_width(n.factor, gather(values, n.keys)) for n in nodes if n.factor is not None),
        default=1.0,
    )


def best_optimum(graph: Graph, start: Values, widest: float) -> tuple[Problem, Solution]:
    """Return a least-squares problem and its optimum. The graph is optimised directly and by graduated non-convexity,
    and the optimum with the lower cost is returned.

    ``start``: initial values. ``widest``: the initial factor on the scales of the robust losses. If it is 1 and the
    losses of loop closures are convex, only the direct optimum is computed.
    """
    problem = whole_problem(graph)
    best = problem.solve(start)
    width = max(widest, convex_width(graph, start))
    if width <= 1.0:
        return problem, best
    values = start
    while width > 1.0:
        values = whole_problem(graph, min(width, widest), width).solve(values, ITERATIONS_PER_WIDTH).values
        width *= NARROWED
    # either optimum may be the better one
    return problem, min(best, problem.solve(values), key=lambda s: s.cost)


def solve_whole(graph: Graph, start: Values, *, is_guess: bool) -> tuple[Array, Array]:
    """Optimise a graph with all its measurements. Returns poses (M, 3) and body-frame covariances (M, 3, 3) of the
    keyframes.

    The estimates of all other variables are written into the graph. Observations of points that are certainly false
    matches are removed. ``start``: initial values of all variables. ``is_guess``: True if the initial values are rough,
    to use graduated non-convexity. Raises RunFailedError if the measurements do not determine a variable.
    """
    graph.drop_astray(graph.keyframes.values(), start)
    problem, best = best_optimum(graph, start, WIDEST if is_guess else 1.0)
    if graph.drop_astray(graph.keyframes.values(), best.values):
        problem = whole_problem(graph)
        best = problem.solve(best.values)
    values = best.values
    try:
        marginals = problem.covariances(values, [k for k in values if is_pose(k) or not is_of_keyframe(k)])
    except IndeterminateError as error:
        raise graph.unsolved(error) from error
    graph.report_damping(marginals.damping)
    for key in graph.values:
        graph.values[key] = values[key]
        if not is_of_keyframe(key):
            graph.covariances[key] = marginals.by_key[key]
    keys = [k.key for k in graph.keyframes.values()]
    return np.array([values[key] for key in keys]), np.array([marginals.by_key[key] for key in keys])


class AtTheEnd:
    """A solver that optimises the graph only at the end of a run. The initial values are rough estimates from during
    the run."""

    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        self._guesses: Values = {}  # rough estimates of all variables except poses

    def begin(self, newest: Keyframe) -> None:
        """Delete the initial values of removed variables, and store the estimate of the keyframe ``newest``. Call this
        at the start of the graph, and whenever keyframes were removed before ``newest`` was added."""
        graph = self._graph
        graph.forget_landmarks(())
        self._guesses = {key: value for key, value in self._guesses.items() if key in graph.values}
        newest.causal = graph.pose, graph.covariance

    def attach(self, keyframe: Keyframe, addition: Addition, guess: Guess | None) -> None:
        """Store the initial values of the new variables in ``addition``. ``guess``: the estimated pose and covariance
        of ``keyframe``, or None if it is not the newest keyframe."""
        self._guesses |= addition.values
        if guess is not None:
            keyframe.causal = self._graph.pose, self._graph.covariance = guess

    extend = attach

    def current(self, key: int) -> Array:
        """Return the initial value of the variable ``key``, which must not be a pose."""
        return self._guesses[key]

    def is_open(self, keyframe: int) -> bool:
        """Return True if factors may still be added to the keyframe with the index ``keyframe``."""
        return keyframe in self._graph.keyframes

    is_kept = is_open

    def final(self, graph: Graph) -> tuple[Array, Array]:
        """Optimise the whole ``graph``. Returns poses (M, 3) and body-frame covariances (M, 3, 3) of all keyframes."""
        poses = {k.key: k.causal[0] for k in graph.keyframes.values() if k.causal is not None}
        return solve_whole(graph, graph.constant_priors()[0] | self._guesses | poses, is_guess=True)
