"""Batch estimation in space: all poses at once, at the end. Causal estimates are those of the filter that provides initial values;
they are not the batch's, and never ``localized``."""

from dataclasses import replace

from factorgraph_loc.model.belief import PoseEstimate, PosePrior
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.model.trajectory3 import Trajectory3
from factorgraph_loc.sensors.camera.sensor import Pixels
from factorgraph_loc.slam.monoslam import Monoslam
from factorgraph_loc.slam.monoslam_sighting import Match
from factorgraph_loc.slam.monoslam_state import Eye, SlamState
from factorgraph_loc.slam.space_graph import SpaceGraphSettings, SpaceProblem, known_start, of_space, start_in_space

NAME = "space_batch"


class SpaceBatchSettings(SpaceGraphSettings):
    """Settings of the filter that provides initial values; ``landmarks`` must be ``known``, and ``planar`` off."""


class SpaceBatch(Monoslam):
    """Robust optimum over the whole log in space, for a camera that is carried by hand. See the module."""

    estimates_points = False
    starts_in_space = True
    causal = False

    def __init__(self, setup: Setup, settings: SpaceBatchSettings) -> None:
        super().__init__(setup, of_space(NAME, settings))
        self._problem = SpaceProblem(NAME, setup, settings)

    def initialize(self, prior: PosePrior) -> None:
        """Start from a pose in space. Raises InputError for a planar pose."""
        super().initialize(start_in_space(NAME, prior))
        self._problem.first = known_start(prior.t, self._state)

    def process(self, measurement: Measurement) -> None:
        """Process one measurement, in order or late by at most ``max_delay``."""
        self._problem.take(measurement)
        super().process(measurement)

    def estimate(self, t: float | None = None) -> PoseEstimate:
        """The filter's estimate, which is not to be scored: the problem is solved at the end only."""
        return replace(super().estimate(t), status="unlocalized")

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
        self._problem.first = None if state is None else known_start(m.t, state)
        return state

    def _matched(self, m: Pixels, match: Match, eye: Eye) -> None:
        self._problem.see(m, match, eye)
