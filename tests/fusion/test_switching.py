"""The paper's rule: who has the word, what is handed over, and what is made of it afterwards."""

from dataclasses import replace

import numpy as np
import pytest
from by_hand import made, scan

from factorgraph_loc import Tick, YawRate
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.belief import PosePrior
from factorgraph_loc.simulation import preset
from factorgraph_loc.simulation import simulate as simulate_office

BOTH = ("odometry", "rfid", "bearing_range")
SIGHT, TAGS = ("odometry", "bearing_range"), ("odometry", "rfid")


@pytest.fixture(scope="module")
def office():
    """A minute in an office with few tags, which are read now and then, and landmarks."""
    changes = {"world": {"tags": 5, "landmarks": 30}, "drive": {"duration": 60}}
    return simulate_office(preset("office", changes), 3)


def switching(log, sensors=BOTH):
    return made("switching", log.rig, log.world, sensors)


def heard(t, *tags):
    """A scan of the first antenna of the office's rig."""
    return scan(t, *tags, antennas=("1",))


def test_without_scans_it_is_the_ekf(office):
    plain = {"self_calibration": False}
    alone = run(office, RunConfig("ekf", plain, sensors=SIGHT))
    switched = run(office, RunConfig("switching", {}, sensors=SIGHT))
    np.testing.assert_allclose(switched.poses, alone.poses, atol=1e-12)
    # smoothed apart from each other, by the same equations
    assert np.abs(switched.final.poses[:, :2] - alone.final.poses[:, :2]).max() < 1e-3
    np.testing.assert_allclose(switched.final.covariances, alone.final.covariances, rtol=0.05, atol=1e-6)


def test_it_hands_over_mean_and_covariance(office):
    estimator = switching(office)
    tag = next(iter(office.world.tags))
    start = PosePrior(0.0, office.reference.poses[0], np.diag((0.1, 0.2, 0.05)) ** 2)
    estimator.initialize(start)
    estimator.process(Tick(0.0))
    before = estimator.estimate()
    estimator.process(heard(0.0))  # nothing was read: the EKF goes on
    after = estimator.estimate()
    np.testing.assert_allclose(after.pose, before.pose, atol=1e-12)
    np.testing.assert_allclose(after.covariance, before.covariance, atol=1e-6)
    assert estimator.belief().particles is None
    estimator.process(heard(0.1, tag))
    assert estimator.belief().particles is not None
    estimator.process(heard(0.2, "not in the map"))
    assert estimator.belief().particles is None


def test_rows_that_neither_filter_uses_are_counted_once(office):
    estimator = switching(office)
    estimator.initialize(PosePrior(0.0, office.reference.poses[0], np.eye(3)))
    estimator.process(YawRate(0.1, 0.2))
    assert estimator.diagnostics.ignored == {"yaw rate": 1}


def test_an_unknown_start_needs_tags(office):
    assert switching(office, BOTH).supports_unknown_start
    assert not switching(office, SIGHT).supports_unknown_start


def test_what_one_filter_takes_back_the_other_keeps(office):
    # a landmark that comes late, after the word went to and fro, takes none of the scans' innovations away
    estimator = switching(office)
    read = next(m for m in office.measurements(("rfid",)) if m.tags)
    landmark = next(iter(office.measurements(("bearing_range",))))
    start = PosePrior(0.0, office.reference.poses[0], np.diag((0.1, 0.2, 0.05)) ** 2)
    estimator.initialize(start)
    estimator.process(heard(0.0))
    estimator.process(Tick(0.0))
    estimator.process(replace(read, t=0.1))
    estimator.process(heard(0.2))
    innovations = list(estimator.diagnostics.nis["rfid"])
    for t in (0.3, 0.25):
        estimator.process(replace(landmark, t=t))
    assert len(estimator.diagnostics.nis["bearing_range"]) == 2
    assert estimator.diagnostics.nis["rfid"] == innovations
