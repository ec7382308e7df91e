"""What is said of the estimators is what they do."""

import numpy as np
import pytest

from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion.registry import describe
from factorgraph_loc.plugins import ESTIMATORS

BY_LANDMARKS = [name for name in ESTIMATORS if name != "monoslam"]  # which uses a camera, and the log has none


@pytest.mark.parametrize("name", BY_LANDMARKS)
def test_causal_and_smoothed_are_what_a_run_gives(name, log):
    found = describe(name)
    result = run(log, RunConfig(name))
    causal = result.causal()
    assert (causal is not None) == found.causal
    if causal is not None:
        final = result.final.covariances[-len(causal) :]
        assert np.allclose(causal.covariances, final, rtol=1e-6, atol=0.0) != found.smoothed


def test_sensors_are_those_that_are_not_ignored(log):
    for name in ESTIMATORS:
        ignored = run(log, RunConfig(name)).diagnostics.ignored
        assert ("bearing_range" in ignored) == ("bearing_range" not in describe(name).sensors)
