"""The offline optimum: the whole log in one robust least-squares problem, solved when all is known.

While measurements come it only keeps a guess, as an EKF would; its result is the final trajectory, and its causal estimates
are never ``localized``. A start far from the optimum is met by graduated non-convexity: the robust loss begins
wide and narrows to its own scale (Yang, Antonante, Tzoumas, Carlone, RA-L 5(2), 2020, here for the Geman-McClure loss).

Where points that the map lacks are estimated, such a guess drifts too far to tell which sightings belong together. There the
smoother goes ahead: its graph is the problem, its estimates are the start.
"""

from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import Field

from factorgraph_loc.fusion.graph_parts import Addition, GraphSettings, Guess, Keyframe
from factorgraph_loc.fusion.relocating import RelocatingGraph
from factorgraph_loc.fusion.smoother import Smoother, SmootherSettings
from factorgraph_loc.fusion.variables import Values, pose_key
from factorgraph_loc.model.belief import Belief, PoseEstimate, PosePrior
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.learnt import Learnt
from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.model.trajectory import Trajectory
from factors.se2 import Array

ITERATIONS_PER_WIDTH = 5


class BatchSettings(GraphSettings):
    """``widest_loss``: how many times wider than its own scale the robust loss begins; 1 for a plain robust start."""

    widest_loss: Annotated[float, Field(ge=1.0, le=1000.0)] = 8.0


class GraduatedGraph(RelocatingGraph):
    """A graph that is solved at the end, with a robust loss that begins ``_widest`` times as wide."""

    _widest: float

    def _optimum(self, start: Values) -> tuple[Array, Array]:
        """Poses (M, 3) and body-frame covariances (M, 3, 3) of all keyframes at the best optimum that is found from ``start``."""
        problem = self._problem()
        best = problem.solve(start)
        width = self._widest
        if width > 1.0:
            values = start
            while width > 1.0:
                values, width = self._problem(width).solve(values, ITERATIONS_PER_WIDTH).values, width / 2.0
            # either way may end in the worse optimum
            best = min(best, problem.solve(values), key=lambda s: s.cost)
        if self._drop_astray(self._keyframes, best.values):
            problem = self._problem()
            best = problem.solve(best.values)
        covariances = self._settle(problem, best.values)
        return np.array([best.values[k.key] for k in self._keyframes]), covariances


class SmootherAhead(GraduatedGraph, Smoother):
    """The smoother with the end of a batch."""

    def __init__(self, setup: Setup, settings: BatchSettings) -> None:
        super().__init__(setup, SmootherSettings(**settings.model_dump(exclude={"widest_loss"})))
        self._widest = settings.widest_loss


class Batch(GraduatedGraph):
    """The batch estimator; see the module."""

    def __init__(self, setup: Setup, settings: BatchSettings) -> None:
        super().__init__(setup, settings)
        self._widest = settings.widest_loss
        self._guesses: Values = {}
        self._guess_spreads: Values = {}  # of keyframes
        self._ahead: SmootherAhead | None = None
        if self._unknown is not None:
            self._ahead = SmootherAhead(setup, settings)
            self.diagnostics = self._ahead.diagnostics

    def initialize(self, prior: PosePrior) -> None:
        """Start from a Gaussian."""
        if self._ahead is not None:
            self._ahead.initialize(prior)
        else:
            super().initialize(prior)

    def process(self, measurement: Measurement) -> None:
        """Take one measurement, in time or late by at most ``max_delay``."""
        if self._ahead is not None:
            self._ahead.process(measurement)
        else:
            super().process(measurement)

    def estimate(self, t: float | None = None) -> PoseEstimate:
        """The guess so far: not an estimate to be scored, as the problem is only solved at the end."""
        if self._ahead is not None:
            return replace(self._ahead.estimate(t), status="unlocalized")
        guess = super().estimate(t)
        return guess if self._prior is None else replace(guess, status="unlocalized")

    def belief(self, t: float | None = None) -> Belief:
        """The belief behind :meth:`estimate`."""
        return super().belief(t) if self._ahead is None else self._ahead.belief(t)

    def learnt(self) -> Learnt:
        """The constants and landmarks that are estimated."""
        return super().learnt() if self._ahead is None else self._ahead.learnt()

    def trajectory(self) -> Trajectory:
        """The optimum at the stamps of the ticks, from the start on; empty if there was none."""
        return super().trajectory() if self._ahead is None else self._ahead.trajectory()

    def final_diagnostics(self) -> Diagnostics:
        """The diagnostics, and what the final trajectory adds to them."""
        return super().final_diagnostics() if self._ahead is None else self._ahead.final_diagnostics()

    def _final(self) -> tuple[Array, Array]:
        """The optimum over the whole log."""
        return self._optimum(self._constant_priors()[0] | self._guesses)

    def _begin(self, first: Keyframe) -> None:
        self._refine(first, (self._pose, self._covariance))

    def _begin_again(self, newest: Keyframe) -> None:
        kept = {k.key for k in self._keyframes}
        self._guesses = {key: value for key, value in self._guesses.items() if key in kept or key in self._constants}
        self._refine(newest, (self._pose, self._covariance))

    def _guess_of(self, keyframe: int) -> Guess:
        key = pose_key(keyframe)
        return self._guesses[key], self._guess_spreads[key]

    def _current(self, key: int) -> Array:
        return self._guesses[key]

    def _extend(self, keyframe: Keyframe, addition: Addition, spread: Array) -> None:
        self._guesses |= addition.values
        self._pose, self._covariance = addition.values[keyframe.key], spread
        self._guess_spreads[keyframe.key] = spread

    def _refine(self, newest: Keyframe, guess: Guess) -> None:
        self._guesses[newest.key], self._guess_spreads[newest.key] = guess

    def _attach(self, keyframe: Keyframe, addition: Addition, guess: Guess | None) -> None:
        self._guesses |= addition.values
        if guess is not None:
            self._pose, self._covariance = guess
            self._refine(keyframe, guess)
