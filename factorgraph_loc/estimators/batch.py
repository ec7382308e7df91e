"""The offline optimum: the whole log in one robust least-squares problem, solved when all is known.

While measurements come it only keeps a guess, as an EKF would; its result is the final trajectory, and its causal estimates
are never ``localized``. A start far from the optimum is met by graduated non-convexity: the robust loss begins
wide and narrows to its own scale (Yang, Antonante, Tzoumas, Carlone, RA-L 5(2), 2020, here for the Geman-McClure loss).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import Field

from factorgraph_loc.estimators.base import PoseEstimate
from factorgraph_loc.estimators.graph_parts import Addition, GraphSettings, Guess, Keyframe
from factorgraph_loc.estimators.registry import Setup
from factorgraph_loc.estimators.relocating import RelocatingGraph
from factorgraph_loc.estimators.variables import Values, pose_key
from factors.se2 import Array

ITERATIONS_PER_WIDTH = 5


class BatchSettings(GraphSettings):
    """``widest_loss``: how many times wider than its own scale the robust loss begins; 1 for a plain robust start."""

    widest_loss: Annotated[float, Field(ge=1.0, le=1000.0)] = 8.0


class Batch(RelocatingGraph):
    """The batch estimator; see the module."""

    def __init__(self, setup: Setup, settings: BatchSettings) -> None:
        super().__init__(setup, settings)
        self._widest = settings.widest_loss
        self._guesses: Values = {}

    def estimate(self) -> PoseEstimate:
        """The guess so far: not an estimate to be scored, as the problem is only solved at the end."""
        guess = super().estimate()
        return guess if self._prior is None else replace(guess, status="unlocalized")

    def _final(self) -> tuple[Array, Array]:
        """The optimum over the whole log."""
        problem = self._problem()
        start = self._constant_priors()[0] | self._guesses
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

    def _begin(self, first: Keyframe) -> None:
        self._guesses[first.key] = self._pose

    def _begin_again(self, newest: Keyframe) -> None:
        kept = {k.key for k in self._keyframes}
        self._guesses = {key: value for key, value in self._guesses.items() if key in kept or key in self._constants}
        self._guesses[newest.key] = self._pose

    def _pose_of(self, keyframe: int) -> Array:
        return self._guesses[pose_key(keyframe)]

    def _current(self, key: int) -> Array:
        return self._guesses[key]

    def _extend(self, keyframe: Keyframe, addition: Addition, spread: Array) -> None:
        self._pose, self._covariance = addition.values[keyframe.key], spread
        self._guesses |= addition.values

    def _refine(self, newest: Keyframe, guess: Guess) -> None:
        self._guesses[newest.key] = guess[0]

    def _attach(self, keyframe: Keyframe, addition: Addition, guess: Guess | None) -> None:
        self._guesses |= addition.values
        if guess is not None:
            self._pose, self._covariance = guess
            self._guesses[keyframe.key] = self._pose
