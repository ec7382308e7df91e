"""The main estimator: one factor graph over the run, kept solved by iSAM2 (Kaess et al., IJRR 31(2), 2012).

By default the whole history stays in the graph; with ``lag`` poses older than that are marginalised out, each with the estimate
that it left the window with. GTSAM's solvers are lost after any exception in an update, so everything that is in the
graph is also kept here, and the solver is rebuilt from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, cast

import gtsam
import numpy as np
from pydantic import Field

from factorgraph_loc.errors import RunFailedError
from factorgraph_loc.estimators.keyframes import GraphEstimator, GraphSettings, Keyframe
from factorgraph_loc.estimators.problem import PARAMETERS_KEY
from factorgraph_loc.estimators.registry import Setup
from factorgraph_loc.trajectory import Trajectory
from factors import se2
from factors.bearing_range import BearingRangeFactor
from factors.graph import custom_factor, pose_array, read_pose, read_vector
from factors.odometry import OdometryFactor, between_factor
from factors.se2 import Array

MAX_FINAL_UPDATES = 20
CONVERGED_STEP = 1e-4  # m, rad


class SmootherSettings(GraphSettings):
    """``lag`` [s]: length of the window, none for the full history. ``relinearize_*``: how far a variable may move (m and rad;
    for the odometry's constants in their units) before its factors are linearised anew, and after how many updates that is
    checked. ``smooth`` off: the final trajectory repeats the causal one."""

    lag: Annotated[float, Field(gt=0.0, le=3600.0)] | None = None
    relinearize_threshold: Annotated[float, Field(gt=0.0, le=1.0)] = 0.05
    relinearize_skip: Annotated[int, Field(ge=1, le=100)] = 10
    factorization: Literal["QR", "CHOLESKY"] = "QR"
    smooth: bool = True


class Smoother(GraphEstimator):
    """The iSAM2 smoother; see the module."""

    def __init__(self, setup: Setup, settings: SmootherSettings) -> None:
        super().__init__(setup, settings)
        self._settings = settings
        self._solver = self._new_solver(settings.factorization)
        # of each keyframe: its causal estimate, and the final one where it has left the window
        self._filtered: list[tuple[Array, Array]] = []
        self._left: list[tuple[Array, Array]] = []
        self._failed: list[str] = []

    def trajectory(self) -> Trajectory:
        """Full history: the solution of the whole graph. With a window: each pose as it left the window."""
        if not self._settings.smooth:
            estimates = self._filtered
        elif self._settings.lag is not None:
            estimates = self._left + [self._marginal(k) for k in self._keyframes[len(self._left) :]]
        else:
            poses = self._converge()
            covariances, self._parameter_covariance = self._problem().covariances(poses, self._parameters)
            return self._between(poses, covariances)
        return self._between(np.array([p for p, _ in estimates]), np.array([c for _, c in estimates]))

    def _begin(self, first: Keyframe) -> None:
        self._extend(first, self._pose, self._covariance)

    def _extend(self, keyframe: Keyframe, guess: Array, spread: Array) -> None:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        values.insert(keyframe.key, gtsam.Pose2(*guess))
        if keyframe.index == 0:
            self._add_prior(graph, values, keyframe, self._pose, self._covariance)
        else:
            graph.add(self._odometry_factor(keyframe))
        for factor in keyframe.factors:
            graph.add(self._landmark_factor(keyframe, factor))
        self._filtered.append((guess, spread))
        self._leave(keyframe.t)
        self._update(graph, values, keyframe)

    def _attach(self, keyframe: Keyframe, factor: BearingRangeFactor) -> None:
        if keyframe.index < len(self._left):
            self.diagnostics.drop_late("bearing_range")
            return
        graph = gtsam.NonlinearFactorGraph()
        graph.add(self._landmark_factor(keyframe, factor))
        self._update(graph, gtsam.Values(), self._keyframes[-1])

    def _update(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, newest: Keyframe) -> None:
        try:
            self._advance(graph, values, {newest.key: newest.t} if values.size() else {})
            self._read(newest)
        except RuntimeError as error:
            self.diagnostics.events.append((newest.t, f"solver rebuilt: {str(error).strip().splitlines()[0]}"))
            self._rebuild(newest)
        while self._failed:
            self.diagnostics.reject(f"factor: {self._failed.pop()}")

    def _advance(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, stamps: dict[int, float]) -> None:
        if isinstance(self._solver, gtsam.ISAM2):
            self._solver.update(graph, values)
            return
        if len(self._parameters):
            stamps = {**stamps, PARAMETERS_KEY: self._keyframes[-1].t}  # constants never leave the window
        self._solver.update(graph, values, cast("Mapping[Any, Any]", stamps))

    def _read(self, newest: Keyframe) -> None:
        """Bring the newest pose, its covariance and the constants up to date."""
        self._pose, self._covariance = self._marginal(newest)
        self._filtered[newest.index] = (self._pose, self._covariance)
        if len(self._parameters):
            self._parameters = np.asarray(self._solver.calculateEstimateVector(PARAMETERS_KEY))
            self._parameter_covariance = self._solver.marginalCovariance(PARAMETERS_KEY)

    def _marginal(self, keyframe: Keyframe) -> tuple[Array, Array]:
        pose = pose_array(self._solver.calculateEstimatePose2(keyframe.key))
        covariance = self._solver.marginalCovariance(keyframe.key)
        if not np.all(np.isfinite(pose)) or not np.all(np.isfinite(covariance)):
            raise RuntimeError("the solution is not finite")
        return pose, covariance

    def _leave(self, now: float) -> None:
        """Keep the estimates of the keyframes that the next update marginalises out."""
        if self._settings.lag is None:
            return
        while self._keyframes[len(self._left)].t < now - self._settings.lag:
            keyframe = self._keyframes[len(self._left)]
            try:
                self._left.append(self._marginal(keyframe))
            except RuntimeError:
                self._left.append(self._filtered[keyframe.index])

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
        """A new solver with what is in the graph; the oldest keyframe of the window carries its causal estimate as prior."""
        self._solver = self._new_solver("QR")
        oldest = self._keyframes[len(self._left)]
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        stamps: dict[int, float] = {}
        for keyframe in self._keyframes[oldest.index :]:
            pose, covariance = self._filtered[keyframe.index]
            values.insert(keyframe.key, gtsam.Pose2(*pose))
            stamps[keyframe.key] = keyframe.t
            if keyframe is not oldest:
                graph.add(self._odometry_factor(keyframe))
            elif keyframe.index == 0:
                assert self._prior is not None
                prior = se2.world_to_body(self._prior.pose, self._prior.covariance)
                self._add_prior(graph, values, keyframe, self._prior.pose, prior)
            else:
                self._add_prior(graph, values, keyframe, pose, covariance)
            if keyframe is not oldest or keyframe.index == 0:  # the prior of another oldest one holds its own factors
                for factor in keyframe.factors:
                    graph.add(self._landmark_factor(keyframe, factor))
        self._advance(graph, values, stamps)
        self._read(newest)

    def _converge(self) -> Array:
        """Poses (M, 3) after updates without news, until the solution stands still."""
        poses = self._all_poses()
        nothing = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for _ in range(MAX_FINAL_UPDATES):
            if isinstance(self._solver, gtsam.ISAM2):
                self._solver.update(*nothing, force_relinearize=True)
            before, poses = poses, self._all_poses()
            if np.abs(se2.log(se2.between(before, poses))).max() < CONVERGED_STEP:
                break
        return poses

    def _all_poses(self) -> Array:
        values = self._solver.calculateEstimate()
        return np.array([read_pose(values, k.key) for k in self._keyframes])

    def _add_prior(
        self,
        graph: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        keyframe: Keyframe,
        pose: Array,
        covariance: Array,
    ) -> None:
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        graph.add(gtsam.PriorFactorPose2(keyframe.key, gtsam.Pose2(*pose), noise))
        if len(self._parameters):
            values.insert(PARAMETERS_KEY, self._parameters)
            noise = gtsam.noiseModel.Gaussian.Covariance(self._parameter_covariance)
            graph.add(gtsam.PriorFactorVector(PARAMETERS_KEY, self._parameters, noise))

    def _odometry_factor(self, keyframe: Keyframe) -> gtsam.NonlinearFactor:
        increment, before = keyframe.from_previous, self._keyframes[keyframe.index - 1].key
        assert increment is not None
        if not len(self._parameters):
            return between_factor(before, keyframe.key, increment)
        return custom_factor(
            OdometryFactor(increment, self._estimated.indices),
            (before, keyframe.key, PARAMETERS_KEY),
            (read_pose, read_pose, read_vector),
            (3, 3, len(self._parameters)),
            3,
            self._failed.append,
        )

    def _landmark_factor(self, keyframe: Keyframe, factor: BearingRangeFactor) -> gtsam.NonlinearFactor:
        return custom_factor(factor, (keyframe.key,), (read_pose,), (3,), 2 * len(factor.points), self._failed.append)

    def _new_solver(self, factorization: str) -> gtsam.ISAM2 | gtsam.IncrementalFixedLagSmoother:
        parameters = gtsam.ISAM2Params()
        parameters.setFactorization(factorization)
        parameters.setRelinearizeThreshold(self._settings.relinearize_threshold)
        parameters.relinearizeSkip = self._settings.relinearize_skip
        if self._settings.lag is None:
            return gtsam.ISAM2(parameters)
        parameters.findUnusedFactorSlots = True
        return gtsam.IncrementalFixedLagSmoother(self._settings.lag, parameters)
