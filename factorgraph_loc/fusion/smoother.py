"""The main estimator: one factor graph over the run, kept solved by iSAM2.

By default causal estimates come from a window, from which poses older than 10 s are marginalised out, and the whole problem is
solved at the end. With ``lag = "all"`` the whole history stays in iSAM2; with a number of seconds each pose keeps the estimate
that it left the window with. Where landmarks or points are estimated, which loops may close at any time, the default is the whole
history.
"""

from __future__ import annotations

from factorgraph_loc.fusion.graph import Graph
from factorgraph_loc.fusion.graph_estimator import GraphEstimator
from factorgraph_loc.fusion.graph_parts import SmootherSettings
from factorgraph_loc.fusion.incremental import Incremental
from factorgraph_loc.model.setup import Setup


class Smoother(GraphEstimator):
    """Incremental factor graph (iSAM2): a window and the whole problem at the end, a fixed lag, or the full history. See above."""

    def __init__(self, setup: Setup, settings: SmootherSettings) -> None:
        self._settings = settings
        super().__init__(setup, settings)

    def _new_backend(self, graph: Graph) -> Incremental:
        self._incremental = Incremental(graph, self._settings)
        return self._incremental

    def forget(self, before: float) -> None:
        """Forget the trajectory before then, as far as it has left a window whose ``lag`` is set; else all is kept."""
        self._incremental.forget(min(before, self._graph.t - self._settings.max_delay))
