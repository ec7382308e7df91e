"""A graph that cannot be solved is built anew once; if that fails too, the run ends with an error."""

import numpy as np
import pytest
from landmark_world import simulate

from factorgraph_loc.errors import RunFailedError
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion.graph.isam import Incremental


@pytest.fixture(scope="module")
def log():
    return simulate(seconds=6.0, rate=3.0)


def failing_from(t, times, monkeypatch):
    """The marginals of a smoother fail from ``t`` on so many times."""
    marginal, failures = Incremental._marginal, []

    def failing(self, key, *known, **where):
        if self._graph.t >= t and len(failures) < times:
            failures.append(key)
            raise RuntimeError("made to fail")
        return marginal(self, key, *known, **where)

    monkeypatch.setattr(Incremental, "_marginal", failing)


@pytest.mark.parametrize("lag", [None, 2.0, "all"])
def test_a_solver_that_fails_is_built_anew(lag, log, monkeypatch):
    config = RunConfig("smoother", {"lag": lag})
    expected = run(log, config)
    failing_from(3.0, 1, monkeypatch)
    result = run(log, config)
    assert [what for _, what in result.diagnostics.events] == ["solver rebuilt: made to fail"]
    assert set(result.status) == {"localized"}
    assert np.abs(result.poses - expected.poses)[:, :2].max() < 0.02
    assert np.abs(result.final.poses - expected.final.poses)[:, :2].max() < 0.02


@pytest.mark.parametrize("lag", [None, 2.0])
def test_a_solver_that_fails_twice_ends_the_run(lag, log, monkeypatch):
    failing_from(3.0, 2, monkeypatch)
    with pytest.raises(RunFailedError, match=r"the graph cannot be solved at 3\.\d+ s: made to fail"):
        run(log, RunConfig("smoother", {"lag": lag}))
