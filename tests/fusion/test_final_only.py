"""Runs of which only the final trajectory is wanted: what they give, and what they do without."""

import numpy as np
import pytest
from landmark_world import simulate

from factorgraph_loc.errors import InputError
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion.graph.isam import Incremental
from factorgraph_loc.fusion.registry import for_final_only, settings_of


@pytest.fixture(scope="module")
def log():
    return simulate(seconds=15.0)


def test_the_final_trajectory_is_that_of_a_run_with_causal_estimates(log, monkeypatch):
    whole = run(log, RunConfig("smoother"))
    monkeypatch.setattr(Incremental, "__init__", None)  # nothing is solved on the way
    found = run(log, RunConfig("smoother", {"final_only": True}))
    np.testing.assert_allclose(found.final.poses, whole.final.poses, atol=1e-3)
    np.testing.assert_allclose(found.final.covariances, whole.final.covariances, rtol=0.05, atol=1e-6)
    assert whole.causal() is not None
    assert found.causal() is None
    assert found.learnt.values.keys() == whole.learnt.values.keys()


@pytest.mark.parametrize("other", [{"lag": 10.0}, {"smooth": False}])
def test_a_final_trajectory_that_needs_causal_estimates_is_refused(other):
    with pytest.raises(InputError, match=r"final_only is true, but (lag is 10|smooth is false)"):
        settings_of("smoother", {"final_only": True} | other)
    assert settings_of("smoother", {"final_only": True, "lag": "all"})


def test_those_that_can_do_without_causal_estimates_are_told_to():
    given = {"ekf": {}, "smoother": {"self_calibration": False}}
    assert for_final_only(given) == {"ekf": {}, "smoother": {"self_calibration": False, "final_only": True}}
    assert for_final_only({"batch": {}}) == {"batch": {}}
    with pytest.raises(InputError, match="--final-only changes nothing for ekf, expected smoother"):
        for_final_only({"ekf": {}})
