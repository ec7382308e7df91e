"""What the solvers make of a robot whose odometry constants are estimated, where nothing but its start ties it to the world."""

from dataclasses import replace

import numpy as np
import pytest

from factorgraph_loc.estimators.solvers import FullHistory, read_all
from factorgraph_loc.estimators.variables import pose_key
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.rig import OdometryUncertainty

START = "0,0,0"  # its standard deviations are 0.05 m, 0.05 m, 0.05 rad
SIGMA = 0.05


@pytest.fixture(scope="module")
def log(simulate):
    """The wheels report 7 % too little, and turns of 0.04 rad/s that there are not."""
    made = simulate(seed=1, seconds=20.0)
    wheels = made.streams["odometry"]
    odometry = made.rig.odometry.model_copy(
        update={"uncertainty": OdometryUncertainty(scale_distance=0.1, heading_rate_bias=0.05)}
    )
    wrong = replace(wheels, v=wheels.v / 1.08, w=wheels.w + 0.04)
    return replace(
        made,
        rig=made.rig.model_copy(update={"odometry": odometry}),
        streams={**made.streams, "odometry": wrong},
    )


def test_nothing_is_learnt_of_a_start_that_nothing_measures(log):
    """The covariance of the first pose stays that of the prior, however often the graph is linearised anew."""
    sigmas = []

    def watch(_, estimator):
        sigmas.append(np.sqrt(np.diag(estimator._solver.covariance(pose_key(0)))))

    run(log, RunConfig("smoother", {"landmarks": "unknown"}, prior=START), watch=watch)
    assert np.allclose(sigmas, SIGMA, rtol=1e-4)


@pytest.mark.parametrize("skip", [1, 10])
def test_our_factors_are_linearised_where_isam2_linearises(skip, log):
    moved = set()

    def watch(_, estimator):
        solver = estimator._solver
        assert isinstance(solver, FullHistory)
        at = read_all(solver._isam.getLinearizationPoint(), solver._keys)
        for key, value in solver._at.items():
            assert np.allclose(at[key], value, atol=1e-12)
            if not np.array_equal(value, first.setdefault(key, value)):
                moved.add(key)

    first = {}
    settings = {"landmarks": "unknown", "relinearize_threshold": 0.02, "relinearize_skip": skip}
    run(log, RunConfig("smoother", settings, prior=START), watch=watch)
    assert len(moved) > 5
