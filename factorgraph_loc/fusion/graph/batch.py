"""The offline optimum: the whole log in one robust least-squares problem, solved when all is known.

While measurements come it only keeps a guess, as an EKF would; its result is the final trajectory, and its causal estimates
are never ``localized``. A start far from the optimum is met by graduated non-convexity (:mod:`.graduation`).

Where points that the map lacks are estimated, such a guess drifts too far to tell which sightings belong together. There the
smoother's solver goes ahead: its graph is the problem, its estimates are the start.
"""

from dataclasses import replace
from typing import Annotated

from pydantic import Field

from factorgraph_loc.fusion.graph.estimator import GraphEstimator, SolvingBackend
from factorgraph_loc.fusion.graph.graduation import best_optimum, settled
from factorgraph_loc.fusion.graph.graph import Graph
from factorgraph_loc.fusion.graph.graph_parts import Addition, GraphSettings, Guess, Keyframe, SmootherSettings
from factorgraph_loc.fusion.graph.isam import Incremental
from factorgraph_loc.fusion.graph.variables import Values, pose_key
from factorgraph_loc.model.belief import PoseEstimate
from factorgraph_loc.model.setup import Setup
from factors.se2 import Array

WIDEST = 8.0  # by default


class BatchSettings(GraphSettings):
    """Settings of the batch estimator."""

    widest_loss: Annotated[float, Field(ge=1.0, le=1000.0)] = WIDEST
    """how many times wider than its own scale the robust loss begins; 1 for a plain robust start"""


class Batch(GraphEstimator):
    """Robust optimum over the whole log, computed once at its end. See the module."""

    causal = False

    def __init__(self, setup: Setup, settings: BatchSettings) -> None:
        self._settings = settings
        super().__init__(setup, settings)

    def _new_backend(self, graph: Graph) -> SolvingBackend:
        ahead = SmootherSettings(**self._settings.model_dump(exclude={"widest_loss"}))
        return at_the_end(graph, ahead, self._settings.widest_loss)

    def estimate(self, t: float | None = None) -> PoseEstimate:
        """The guess so far: not an estimate to be scored, as the problem is only solved at the end."""
        guess = super().estimate(t)
        return guess if self._graph.prior is None else replace(guess, status="unlocalized")


def at_the_end(graph: Graph, settings: SmootherSettings, widest: float = WIDEST) -> SolvingBackend:
    """A backend that solves the problem at the end, with robust losses that begin ``widest`` times as wide; ``settings``: of the
    smoother that goes ahead where points are estimated."""
    if any(mapper.estimates for mapper in graph.mappers):
        return Ahead(graph, settings, widest)
    return Guessing(graph, widest)


def graduated(graph: Graph, start: Values, widest: float) -> tuple[Array, Array]:
    """Poses (M, 3) and body-frame covariances (M, 3, 3) of all keyframes at the best optimum found from ``start``, with
    robust losses that begin ``widest`` times as wide."""
    problem, best = best_optimum(graph, start, widest)
    if graph.drop_astray(graph.keyframes, best.values):
        problem = graph.problem()
        best = problem.solve(best.values)
    return settled(graph, problem, best)


class Ahead(Incremental):
    """A backend that is solved on the way, and once more at the end."""

    def __init__(self, graph: Graph, settings: SmootherSettings, widest: float) -> None:
        super().__init__(graph, settings)
        self._widest = widest

    def final(self, graph: Graph) -> tuple[Array, Array]:
        """The optimum over the whole log."""
        return graduated(graph, self.solved(graph), self._widest)


class Guessing:
    """A backend that keeps a guess and solves the problem at the end."""

    def __init__(self, graph: Graph, widest: float) -> None:
        self._graph, self._widest = graph, widest
        self._guesses: Values = {}
        self._spreads: Values = {}  # of keyframes

    def begin(self, newest: Keyframe) -> None:
        """The graph begins, or keyframes were taken back and ``newest`` was added."""
        graph = self._graph
        graph.forget_landmarks(())
        kept = {k.key for k in graph.keyframes}
        self._guesses = {key: value for key, value in self._guesses.items() if key in kept or key in graph.values}
        self.refine(newest, (graph.pose, graph.covariance))

    def extend(self, keyframe: Keyframe, addition: Addition, spread: Array) -> None:
        """Take a new keyframe and what came with it."""
        self._guesses |= addition.values
        self._graph.pose, self._graph.covariance = addition.values[keyframe.key], spread
        self._spreads[keyframe.key] = spread

    def attach(self, keyframe: Keyframe, addition: Addition, guess: Guess | None) -> None:
        """Take what was added to a keyframe that is in the graph."""
        self._guesses |= addition.values
        if guess is not None:
            self._graph.pose, self._graph.covariance = guess
            self.refine(keyframe, guess)

    def refine(self, newest: Keyframe, guess: Guess) -> None:
        """Take pose and covariance of the newest keyframe."""
        self._guesses[newest.key], self._spreads[newest.key] = guess

    def guess_of(self, keyframe: int) -> Guess:
        """The causal estimate of a keyframe."""
        key = pose_key(keyframe)
        return self._guesses[key], self._spreads[key]

    def current(self, key: int) -> Array:
        """The newest estimate of a variable."""
        return self._guesses[key]

    def is_open(self, keyframe: int) -> bool:
        """Whether factors may still be added to a keyframe."""
        return 0 <= keyframe < len(self._graph.keyframes)

    is_kept = is_open

    def final(self, graph: Graph) -> tuple[Array, Array]:
        """The optimum over the whole log."""
        return graduated(graph, graph.constant_priors()[0] | self._guesses, self._widest)
