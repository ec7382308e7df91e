"""The main estimator: one factor graph over the run, kept solved by iSAM2.

By default the whole history stays in the graph; with ``lag`` poses older than that are marginalised out, each with the estimate
that it left the window with.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from factorgraph_loc.fusion.graph import Graph
from factorgraph_loc.fusion.graph_estimator import GraphEstimator
from factorgraph_loc.fusion.graph_parts import GraphSettings
from factorgraph_loc.fusion.incremental import Incremental, IncrementalSettings
from factorgraph_loc.model.setup import Setup


class SmootherSettings(GraphSettings):
    """``lag`` [s]: length of the window, none for the full history. ``relinearize_*``: how far a variable may move (m and rad;
    for the odometry's constants in their units) before its factors are linearised anew, and after how many updates that is
    checked. ``smooth`` off: the final trajectory repeats the causal one."""

    lag: Annotated[float, Field(ge=0.1, le=3600.0)] | None = None
    relinearize_threshold: Annotated[float, Field(ge=1e-6, le=1.0)] = 0.05
    relinearize_skip: Annotated[int, Field(ge=1, le=100)] = 10
    smooth: bool = True


class Smoother(GraphEstimator):
    """The iSAM2 smoother; see the module."""

    def __init__(self, setup: Setup, settings: SmootherSettings) -> None:
        self._settings = settings
        super().__init__(setup, settings)

    def _new_backend(self, graph: Graph) -> Incremental:
        self._incremental = Incremental(graph, incremental_settings(graph, self._settings))
        return self._incremental

    def forget(self, before: float) -> None:
        """Forget the trajectory before then, as far as it has left the window; a full history keeps all."""
        self._incremental.forget(min(before, self._graph.t - self._settings.max_delay))


def incremental_settings(graph: Graph, settings: SmootherSettings) -> IncrementalSettings:
    """How the solver goes about a graph."""
    # pixels of known points place the robot so well by themselves that the solver need not see each image at once, unless it is to
    # learn from them how the camera is mounted
    every = max((sensor.solve_every for sensor in graph.sensors.values()), default=0.0)
    defers = settings.landmarks == "known" and (settings.lag is None or settings.lag >= 2.0 * every)
    return IncrementalSettings(
        settings.lag,
        settings.smooth,
        settings.relinearize_threshold,
        settings.relinearize_skip,
        waits=settings.landmarks != "known",  # an update takes long then
        solve_every=every if defers else 0.0,
    )
