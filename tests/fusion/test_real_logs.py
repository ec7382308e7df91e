"""Accuracy on a recorded log that must not get lost."""

import pytest

from factorgraph_loc import load
from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.run import RunConfig, run


def test_plaza2_is_as_accurate_as_the_reference_implementation():
    """0.333 m, 0.028 rad causal for an EKF; 0.259 m, 0.017 rad final for iSAM2; within 10 %."""
    (plaza2,) = load("plaza2")
    ekf, smoother, batch = (score(run(plaza2, RunConfig(name)), plaza2) for name in ("ekf", "smoother", "batch"))
    assert ekf["causal.position_rmse"] < 1.1 * 0.333
    assert ekf["causal.heading_rmse"] < 1.1 * 0.028
    assert smoother["final.position_rmse"] < 1.1 * 0.259
    assert smoother["final.heading_rmse"] < 1.1 * 0.017
    assert smoother["final.position_rmse"] == pytest.approx(batch["final.position_rmse"], rel=0.02)
