"""The particle filter with reads of tags, their strength and their phase: exact posteriors, late scans, impossible reads."""

from functools import cache

import numpy as np
import pytest
from by_hand import made, scan
from short_logs import SIGNALS, with_signals

from factorgraph_loc import Rig, Tag, VelocityOdometry, World
from factorgraph_loc.model.belief import PosePrior
from factorgraph_loc.sensors.rfid.settings import AntennaSettings, BeamSettings, PriorSettings, RfidSettings
from factorgraph_loc.simulation import preset, simulate
from factors.rfid.detection import RfidLikelihood, TagArray, TagReadCounts

FREQUENCY = 9.2e8  # Hz
AHEAD = {"ahead": AntennaSettings()}


def alone(tag, covariance, particles=500, rfid=None, **settings):
    """The filter with one antenna and one tag, from a start near the origin."""
    rig, world = Rig(rfid=rfid or RfidSettings(antennas=AHEAD)), World(tags={"a": tag})
    sensors = ("odometry", "rfid", *(("rssi", "phase") if rig.rfid.phase else ()))
    filter = made("particle_filter", rig, world, sensors, 1, particles=particles, smooth=False, **settings)
    filter.initialize(PosePrior(0.0, np.zeros(3), covariance))
    return filter


def with_phase(**phase):
    """Settings of a reader that reports strength and phase."""
    rssi, phase = (SIGNALS[k].model_copy(update={"tempering": 1.0} | m) for k, m in (("rssi", {}), ("phase", phase)))
    return RfidSettings(antennas=AHEAD, false_read=0.0, rssi=rssi, phase=phase)


@cache
def office(seed):
    return with_signals(simulate(preset("office", {"drive": {"duration": 30.0}, "phase": {}, "rssi": {}}), seed))


@pytest.mark.parametrize("kld", [False, True])
def test_posterior_of_one_tag(kld):
    # four scans at rest, two with a read: the posterior on a grid is exact
    covariance = np.diag((0.6, 0.6, 0.4)) ** 2
    usual = RfidSettings(antennas=AHEAD, dead_tags=0.0, weak_tags=0.0, moved_tags=0.0)
    particles = alone(Tag(x=2.0, y=0.5), covariance, 40_000, usual, kld=kld, min_particles=20_000)
    particles.process(VelocityOdometry(0.0, 0.0, 0.0))
    for i, reads in enumerate((("a",), (), ("a",), ())):
        particles.process(scan(0.1 * i, *reads))
    axes = [np.linspace(-4.0 * s, 4.0 * s, 61) for s in (0.6, 0.6, 0.4)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    likelihood = RfidLikelihood(
        RfidSettings(antennas=AHEAD).model(), TagArray(np.array(((2.0, 0.5, 0.0),)), np.array((np.nan,)))
    )
    two = TagReadCounts(np.zeros((1, 3)), np.zeros(1, np.int64), np.array((4,)), np.array(((2,),)))
    log_density = -likelihood.score(grid, two).nll - 0.5 * np.sum(grid**2 / np.diag(covariance), axis=1)
    weights = np.exp(log_density - log_density.max())
    weights /= weights.sum()
    mean = weights @ grid
    expected = (weights[:, None] * (grid - mean)).T @ (grid - mean)
    estimate = particles.estimate()
    # 20,000 effective draws: 5 sigma of the mean are 0.035 deviations, of a variance 5 % (false alarm 1e-5)
    np.testing.assert_allclose((estimate.pose - mean) / np.sqrt(np.diag(expected)), 0.0, atol=0.06)
    np.testing.assert_allclose(np.diag(estimate.covariance), np.diag(expected), rtol=0.08)


def test_antenna_that_the_rig_lacks_and_late_scans():
    particles = alone(Tag(x=2.0, y=0.0), 0.01 * np.eye(3))
    for i in range(20):
        particles.process(VelocityOdometry(0.1 * i, 0.1, 0.0))
    particles.process(scan(1.8, "a"))
    particles.process(scan(1.7, "a"))
    particles.process(scan(0.5, "a"))
    particles.process(scan(1.9, "a", antennas=("ahead", "another")))
    assert particles.diagnostics.ignored == {"antenna that the rig lacks": 1}
    assert particles.diagnostics.late == {"rfid": 1}
    assert {t for t, _, _ in particles.diagnostics.nis["rfid"]} == {1.7, 1.8, 1.9}


def test_scans_that_come_again_make_no_silence():
    # not to read a tag a metre ahead has a log-probability of -2.3: three times are no silence yet, six would be
    # and the tag lives, and the antenna is as the rig says: else both would be doubted before the reader is
    exact = {"default": BeamSettings(prior=PriorSettings(range_scale=0.0, read_rate=0.0))}
    rfid = RfidSettings(antennas=AHEAD, models=exact, dead_tags=0.0, weak_tags=0.0, moved_tags=0.0)
    particles = alone(Tag(x=1.0, y=0.0), 1e-4 * np.eye(3), rfid=rfid)
    for t in (0.3, 0.2, 0.1):
        particles.process(scan(t))
    assert particles.diagnostics.events == []
    for t in (0.4, 0.5, 0.6):
        particles.process(scan(t))
    (event,) = particles.diagnostics.events
    assert event.kind == "silent"


@pytest.mark.parametrize("x", [2.0, 200.0])
def test_reads_that_no_particle_explains_leave_numbers(x):
    particles = alone(Tag(x=x, y=0.0), 1e-4 * np.eye(3), rfid=with_phase(kappa=50.0, max_range=50.0))
    rng = np.random.default_rng(2)
    for i in range(20):
        particles.process(VelocityOdometry(0.2 * i, 0.1, 0.0))
        particles.process(scan(0.2 * i, "a", "a", rssi=1e4, phase=rng.uniform(0.0, 6.28, 2)))
    estimate = particles.estimate()
    assert np.isfinite(estimate.pose).all()
    assert np.linalg.eigvalsh(estimate.covariance)[0] > 0.0


def test_phases_of_scans_that_come_late_count_once():
    """Each scan after the one that follows it: the filter goes back, and has in the end what it has in time, but for its draws. The
    phase halves the spread of y and heading: not to take it, or to take it twice, makes a difference."""
    times = 0.1 * np.arange(20)
    phases = -4.0 * np.pi * FREQUENCY / 299_792_458.0 * np.hypot(1.5 - 0.4 * times, 0.7)
    scans = [scan(t, "a", phase=phase) for t, phase in zip(times, phases, strict=True)]
    found = []
    for rows in (range(20), [i ^ 1 for i in range(20)]):
        start = np.diag((0.05, 0.05, 0.1)) ** 2
        particles = alone(Tag(x=1.5, y=0.7), start, 4000, with_phase(kappa=5.0))
        for t in times:
            particles.process(VelocityOdometry(t, 0.4, 0.0))
        for row in rows:
            particles.process(scans[row])
        assert not particles.diagnostics.late
        found.append(particles.estimate())
    spread = np.sqrt(np.diag(found[0].covariance))
    # of 1,000 effective draws 0.25 deviations are more than 5 sigma of a difference of means (1e-6 of false alarms each)
    np.testing.assert_allclose((found[0].pose - found[1].pose) / spread, 0.0, atol=0.25)
    np.testing.assert_allclose(np.sqrt(np.diag(found[1].covariance)) / spread, 1.0, atol=0.2)
