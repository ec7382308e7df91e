"""The main estimator: one factor graph over the run, kept solved by iSAM2.

By default the whole history stays in the graph; with ``lag`` poses older than that are marginalised out, each with the estimate
that it left the window with.
"""

from __future__ import annotations

from factorgraph_loc.fusion.graph import Graph
from factorgraph_loc.fusion.graph_estimator import GraphEstimator
from factorgraph_loc.fusion.graph_parts import SmootherSettings
from factorgraph_loc.fusion.incremental import Incremental
from factorgraph_loc.model.setup import Setup


class Smoother(GraphEstimator):
    """The iSAM2 smoother; see the module."""

    def __init__(self, setup: Setup, settings: SmootherSettings) -> None:
        self._settings = settings
        super().__init__(setup, settings)

    def _new_backend(self, graph: Graph) -> Incremental:
        self._incremental = Incremental(graph, self._settings)
        return self._incremental

    def forget(self, before: float) -> None:
        """Forget the trajectory before then, as far as it has left the window; a full history keeps all."""
        self._incremental.forget(min(before, self._graph.t - self._settings.max_delay))
