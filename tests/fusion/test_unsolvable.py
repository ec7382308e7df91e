"""A graph that cannot be solved for a while goes on as a filter."""

import numpy as np
import pytest
from landmark_world import simulate

from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion.graph.isam import Incremental


@pytest.fixture(scope="module")
def log():
    return simulate(seconds=6.0, rate=3.0)


@pytest.mark.parametrize("lag", [None, 2.0])
def test_a_graph_that_cannot_be_solved_for_a_while_goes_on_as_a_filter(lag, log, monkeypatch):
    config = RunConfig("smoother", {} if lag is None else {"lag": lag})
    expected, marginal = run(log, config), Incremental._marginal

    def failing(self, key, *known, **where):
        if 2.0 < self._graph.t < 3.5:
            raise RuntimeError("\n")
        return marginal(self, key, *known, **where)

    monkeypatch.setattr(Incremental, "_marginal", failing)
    result = run(log, config)
    assert [what for _, what in result.diagnostics.events if what.startswith("goes on without a solver until")]
    assert set(result.status) == {"localized"}
    assert np.abs(result.poses - expected.poses)[:, :2].max() < 0.2
    assert np.abs(result.poses[-1] - expected.poses[-1])[:2].max() < 0.05
    assert np.abs(result.final.poses - expected.final.poses)[:, :2].max() < 0.2
