"""The particle filter with RFID: the exact posterior of one tag; unknown and wrong starts, kidnapping; faults of tags."""

from dataclasses import replace

import numpy as np
import pytest

from factorgraph_loc import RfidScan, Rig, Tag, VelocityOdometry, World
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion import registry
from factorgraph_loc.model import setup as model_setup
from factorgraph_loc.model.belief import PosePrior
from factorgraph_loc.sensors.rfid.settings import AntennaSettings, BeamSettings, PriorSettings, RfidSettings
from factorgraph_loc.simulation.settings import preset
from factorgraph_loc.simulation.simulate import simulate
from factors import se2
from factors.rfid.detection import RfidLikelihood, TagArray, TagReadCounts

SENSORS = ("odometry", "rfid")
KNOWN = RunConfig("particle_filter", {"particles": 1500, "smooth": False}, SENSORS)
UNKNOWN = replace(KNOWN, prior="unknown")


def office(seed=0, duration=30.0, **changes):
    return simulate(preset("office", {"drive": {"duration": duration}, **changes}), seed)


@pytest.fixture(scope="module")
def log():
    return office()


def position_errors(result, log):
    return np.linalg.norm(result.poses[:, :2] - log.reference.at(result.t)[:, :2], axis=1)


def events(source):
    return [what.partition(":")[0] for _, what in source.diagnostics.events]


def scan(t, *reads, antennas=("ahead",)):
    count = len(reads)
    none = np.full(count, np.nan)
    return RfidScan(t, antennas, np.zeros(count, np.int64), reads, np.zeros(count), none, none, none)


def alone(world, rfid, particles, **settings):
    """The filter with one antenna and no motion."""
    setup = model_setup.Setup(Rig(rfid=rfid), world, SENSORS, np.random.default_rng(1))
    return registry.create(
        "particle_filter", setup, registry.settings_of("particle_filter", {"particles": particles, **settings})
    )


@pytest.mark.parametrize("kld", [False, True])
def test_posterior_of_one_tag(kld):
    # four scans at rest, two with a read: the posterior on a grid is exact
    world = World(tags={"a": Tag(x=2.0, y=0.5)})
    rfid = RfidSettings(antennas={"ahead": AntennaSettings()})
    particles = alone(world, rfid, 40_000, kld=kld, min_particles=20_000)
    covariance = np.diag((0.6, 0.6, 0.4)) ** 2
    particles.initialize(PosePrior(0.0, np.zeros(3), covariance))
    particles.process(VelocityOdometry(0.0, 0.0, 0.0))
    for i, reads in enumerate((("a",), (), ("a",), ())):
        particles.process(scan(0.1 * i, *reads))
    axes = [np.linspace(-4.0 * s, 4.0 * s, 61) for s in (0.6, 0.6, 0.4)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    likelihood = RfidLikelihood(rfid.model(), TagArray(np.array(((2.0, 0.5, 0.0),)), np.array((np.nan,))))
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


def test_silence_of_a_minute_is_survived():
    log = office(0, 85.0, faults={"silence": {"time": 10.0, "duration": 60.0}})
    result = run(log, KNOWN)
    assert np.isfinite(result.poses).all()
    assert np.isfinite(result.covariances).all()
    during = (result.t > 20.0) & (result.t < 70.0)
    # it is said that something is wrong, and the robot goes on by its odometry
    assert events(result) == ["no tag is read where some should be"]
    sigmas = np.sqrt(np.linalg.eigvalsh(result.covariances[:, :2, :2])[:, -1])
    assert (position_errors(result, log) / sigmas).max() < 3.5
    assert np.mean(np.array(result.status)[during] == "ambiguous") > 0.8
    assert position_errors(result, log)[result.t > 80.0].max() < 0.5


def test_no_tag_of_the_map_is_ever_read():
    log = office(0, 10.0, faults={"dead": 1.0})
    result = run(log, KNOWN)
    assert np.isfinite(result.poses).all()
    unknown = run(log, UNKNOWN)
    assert "localized" not in unknown.status


def test_unlikely_scans_leave_numbers():
    world = World(tags={"a": Tag(x=50.0, y=0.0)})
    rfid = RfidSettings(antennas={"ahead": AntennaSettings()}, false_read=0.0)
    particles = alone(world, rfid, 500)
    particles.initialize(PosePrior(0.0, np.zeros(3), 0.01 * np.eye(3)))
    particles.process(VelocityOdometry(0.0, 0.1, 0.0))
    for i in range(1, 30):
        particles.process(scan(0.1 * i, "a", "a unknown one"))
    assert np.isfinite(particles.estimate().pose).all()
    assert particles.diagnostics.ignored == {"tag not in the map": 29}


def test_antenna_that_the_rig_lacks_and_late_scans():
    world = World(tags={"a": Tag(x=2.0, y=0.0)})
    particles = alone(world, RfidSettings(antennas={"ahead": AntennaSettings()}), 500)
    particles.initialize(PosePrior(0.0, np.zeros(3), 0.01 * np.eye(3)))
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
    world = World(tags={"a": Tag(x=1.0, y=0.0)})
    # and the tag lives, and the antenna is as the rig says: else both would be doubted before the reader is
    exact = {"default": BeamSettings(prior=PriorSettings(range_scale=0.0, read_rate=0.0))}
    settings = RfidSettings(antennas={"ahead": AntennaSettings()}, models=exact, dead_tags=0.0, moved_tags=0.0)
    particles = alone(world, settings, 500)
    particles.initialize(PosePrior(0.0, np.zeros(3), 1e-4 * np.eye(3)))
    for t in (0.3, 0.2, 0.1):
        particles.process(scan(t))
    assert particles.diagnostics.events == []
    for t in (0.4, 0.5, 0.6):
        particles.process(scan(t))
    assert events(particles) == ["no tag is read where some should be"]


def test_heading_drift_travels_with_the_particles(log):
    result = run(office(3, 120.0), KNOWN)
    value, sigma = result.learnt.values["heading_drift"]
    prior = log.rig.odometry.uncertainty.heading_drift
    assert sigma < 0.8 * prior
    assert abs(value) < 4.0 * prior
    assert abs(se2.wrap_scalar(value)) < 1.0
