"""The main estimator: one factor graph over the run, kept solved by iSAM2.

By default causal estimates come from a window, from which poses older than 10 s are marginalised out, and the whole problem is
solved at the end. With ``lag = "all"`` the whole history stays in iSAM2; with a number of seconds each pose keeps the estimate
that it left the window with. Where landmarks or points are estimated, which loops may close at any time, the default is the whole
history. With ``final_only`` nothing is solved on the way: the graph is built with a guess, as that of the batch is, and solved at
the end.
"""

from __future__ import annotations

from dataclasses import replace

from factorgraph_loc.fusion.graph.batch import at_the_end
from factorgraph_loc.fusion.graph.estimator import GraphEstimator, SolvingBackend
from factorgraph_loc.fusion.graph.graph import Graph
from factorgraph_loc.fusion.graph.graph_parts import SmootherSettings
from factorgraph_loc.fusion.graph.isam import Incremental
from factorgraph_loc.model.belief import PoseEstimate
from factorgraph_loc.model.setup import Setup


class Smoother(GraphEstimator):
    """Incremental factor graph (iSAM2): a window and the whole problem at the end, a fixed lag, or the full history. See above."""

    def __init__(self, setup: Setup, settings: SmootherSettings) -> None:
        self._settings = settings
        super().__init__(setup, settings)

    def _new_backend(self, graph: Graph) -> SolvingBackend:
        return at_the_end(graph, self._settings) if self._settings.final_only else Incremental(graph, self._settings)

    def estimate(self, t: float | None = None) -> PoseEstimate:
        """The newest keyframe, moved along the odometry; with ``final_only`` a guess that is not to be scored."""
        found = super().estimate(t)
        if self._settings.final_only and self._graph.prior is not None:
            return replace(found, status="unlocalized")
        return found

    def forget(self, before: float) -> None:
        """Forget the trajectory before then, as far as it has left a window whose ``lag`` is set; else all is kept."""
        if isinstance(self._backend, Incremental):
            self._backend.forget(min(before, self._taken_until - self._settings.max_delay))
