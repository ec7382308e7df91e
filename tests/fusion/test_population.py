"""Finding the robot from scans of tags alone."""

import math

import numpy as np
import pytest

from factorgraph_loc import Rig, VelocityOdometry
from factorgraph_loc.fusion import kld
from factorgraph_loc.fusion.population import CHUNK, PARTICLE, Population
from factorgraph_loc.fusion.tracking import laplace_evidence
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.sensors.motion import Motion
from factorgraph_loc.sensors.odometry.settings import GrowthSettings, OdometryNoise, OdometrySettings
from factorgraph_loc.sensors.rfid.sensor import TagObservation
from factorgraph_loc.sensors.rfid.settings import AntennaSettings, RfidSettings
from factors import se2
from factors.rfid.detection import RfidLikelihood, TagArray, TagReadCounts
from factors.rfid.factor import RfidFactor
from factors.update import Correction

NOISE = OdometryNoise(
    along=GrowthSettings(per_distance=0.01),
    lateral=GrowthSettings(per_distance=0.005),
    heading=GrowthSettings(per_distance=0.026),
)
RIG = Rig(odometry=OdometrySettings(noise=NOISE), rfid=RfidSettings(preset="rackham", preset_z=1.2))
BOUNDS = np.array(((-1.0, -1.0), (13.0, 9.0)))
SPEED, STEP = 0.5, 0.5  # m/s, s
START = np.array((1.0, 1.5, 0.1))


class World:
    """A drive along a gentle arc past tags, or straight, and what is read on the way."""

    def __init__(self, points, seed, turn=0.1, rfid=RIG.rfid):
        self.turn = turn
        self.antennas = len(rfid.all_antennas())
        self.rng = np.random.default_rng(seed)
        points = np.column_stack((points, np.full(len(points), 1.2)))
        self.likelihood = RfidLikelihood(rfid.model(), TagArray(points, np.full(len(points), np.nan)))
        self.told = self.likelihood  # what the seeker believes
        self.motion = Motion(RIG, ("odometry", "rfid"), Diagnostics())
        self.motion.add(VelocityOdometry(0.0, SPEED, turn))
        self.truth = START
        self.t = 0.0
        self.silent = False

    def seeker(self):
        return Population(self.motion, BOUNDS, np.random.default_rng(self.rng.integers(2**32)))

    def scan(self, seeker, advances=True):
        if self.t > 0.0:
            self.motion.add(VelocityOdometry(self.t, SPEED, self.turn))
        n = self.antennas
        looks = TagReadCounts(np.zeros((n, 3)), np.arange(n), np.ones(n, dtype=np.int64), self.hits())
        factor = RfidFactor(self.told, looks)
        seeker.add(self.motion.state(self.t), TagObservation(self.t, factor, int(looks.hits.sum()), looks))
        if advances:
            seeker.advance()
        at, self.t = self.truth, self.t + STEP
        self.truth = se2.compose(at, se2.exp(np.array((SPEED, 0.0, self.turn)) * STEP))
        return at

    def hits(self):
        chance = np.stack([self.likelihood.probabilities(self.truth[None], k)[0] for k in range(self.antennas)])
        return (self.rng.random(chance.shape) < (0.0 if self.silent else chance)).astype(np.int64)


def scattered(seed, count=25):
    return np.random.default_rng(seed).uniform(BOUNDS[0] + 1.0, BOUNDS[1] - 1.0, (count, 2))


def test_the_place_is_found_and_claimed():
    world = World(scattered(1), 1)
    seeker = world.seeker()
    for _ in range(12):
        at = world.scan(seeker)
    assert seeker.best is not None
    assert seeker.best.t == pytest.approx(5.5)
    error = seeker.best.pose - at
    assert math.hypot(*error[:2]) < 0.5
    assert abs(se2.wrap_scalar(error[2])) < math.radians(15.0)
    assert sum(m.weight for m in seeker.hypotheses) == pytest.approx(1.0, abs=0.02)
    drawn = seeker.sample(np.random.default_rng(0), 500)
    poses, weights = seeker.particles
    assert np.allclose(weights @ poses[:, :2], drawn[:, :2].mean(axis=0), atol=0.1)
    assert np.linalg.norm(drawn[:, :2].mean(axis=0) - seeker.best.pose[:2]) < 0.1


def test_evidence_favours_a_world_that_fits():
    found = []
    for points in (scattered(1), scattered(2)):
        world = World(scattered(1), 5)
        other = RfidLikelihood(
            RIG.rfid.model(), TagArray(np.column_stack((points, np.full(25, 1.2))), np.full(25, np.nan))
        )
        seeker = Population(world.motion, BOUNDS, np.random.default_rng(3))
        world.told = other
        for _ in range(6):
            world.scan(seeker)
        found.append(seeker.log_evidence)
    assert found[0] > found[1] + 20.0


def test_symmetric_places_stay_ambiguous():
    # tags on one line, antennas ahead and behind, and a straight drive: the mirror image beyond the line fits as well
    both = RfidSettings(
        antennas={"ahead": AntennaSettings(x=0.2, z=1.2), "behind": AntennaSettings(x=-0.2, z=1.2, yaw=math.pi)}
    )
    line = np.column_stack((np.arange(0.0, 13.0, 1.5), np.full(9, 4.0)))
    world = World(line, 1, turn=0.0, rfid=both)
    seeker = world.seeker()
    for _ in range(24):
        at = world.scan(seeker)
        assert seeker.best is None
    modes = [m for m in seeker.hypotheses if m.weight > 0.1]
    assert len(modes) == 2
    for expected in (at, np.array((at[0], 8.0 - at[1], -at[2]))):
        assert min(np.linalg.norm(m.pose - expected) for m in modes) < 0.6


@pytest.mark.parametrize(("spread", "claimed"), [(0.15, 2.0), (0.21, 4.0), (0.3, None)])
def test_a_place_is_claimed_when_it_is_likely_enough(spread, claimed):
    """0.996, 0.94 and 0.75 of a Gaussian are within half a metre: from the third observation on, a second or three are enough."""

    class Seen:
        found, work = 1, 1

        def __init__(self, number, at):
            self.things, self.at = {number}, at

        def log_likelihood(self, poses, values):
            if self.at is None:
                return np.zeros(len(poses))
            error = se2.log(se2.between(self.at, poses))
            return -0.5 * np.sum((error / (spread, spread, 0.05)) ** 2, axis=1)

    world = World(scattered(0), 0)
    seeker = world.seeker()
    first = None
    for i in range(12):
        if i:
            world.motion.add(VelocityOdometry(i * STEP, 0.0, 0.0))
        seeker.add(world.motion.state(i * STEP), Seen(i, None if i else START))
        seeker.advance()
        if first is None and seeker.best is not None:
            first = seeker.best.t
    assert first == claimed


def test_found_after_silence():
    world = World(scattered(4), 2)
    world.silent = True
    seeker = world.seeker()
    for _ in range(6):
        world.scan(seeker)
        assert seeker.best is None
        assert all(np.isfinite(m.pose).all() for m in seeker.hypotheses)
    world.silent = False
    for _ in range(12):
        at = world.scan(seeker)
    assert seeker.best is not None
    assert np.linalg.norm(seeker.best.pose[:2] - at[:2]) < 0.5


def test_a_scan_that_is_older_than_the_last_is_left_out():
    world = World(scattered(0), 0)
    seeker = world.seeker()
    world.scan(seeker)
    before = seeker.log_evidence
    looks = TagReadCounts(np.zeros((1, 3)), np.zeros(1, int), np.ones(1, int), np.ones((1, 25), int))
    older = TagObservation(-0.1, RfidFactor(world.likelihood, looks), 25, looks)
    assert not seeker.add(world.motion.state(-0.1), older)
    assert seeker.log_evidence == before


def test_number_of_particles_follows_the_places_left():
    rng = np.random.default_rng(0)
    wide, narrow = rng.normal(0.0, 3.0, (20_000, 3)), rng.normal(0.0, 0.1, (20_000, 3))
    assert len(kld.prefix(narrow, rng, 300)) < 1000
    assert len(kld.prefix(wide, rng, 300)) > 10_000
    assert len(kld.prefix(narrow, rng, 5000)) == 5000
    # Fox (2003), eq. 7 at k = 101, epsilon 0.05: chi-square quantile 135.8 of 100 degrees of freedom over 0.1
    assert kld.enough(np.array(101)) == pytest.approx(1358.0, rel=2e-3)


def test_an_evidence_of_zero_is_an_evidence():
    class Unasked:
        def log_likelihood(self, poses, values):
            raise AssertionError("the correction has it")

    spread = np.eye(3)
    known = Correction(np.ones(3), spread, np.empty((0, 1)), 1.0, 1, evidence=0.0)
    assert laplace_evidence(Unasked(), np.zeros(3), spread, known) == 0.0


def test_slices_of_any_size_tell_the_same():
    """What is found depends on what was seen alone, and not on how the work was cut."""
    worlds = [World(scattered(5), 5) for _ in range(2)]
    whole, sliced = (world.seeker() for world in worlds)
    for _ in range(6):
        worlds[0].scan(whole)
    for _ in range(6):
        worlds[1].scan(sliced, advances=False)
    assert sliced.waits
    assert sliced.best is None
    slices = 0
    while sliced.waits:
        sliced.advance(1.0)
        slices += 1
    assert slices > 20
    assert np.array_equal(sliced.particles[0], whole.particles[0])
    assert np.array_equal(sliced.particles[1], whole.particles[1])
    assert sliced.log_evidence == whole.log_evidence


def test_no_slice_takes_more_than_its_work():
    class Counted:
        t, found, things, work = 0.0, 1, frozenset(), 1000
        weighed = 0

        def log_likelihood(self, poses, values):
            self.weighed += len(poses)
            return -0.5 * np.sum(poses[:, :2] ** 2, axis=1)

    observation = Counted()
    world = World(scattered(1), 1)
    seeker = world.seeker()
    assert seeker.add(world.motion.state(0.0), observation)
    most = 0
    while seeker.waits:
        before = observation.weighed
        seeker.advance(1.0)
        most = max(most, observation.weighed - before)
    assert 0 < most * (observation.work + PARTICLE) <= CHUNK


@pytest.mark.parametrize("seed", range(3))
def test_a_narrow_place_in_a_large_hall_is_found_though_no_particle_began_in_it(seed):
    """Each has a room of about 1 m by 1 m by 0.7 rad for itself at first: kernels that are much narrower leave gaps."""

    class Narrow:
        t, found, things, work = 0.0, 1, frozenset(), 100
        place = np.random.default_rng(seed).uniform((10.0, 10.0, -3.0), (90.0, 50.0, 3.0))

        def log_likelihood(self, poses, values):
            off = poses - self.place
            off[:, 2] = se2.wrap(off[:, 2])
            return -0.5 * np.sum((off / (0.05, 0.05, 0.03)) ** 2, axis=1)

    world = World(scattered(1), 1)
    seeker = Population(world.motion, np.array(((0.0, 0.0), (100.0, 60.0))), np.random.default_rng(seed))
    seeker.add(world.motion.state(0.0), Narrow())
    seeker.advance()
    middle = seeker.hypotheses[0]
    assert middle.weight > 0.98
    assert np.hypot(*(middle.pose - Narrow.place)[:2]) < 0.05
    assert np.all(np.sqrt(np.diag(middle.covariance))[:2] < 0.1)


def test_a_clear_place_alone_is_drawn_from():
    world = World(scattered(2), 2)
    seeker = world.seeker()
    while seeker.best is None:
        world.scan(seeker)
    poses, weights = seeker.particles
    far = np.hypot(*(poses - seeker.best.pose)[:, :2].T) > 2.0
    assert weights[far].sum() > 1e-4  # those that are drawn anywhere
    drawn = seeker.sample(np.random.default_rng(0), 50_000)
    assert np.all(np.hypot(*(drawn - seeker.best.pose)[:, :2].T) < 2.0)
