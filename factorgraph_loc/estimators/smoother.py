"""The main estimator: one factor graph over the run, kept solved by iSAM2 (Kaess et al., IJRR 31(2), 2012).

By default the whole history stays in the graph; with ``lag`` poses older than that are marginalised out, each with the estimate
that it left the window with. GTSAM's solvers are lost after any exception in an update, so everything that is in the
graph is also kept here, and the solver is rebuilt from it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated

import gtsam
import numpy as np
from pydantic import Field

from factorgraph_loc.errors import RunFailedError
from factorgraph_loc.estimators.keyframes import GraphEstimator, GraphSettings, Keyframe
from factorgraph_loc.estimators.problem import PARAMETERS_KEY
from factorgraph_loc.estimators.registry import Setup
from factorgraph_loc.estimators.solvers import MARGIN, FullHistory, Node, Solver, Window
from factorgraph_loc.trajectory import Trajectory
from factors import se2
from factors.bearing_range import BearingRangeFactor
from factors.odometry import OdometryFactor, between_factor
from factors.se2 import Array


class SmootherSettings(GraphSettings):
    """``lag`` [s]: length of the window, none for the full history. ``relinearize_*``: how far a variable may move (m and rad;
    for the odometry's constants in their units) before its factors are linearised anew, and after how many updates that is
    checked. ``smooth`` off: the final trajectory repeats the causal one."""

    lag: Annotated[float, Field(gt=0.0, le=3600.0)] | None = None
    relinearize_threshold: Annotated[float, Field(gt=0.0, le=1.0)] = 0.05
    relinearize_skip: Annotated[int, Field(ge=1, le=100)] = 10
    smooth: bool = True


class Smoother(GraphEstimator):
    """The iSAM2 smoother; see the module."""

    def __init__(self, setup: Setup, settings: SmootherSettings) -> None:
        super().__init__(setup, settings)
        self._settings = settings
        self._failed: list[str] = []
        self._solver = self._new_solver()
        # of each keyframe: its causal estimate, and the final one where it has left the window
        self._filtered: list[tuple[Array, Array]] = []
        self._left: list[tuple[Array, Array]] = []

    def trajectory(self) -> Trajectory:
        """Full history: the solution of the whole graph. With a window: each pose as it left the window."""
        if not self._settings.smooth:
            estimates = self._filtered
        elif isinstance(self._solver, FullHistory):
            self._solver.converge()
            poses = np.array([self._solver.pose(k.key) for k in self._keyframes])
            self._read(self._keyframes[-1])
            covariances, self._parameter_covariance = self._problem().covariances(poses, self._parameters)
            return self._between(poses, covariances)
        else:
            estimates = self._left + [self._marginal(k) for k in self._keyframes[len(self._left) :]]
        return self._between(np.array([p for p, _ in estimates]), np.array([c for _, c in estimates]))

    def _begin(self, first: Keyframe) -> None:
        self._filtered.append((self._pose, self._covariance))
        self._start_again(first)

    def _extend(self, keyframe: Keyframe, guess: Array, spread: Array) -> None:
        self._filtered.append((guess, spread))
        self._leave(keyframe.t)
        nodes = [self._odometry_node(keyframe), *(self._landmark_node(keyframe, f) for f in keyframe.factors)]
        self._update(nodes, {keyframe.key: guess})

    def _attach(self, keyframe: Keyframe, factor: BearingRangeFactor) -> None:
        if keyframe.index < len(self._left):
            self.diagnostics.drop_late("bearing_range", len(factor.points))
        else:
            self._update([self._landmark_node(keyframe, factor)], {})

    def _update(self, nodes: Sequence[Node], poses: Mapping[int, Array]) -> None:
        newest = self._keyframes[-1]
        try:
            self._solver.update(nodes, poses, None, newest.t)
            self._read(newest)
        except RuntimeError as error:
            self.diagnostics.events.append((newest.t, f"solver rebuilt: {str(error).strip().splitlines()[0]}"))
            self._rebuild(newest)
        while self._failed:
            self.diagnostics.reject(f"factor: {self._failed.pop()}")

    def _read(self, newest: Keyframe) -> None:
        """Bring the newest pose, its covariance and the constants up to date."""
        self._pose, self._covariance = self._marginal(newest)
        self._filtered[newest.index] = (self._pose, self._covariance)
        if len(self._parameters):
            self._parameters = self._solver.parameters()
            self._parameter_covariance = self._solver.covariance(PARAMETERS_KEY)

    def _marginal(self, keyframe: Keyframe) -> tuple[Array, Array]:
        pose, covariance = self._solver.pose(keyframe.key), self._solver.covariance(keyframe.key)
        if not np.all(np.isfinite(pose)) or not np.all(np.isfinite(covariance)):
            raise RuntimeError("the solution is not finite")
        return pose, covariance

    def _leave(self, now: float) -> None:
        """Keep the estimates of the keyframes older than the lag, before the next update marginalises the oldest out."""
        if not isinstance(self._solver, Window) or self._settings.lag is None:
            return
        lag, count = self._settings.lag, len(self._left)
        if self._keyframes[count].t >= now - lag - MARGIN:
            return
        end = count
        while self._keyframes[end].t < now - lag:
            end += 1
        leaving = self._keyframes[count:end]
        try:
            covariances = self._solver.covariances([k.key for k in leaving])
            self._left += [(self._solver.pose(k.key), c) for k, c in zip(leaving, covariances, strict=True)]
        except RuntimeError:
            self._left += [self._filtered[k.index] for k in leaving]

    def _rebuild(self, newest: Keyframe) -> None:
        try:
            self._start_again(newest)
        except RuntimeError as error:
            if not newest.factors:
                raise RunFailedError(f"the graph cannot be solved at {newest.t:.3f} s: {error}") from error
            self.diagnostics.reject("bearing_range: the graph cannot be solved with it", len(newest.factors))
            newest.factors.clear()
            self._rebuild(newest)

    def _start_again(self, newest: Keyframe) -> None:
        """A new solver with what is in the graph.

        The oldest keyframe of a window carries its causal estimate as prior, which its own factors are part of.
        """
        self._solver = self._new_solver()
        oldest, *others = self._keyframes[len(self._left) :]
        pose, spread = self._filtered[oldest.index]
        nodes: list[Node] = []
        if oldest.index == 0:
            assert self._prior is not None
            pose, spread = np.asarray(self._prior.pose), se2.world_to_body(self._prior.pose, self._prior.covariance)
            nodes += [self._landmark_node(oldest, f) for f in oldest.factors]
        nodes += self._prior_nodes(oldest, pose, spread)
        for keyframe in others:
            nodes.append(self._odometry_node(keyframe))
            nodes += [self._landmark_node(keyframe, f) for f in keyframe.factors]
        guesses = {k.key: self._filtered[k.index][0] for k in (oldest, *others)}
        self._solver.update(nodes, guesses, self._parameters if len(self._parameters) else None, newest.t)
        self._read(newest)

    def _prior_nodes(self, keyframe: Keyframe, pose: Array, covariance: Array) -> list[Node]:
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        prior = gtsam.PriorFactorPose2(keyframe.key, gtsam.Pose2(*pose), noise)
        nodes = [Node((keyframe.key,), native=prior)]
        if len(self._parameters):
            noise = gtsam.noiseModel.Gaussian.Covariance(self._parameter_covariance)
            constants = gtsam.PriorFactorVector(PARAMETERS_KEY, self._parameters, noise)
            nodes.append(Node((PARAMETERS_KEY,), native=constants))
        return nodes

    def _odometry_node(self, keyframe: Keyframe) -> Node:
        increment, before = keyframe.from_previous, self._keyframes[keyframe.index - 1].key
        assert increment is not None
        if not len(self._parameters):
            return Node((before, keyframe.key), native=between_factor(before, keyframe.key, increment))
        factor = OdometryFactor(increment, self._estimated.indices)
        return Node((before, keyframe.key, PARAMETERS_KEY), factor=factor, rows=3)

    def _landmark_node(self, keyframe: Keyframe, factor: BearingRangeFactor) -> Node:
        return Node((keyframe.key,), factor=factor, rows=2 * len(factor.points))

    def _new_solver(self) -> Solver:
        parameters = gtsam.ISAM2Params()
        parameters.setFactorization("QR")  # Cholesky loses long stretches of dead reckoning as indeterminate
        parameters.setRelinearizeThreshold(self._settings.relinearize_threshold)
        parameters.relinearizeSkip = self._settings.relinearize_skip
        if self._settings.lag is None:
            return FullHistory(parameters)
        parameters.findUnusedFactorSlots = True
        return Window(parameters, self._settings.lag, self._failed.append)
