"""What a run keeps grows with the length of its log, and by how much is stated in the docs: so that of hours fits a computer."""

import tracemalloc

import pytest
from landmark_world import simulate

from factorgraph_loc.experiments.run import RunConfig, run


def peak(log, config):
    tracemalloc.start()
    run(log, config)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return most


@pytest.mark.parametrize(
    ("config", "most"),
    [(RunConfig("dead_reckoning"), 100e6), (RunConfig("ekf"), 200e6), (RunConfig("smoother", {"lag": 5.0}), 250e6)],
    ids=["dead_reckoning", "ekf", "smoother in a window"],
)
def test_an_hour_of_log_takes_no_more_than_is_stated(config, most):
    short, long = (simulate(seconds=seconds, rate=2.0) for seconds in (20.0, 60.0))
    run(short, config)  # what is compiled, imported and cached once
    grown = peak(long, config) - peak(short, config)
    assert 0 < grown / 40.0 * 3600.0 < most
