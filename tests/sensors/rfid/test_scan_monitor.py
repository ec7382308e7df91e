"""The monitor of a track by its scans: calm while they are as expected, suspicious since they ceased to be."""

import math

import numpy as np

from factorgraph_loc.sensors.rfid.monitor import ScanMonitor

VARIANCE = 4.0


def test_no_suspicion_while_scans_are_as_expected():
    # sums of normal draws beyond 6 sigma: 2e-9 each, of 20,000
    rng = np.random.default_rng(1)
    monitor = ScanMonitor()
    for i in range(20_000):
        monitor.add(0.5 * i, math.sqrt(VARIANCE) * rng.standard_normal(), VARIANCE)
        assert monitor.suspicious_since is None


def test_suspicion_tells_when_it_began_and_ends():
    rng = np.random.default_rng(2)
    monitor = ScanMonitor()

    def add(i, surprise):
        monitor.add(0.5 * i, surprise + math.sqrt(VARIANCE) * rng.standard_normal(), VARIANCE)

    for i in range(100):
        add(i, 0.0)
    for i in range(100, 110):
        add(i, 15.0)
    assert monitor.suspicious_since == 50.0
    for i in range(110, 140):
        add(i, 0.0)
    assert monitor.suspicious_since is None


def test_scans_that_come_again_count_once():
    monitor = ScanMonitor()
    for i in range(20):
        monitor.add(0.5 * i, 0.0, VARIANCE)
    for _ in range(50):
        monitor.add(9.5, 10.0, VARIANCE)
    assert monitor.suspicious_since is None


def test_cleared():
    monitor = ScanMonitor()
    for i in range(10):
        monitor.add(0.5 * i, 20.0, VARIANCE)
    assert monitor.suspicious_since == 0.0
    monitor.clear()
    assert monitor.suspicious_since is None


def test_scans_without_variance_are_no_suspicion():
    # beyond all tags nothing is expected, and nothing is read
    monitor = ScanMonitor()
    for i in range(20):
        monitor.add(0.5 * i, 0.0, 0.0)
    assert monitor.suspicious_since is None
