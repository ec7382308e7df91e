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
from factorgraph_loc.estimators.keyframes import ITERATIONS_OF_GUESS, GraphEstimator, GraphSettings, Keyframe
from factorgraph_loc.estimators.landmarks import robust_update
from factorgraph_loc.estimators.registry import Setup
from factorgraph_loc.trajectory import Trajectory
from factors import se2
from factors.bearing_range import BearingRangeFactor
from factors.se2 import Array

ITERATIONS_PER_WIDTH = 5


class BatchSettings(GraphSettings):
    """``widest_loss``: how many times wider than its own scale the robust loss begins; 1 for a plain robust start."""

    widest_loss: Annotated[float, Field(ge=1.0, le=1000.0)] = 8.0


class Batch(GraphEstimator):
    """The batch estimator; see the module."""

    def __init__(self, setup: Setup, settings: BatchSettings) -> None:
        super().__init__(setup, settings)
        self._widest = settings.widest_loss
        self._guesses: list[Array] = []

    def estimate(self) -> PoseEstimate:
        """The guess so far: not an estimate to be scored, as the problem is only solved at the end."""
        return replace(super().estimate(), status="unlocalized")

    def trajectory(self) -> Trajectory:
        """The optimum over the whole log."""
        problem = self._problem()
        start = np.array(self._guesses), np.zeros(len(self._estimated.indices))
        best = problem.solve(*start)
        width = self._widest
        if width > 1.0:
            poses, parameters = start
            while width > 1.0:
                wide = self._problem(width).solve(poses, parameters, ITERATIONS_PER_WIDTH)
                poses, parameters, width = wide.poses, wide.parameters, width / 2.0
            # either way may end in the worse optimum
            best = min(best, problem.solve(poses, parameters), key=lambda s: s.cost)
        self._parameters = best.parameters
        covariances, self._parameter_covariance = problem.covariances(best.poses, best.parameters)
        return self._between(best.poses, covariances)

    def _begin(self, first: Keyframe) -> None:
        self._guesses.append(self._pose)

    def _extend(self, keyframe: Keyframe, guess: Array, spread: Array) -> None:
        self._pose, self._covariance = guess, spread
        self._guesses.append(guess)

    def _attach(self, keyframe: Keyframe, factor: BearingRangeFactor) -> None:
        if keyframe.index == len(self._guesses) - 1:
            update = robust_update(factor, self._pose, self._covariance, ITERATIONS_OF_GUESS)
            self._pose, self._covariance = se2.compose(self._pose, se2.exp(update.delta)), update.covariance
            self._guesses[-1] = self._pose
