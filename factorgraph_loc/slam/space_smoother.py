"""The incremental sibling of ``space_batch``: iSAM2 with a window of the last seconds gives causal estimates, and the whole problem
is solved at the end.

The monoSLAM filter runs along: it matches points, and a new pose is linearised first where the filter has it. Its estimates do not
enter those of the window.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import gtsam
from pydantic import Field

from factorgraph_loc.errors import RunFailedError
from factorgraph_loc.files.models import InUnit
from factorgraph_loc.fusion.timeline import Taken
from factorgraph_loc.model.belief import PoseEstimate, PosePrior, SpacePose
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.model.trajectory3 import Trajectory3, planar_estimate
from factorgraph_loc.sensors.camera.sensor import Pixels
from factorgraph_loc.slam.monoslam import Monoslam
from factorgraph_loc.slam.monoslam_past import UpdateRecord
from factorgraph_loc.slam.monoslam_sighting import Match
from factorgraph_loc.slam.monoslam_state import Eye, SlamState
from factorgraph_loc.slam.space_graph import (
    SeenPoints,
    SpaceGraphSettings,
    SpaceProblem,
    known_start,
    of_space,
    start_in_space,
)
from factorgraph_loc.slam.space_motion import POSES
from factorgraph_loc.slam.space_motion_models import AT_ONCE, KnownState, SpaceMotion
from factors.se2 import Array

NAME = "space_smoother"
THRESHOLD = 0.01  # m, rad: how far a pose moves before its factors are linearised again


class SpaceSmootherSettings(SpaceGraphSettings):
    """Settings of the window, and of the filter that matches points; ``landmarks`` must be ``known``, and ``planar`` off."""

    lag: Annotated[float, Field(gt=0.0, le=3600.0), InUnit("s")] = 10.0
    """length of the window that causal estimates come from"""


@dataclass(frozen=True)
class _WindowRecord(UpdateRecord):
    """``known``: what the window knew then."""

    known: KnownState | None = None


class SpaceSmoother(Monoslam):
    """Incremental factor graph (iSAM2) in space: a window, and the whole problem at the end. See the module."""

    estimates_points = False
    starts_in_space = True

    def __init__(self, setup: Setup, settings: SpaceSmootherSettings) -> None:
        super().__init__(setup, of_space(NAME, settings))
        self._problem = SpaceProblem(NAME, setup, settings)
        self._lag = settings.lag
        # begun anew from what is known, after the start and after a late measurement
        self._window: _Window | None = None
        self._known: KnownState | None = None

    def initialize(self, prior: PosePrior) -> None:
        """Start from a pose in space. Raises InputError for a planar pose."""
        super().initialize(start_in_space(NAME, prior))
        self._known = self._problem.first = known_start(prior.t, self._state)
        self._window = None

    def process(self, measurement: Measurement) -> None:
        """Process one measurement, in order or late by at most ``max_delay``."""
        self._problem.take(measurement)
        super().process(measurement)

    def forget(self, before: float) -> None:
        """Forget nothing: the problem is that of the whole log."""

    def space_trajectory(self) -> Trajectory3:
        """The optimum over the whole log, at the ticks."""
        return self._problem.concluded(self._past, self._ticks, self._mounting, self.diagnostics)[0]

    def final_diagnostics(self) -> Diagnostics:
        """The diagnostics, including those of the final trajectory."""
        return self._problem.concluded(self._past, self._ticks, self._mounting, self.diagnostics)[1]

    def _seek(self, m: Pixels) -> SlamState | None:
        state = super()._seek(m)
        self._known = self._problem.first = None if state is None else known_start(m.t, state)
        self._window = None
        return state

    def _matched(self, m: Pixels, match: Match, eye: Eye) -> None:
        self._problem.see(m, match, eye)

    def _see(self, m: Pixels) -> None:
        super()._see(m)
        if self._anew:  # the filter found its place, whatever was before
            self._known, self._window = known_start(m.t, self._state), None
        known, image = self._known, self._problem.images.get((m.t, m.right))
        if image is None or known is None or self._anew or self._vague(self._state):
            return
        if self._window is None:
            self._window = _Window(known, self._problem.motion, self._lag)
        self._known = self._window.add(image, known_start(m.t, self._state))

    def _estimate(self) -> PoseEstimate:
        assert self._known is not None
        now = self._problem.later(self._known, self._t)
        spread = now.covariance[POSES, POSES] + self._mounting
        return planar_estimate(self._t, SpacePose(now.robot.position, now.robot.rotation, spread))

    def _record(self) -> UpdateRecord:
        return _WindowRecord(**vars(super()._record()), known=self._known)

    def _go_back(self, taken: Taken) -> None:
        super()._go_back(taken)
        known = self._records[-1].known if self._records else self._problem.first
        if known is not self._known:
            self._known, self._window = known, None


class _Window:
    """The poses of the images of the last ``lag`` seconds; older ones are marginalised out."""

    def __init__(self, start: KnownState, motion: SpaceMotion, lag: float) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(THRESHOLD)
        parameters.relinearizeSkip = 1
        parameters.setFactorization("QR")  # an inertial unit knows some values a million times better than others
        self._solver = gtsam.IncrementalFixedLagSmoother(lag, parameters)
        self._start, self._motion_model = start, motion
        self._keys, self._times = [0], [start.t]  # of the newest poses
        self._update([motion.prior(0, start)], start)

    def add(self, image: SeenPoints, guess: KnownState) -> KnownState:
        """Add an image, of the newest pose or of a later one, and return what is known of the robot then."""
        if image.t > self._times[-1] + AT_ONCE:
            self._keys, self._times = [*self._keys[-2:], self._keys[-1] + 1], [*self._times[-2:], image.t]
            motion = self._motion_model.factors(self._keys, self._times, self._start)
            self._update([*motion, _factor(image, self._keys[-1])], guess)
        else:
            self._update([_factor(image, self._keys[-1])])
        keys, times = self._keys[-2:], self._times[-2:]
        spread = self._solver.getISAM2().jointMarginalCovariance(self._motion_model.joint(keys)).fullMatrix()
        return self._motion_model.state(self._solver.calculateEstimate(), keys, spread, times, self._start)

    def _update(self, factors: list[gtsam.NonlinearFactor], guess: KnownState | None = None) -> None:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for factor in factors:
            graph.push_back(factor)
        if guess is not None:
            values = self._motion_model.values(self._keys[-1], guess)
        kept = [variable for key in self._keys[-2:] for variable in self._motion_model.sizes(key)]
        try:
            self._solver.update(graph, values, dict.fromkeys(kept, self._times[-1]))
        except RuntimeError as error:
            raise RunFailedError(
                f"{NAME}: the measurements do not determine the pose at {self._times[-1]:.3f} s"
            ) from error


def _factor(image: SeenPoints, key: int) -> gtsam.NonlinearFactor:
    """The points of an image, as a factor that GTSAM linearises where it likes."""

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        residual, jacobian = image.linearize(values.atPose3(key))
        if jacobians is not None:
            jacobians[0] = jacobian
        return residual

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(image.size), [key], error)
