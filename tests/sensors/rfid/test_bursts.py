"""Reads and misses that come in bursts: estimators find out and temper their likelihood."""

import numpy as np
import pytest

from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.sensors.rfid.monitor import BurstMonitor
from factorgraph_loc.simulation import preset, simulate
from factors.rfid.detection import ExpectedReads, TagReadCounts

ANTENNAS, TAGS, STEP = 4, 60, 0.5
ALL = np.ones(TAGS, dtype=bool)
BURSTS = {"faults": {"fading": {"duration": 5.0, "share": 0.4}}}


def reads(looks, p):
    return ExpectedReads(looks.tags, looks.hits, p, np.zeros(p.shape))


def scans(seed, count, stays=0.0, share=0.6):
    """A monitor after scans of pairs of which a ``share`` is in reach, and is read half of the time. ``stays``: how often a
    pair does as in the scan before."""
    rng = np.random.default_rng(seed)
    monitor = BurstMonitor(ANTENNAS, TAGS)
    hits = rng.random((ANTENNAS, TAGS)) < 0.5
    reached = rng.random((ANTENNAS, TAGS)) < share
    for i in range(count):
        hits = np.where(rng.random(hits.shape) < stays, hits, rng.random(hits.shape) < 0.5)
        looks = TagReadCounts(
            np.zeros((ANTENNAS, 3)), np.arange(ANTENNAS), np.ones(ANTENNAS, int), (hits & reached).astype(int)
        )
        monitor.add(STEP * i, looks, reads(looks, np.where(reached, 0.5, 1e-3)), ALL)
        if not stays:
            assert monitor.overdispersion == 1.0
    return monitor


@pytest.mark.parametrize("seed", range(3))
def test_independent_reads_stay_independent(seed):
    # some 144 pairs in each block: the ratio has a standard deviation of 0.1 after the first of them, and less later
    assert scans(seed, 400).overdispersion == 1.0


@pytest.mark.parametrize("stays", [0.5, 0.8])
def test_rounds_that_go_together_are_counted_as_fewer(stays):
    # the variance of a sum of 20 rounds of such a chain, over that of independent ones
    n = 20
    expected = 1.0 + 2.0 * sum((1.0 - k / n) * stays**k for k in range(1, n))
    assert scans(5, 2000, stays).overdispersion == pytest.approx(expected, rel=0.1)


def test_scans_that_come_again_count_once():
    monitor, again = (scans(6, 40, 0.8) for _ in range(2))
    looks = TagReadCounts(np.zeros((1, 3)), np.zeros(1, int), np.ones(1, int), np.ones((1, TAGS), int))
    again.add(5.0, looks, reads(looks, np.full((1, TAGS), 0.5)), ALL)
    for one in (monitor, again):
        one.add(40.0, looks, reads(looks, np.full((1, TAGS), 0.5)), ALL)
    assert again.overdispersion == monitor.overdispersion > 2.0


def test_covariances_are_right_although_the_rig_knows_of_no_bursts():
    log = simulate(preset("office", {"drive": {"duration": 120.0}, **BURSTS}), 43)
    found = score(run(log, RunConfig("smoother")), log)
    assert found["causal.anees"] < 4.5  # 8.8 to 10.3 by the tempering of the rig
