"""The particle filter with strength and phase of reads, on simulated offices."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from factorgraph_loc import RfidScan, Rig, Tag, VelocityOdometry, World
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion import registry
from factorgraph_loc.model import setup as model_setup
from factorgraph_loc.model.belief import PosePrior
from factorgraph_loc.sensors.rfid.settings import AntennaSettings, PhaseSettings, RfidSettings, RssiSettings
from factorgraph_loc.simulation import preset, simulate

READS = ("odometry", "rfid")
FREQUENCY = 9.2e8  # Hz
PHASE = PhaseSettings(tempering=0.5, max_range=4.0)
# as the simulation draws it
STRENGTH = RssiSettings(coefficients=(-50.0, 2.0, -8.0, 0.0, 2.0, 0.0), sigma=2.0, dof=4.0, tempering=0.3)


@cache
def office(seed=0, duration=30.0):
    log = simulate(preset("office", {"drive": {"duration": duration}, "phase": {}, "rssi": {}}), seed)
    rfid = log.rig.rfid.model_copy(update={"phase": PHASE, "rssi": STRENGTH})
    return replace(log, rig=log.rig.model_copy(update={"rfid": rfid}))


def config(*signals, **changes):
    return replace(RunConfig("particle_filter", {"particles": 800, "smooth": False}, (*READS, *signals)), **changes)


def position_errors(result, log):
    return np.linalg.norm(result.poses[:, :2] - log.reference.at(result.t)[:, :2], axis=1)


def final_errors(result, log):
    return np.linalg.norm(result.final.poses[:, :2] - log.reference.at(result.final.t)[:, :2], axis=1)


def events(result):
    return [what.partition(":")[0] for _, what in result.diagnostics.events]


def rms(*errors):
    return np.sqrt(np.mean(np.concatenate(errors) ** 2))


@cache
def both(*signals):
    """Root mean square of the causal and of the final errors over two offices."""
    results = [(run(office(s), config(*signals, settings={"particles": 800})), office(s)) for s in range(2)]
    return rms(*(position_errors(*r) for r in results)), rms(*(final_errors(*r) for r in results))


def test_phase_leads_from_decimetres_to_centimetres():
    """Over three seeds the causal error is two thirds, the final one a third of that of the detections alone."""
    causal, final = both("phase")
    causal_of_reads, final_of_reads = both()
    assert causal < 0.85 * causal_of_reads
    assert final < 0.6 * final_of_reads
    assert final < 0.06


def test_strength_does_no_harm():
    causal, final = both("rssi")
    causal_of_reads, final_of_reads = both()
    assert causal != causal_of_reads
    assert causal < 1.1 * causal_of_reads
    assert final < 1.15 * final_of_reads


def test_phases_leave_particles_enough():
    """A filter that depletes believes in what is far from the truth: 3 is expected of the squared normalised error."""
    log = office(1)
    result = run(log, config("rssi", "phase"))
    error = result.poses - log.reference.at(result.t)
    error[:, 2] = np.mod(error[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    nees = np.einsum("ni,ni->n", error, np.linalg.solve(result.covariances, error[..., None])[..., 0])
    assert nees.mean() < 10.0


def test_start_three_metres_and_sixty_degrees_off():
    """Most runs notice within seconds and search; one that does not is drawn to the right place by what it reads."""
    after_15, after_25 = [], []
    for seed in range(2):
        log = office(seed)
        off = replace(log, start=replace(log.start, pose=log.start.pose + np.array((2.1, 2.1, np.radians(60.0)))))
        result = run(off, config("rssi", "phase"))
        found = position_errors(result, off)
        after_15.append(found[result.t > 15.0].max())
        after_25.append(found[result.t > 25.0].max())
    assert np.median(after_15) < 0.2
    assert max(after_25) < 0.5


def scan(t, *reads, rssi=np.nan, phase):
    full = np.ones(len(reads))
    zero = np.zeros(len(reads))
    return RfidScan(t, ("ahead",), zero.astype(np.int64), reads, zero, rssi * full, phase * full, FREQUENCY * full)


def alone(tag, phase, covariance, particles=500):
    """The filter with one antenna and one tag, from a start near the origin."""
    rfid = RfidSettings(
        antennas={"ahead": AntennaSettings()},
        false_read=0.0,
        rssi=STRENGTH.model_copy(update={"tempering": 1.0}),
        phase=PHASE.model_copy(update=phase),
    )
    setup = model_setup.Setup(
        Rig(rfid=rfid), World(tags={"a": tag}), (*READS, "rssi", "phase"), np.random.default_rng(1)
    )
    out = registry.create(
        "particle_filter", setup, registry.settings_of("particle_filter", {"particles": particles, "smooth": False})
    )
    out.initialize(PosePrior(0.0, np.zeros(3), covariance))
    return out


@pytest.mark.parametrize("x", [2.0, 200.0])
def test_reads_that_no_particle_explains_leave_numbers(x):
    particles = alone(Tag(x=x, y=0.0), {"kappa": 50.0, "tempering": 1.0, "max_range": 50.0}, 1e-4 * np.eye(3))
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
        particles = alone(Tag(x=1.5, y=0.7), {"kappa": 5.0, "tempering": 1.0}, start, particles=4000)
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
