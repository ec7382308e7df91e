"""What is said of the estimators is what they do."""

import numpy as np
import pytest

from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion.registry import describe, in_space
from factorgraph_loc.plugins import ESTIMATORS

ON_THE_FLOOR = [name for name in ESTIMATORS if name not in in_space()]


@pytest.mark.parametrize("name", ON_THE_FLOOR)
def test_causal_and_smoothed_are_what_a_run_gives(name, log):
    found = describe(name)
    result = run(log, RunConfig(name))
    causal = result.causal()
    assert (causal is not None) == found.causal
    if causal is not None:
        final = result.final.covariances[-len(causal) :]
        assert np.allclose(causal.covariances, final, rtol=1e-6, atol=0.0) != found.smoothed


def test_sensors_are_those_that_are_not_ignored(log):
    for name in ON_THE_FLOOR:
        ignored = run(log, RunConfig(name)).diagnostics.ignored
        assert ("bearing_range" in ignored) == ("bearing_range" not in describe(name).sensors)
    assert "twist" not in describe("ekf").sensors
    assert {"twist", "sightings_right"} <= set(describe("monoslam").sensors)
