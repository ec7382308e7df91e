"""The particle filter: unknown start, wrong start, kidnapping; constants of the sensor; its cloud as a density; standing still."""

from functools import cache

import numpy as np
import pytest
from by_hand import made, scan
from landmark_world import simulate, with_sightings
from short_logs import SIGNALS, with_signals

from factorgraph_loc import Rig, RunFailedError, Tag, Tick, VelocityOdometry, World
from factorgraph_loc.experiments.output import write_run
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion.cloud import Cloud, largest_share, pose_moments, systematic
from factorgraph_loc.fusion.particle_smoothing import draw_ancestors
from factorgraph_loc.model.belief import PosePrior
from factorgraph_loc.model.log import cut
from factorgraph_loc.sensors.rfid.settings import AntennaSettings, BeamSettings, PriorSettings, RfidSettings
from factorgraph_loc.simulation import preset
from factorgraph_loc.simulation import simulate as simulate_office
from factors import positive, se2
from factors.rfid.detection import RfidLikelihood, TagArray, TagReadCounts

SENSORS = ("odometry", "bearing_range")
UNKNOWN = RunConfig("particle_filter", {"particles": 1000}, prior="unknown")


@pytest.fixture(scope="module")
def log():
    return simulate(seconds=20.0)


def only(log, landmarks):
    return with_sightings(log, np.isin(log.streams["bearing_range"].landmark, list(landmarks)))


def test_one_landmark_is_ambiguous(log, tmp_path):
    result = run(only(cut(log, 0.0, 3.0), "b"), UNKNOWN)
    assert set(result.status) == {"unlocalized", "ambiguous"}
    (warning,) = result.warnings
    assert str(warning) == "simulated: never localized: its landmarks match several poses"
    scores = write_run(result, log, tmp_path / "out")
    assert scores["causal.position_rmse"] is None
    assert scores["time_to_localized"] is None


def test_modes_of_a_cloud():
    rng = np.random.default_rng(1)
    places = np.array(((0.0, 0.0, np.pi), (5.0, 1.0, 0.0), (5.0, 6.0, 0.0)))
    which = np.repeat((0, 1, 2), (600, 300, 100))
    poses = places[which] + 0.1 * rng.standard_normal((1000, 3))
    poses[:, 2] = np.mod(poses[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    modes = Cloud(poses, np.empty((1000, 0)), np.full(1000, -np.log(1000.0))).modes()
    assert [m.weight for m in modes] == pytest.approx([0.6, 0.3, 0.1])
    for mode, place in zip(modes, places, strict=True):
        assert np.hypot(*(mode.pose - place)[:2]) < 0.05
        assert np.cos(mode.pose[2] - place[2]) > 0.999
        np.testing.assert_allclose(np.sqrt(np.diag(mode.covariance)), 0.1, rtol=0.3)


def test_the_density_of_a_cloud_has_the_moments_of_what_it_was_drawn_from():
    """Of 200,000 particles, whose moments are within 1 % (more than 4 sigma: 1e-4 of false alarms for each)."""
    rng = np.random.default_rng(4)
    root = rng.normal(size=(5, 5)) * 0.1
    errors = rng.standard_normal((200_000, 5)) @ root.T
    middle = np.array((3.0, -1.0, 3.1))
    weights = np.exp(-0.5 * rng.standard_normal(len(errors)) ** 2)
    cloud = Cloud(se2.compose(middle, se2.exp(errors[:, :3])), errors[:, 3:], np.log(weights / weights.sum()))
    shrunk, kernel = cloud.density()
    drawn = shrunk.drawn(systematic(cloud.weights, rng), kernel, rng)
    found = np.concatenate((se2.log(se2.between(middle, drawn.poses)), drawn.constants), axis=1)
    sigmas = np.linalg.norm(root, axis=1)
    np.testing.assert_allclose(
        np.cov(found.T) / np.outer(sigmas, sigmas), root @ root.T / np.outer(sigmas, sigmas), atol=0.02
    )
    np.testing.assert_allclose(found.mean(axis=0) / sigmas, 0.0, atol=0.02)


def test_constants_of_particles_that_descend_from_one_stay_uncertain():
    """Their spread has gone below what numbers can tell apart; a later state must still be compared with them."""
    rng = np.random.default_rng(0)
    cloud = Cloud(0.1 * rng.standard_normal((50, 3)), np.tile((0.02, 0.0), (50, 1)), np.full(50, -np.log(50.0)))
    shrunk, kernel = cloud.density()
    np.linalg.cholesky(kernel)
    np.testing.assert_allclose(shrunk.constants, cloud.constants, atol=1e-12)
    assert np.all(np.diag(kernel)[3:] < 1e-24)


def test_a_density_of_several_modes_stays_at_its_poses():
    rng = np.random.default_rng(4)
    cloud = Cloud(rng.normal(size=(100, 3)), rng.normal(size=(100, 1)), np.full(100, -np.log(100.0)), localized=False)
    shrunk, kernel = cloud.density()
    drawn = shrunk.drawn(np.arange(100), kernel, rng)
    np.testing.assert_allclose(drawn.poses, cloud.poses, atol=1e-12)
    assert drawn.constants.std() == pytest.approx(cloud.constants.std(), rel=0.4)  # 5 sigma: 6e-7 of false alarms


class Likely:
    """An observation of the pose alone with a given log-likelihood."""

    blocks = ()

    def __init__(self, log_likelihood, work=1):
        self._log_likelihood, self.work = log_likelihood, work
        self.weighed = 0

    def log_likelihood(self, poses, values):
        self.weighed += len(poses)
        return self._log_likelihood(poses)


@pytest.mark.parametrize("nowhere", [np.nan, -np.inf])
def test_a_likelihood_that_is_no_number_comes_to_an_end(log, nowhere):
    """Particles for which it is none are impossible; where that are all, the run fails in one line."""
    filter = made("particle_filter", log.rig, log.world, SENSORS, 1, particles=200)
    filter.initialize(PosePrior(2.5, np.zeros(3), np.eye(3)))
    filter._weigh(Likely(lambda poses: np.where(poses[:, 0] > 0.0, 0.0, nowhere)))
    cloud = filter._state
    assert np.isfinite(filter.estimate().pose).all()
    assert cloud.weights[cloud.poses[:, 0] > 0.0].sum() > 0.9
    with pytest.raises(RunFailedError, match=r"^the likelihood of the measurement at 2\.500 s is not finite for any"):
        filter._weigh(Likely(lambda poses: np.full(len(poses), nowhere)))


def test_what_is_much_work_is_weighed_by_a_few_particles_first(log):
    """A narrow place, for a quarter of the work: of 200 other seeds the largest error of its middle was 0.32 of its standard
    deviation, that of these 0.13 of them, and that of the log of the evidence, which is -12.1, was 3.8."""
    found = []
    for work in (1, 1000):
        filter = made("particle_filter", log.rig, log.world, SENSORS, 1, self_calibration=False)
        filter.initialize(PosePrior(2.5, np.zeros(3), np.eye(3)))
        place = Likely(lambda poses: -0.5 * np.sum(((poses - 0.5) / 0.02) ** 2, axis=1), work)
        evidence = filter._weigh(place)
        found.append((evidence, *filter._state.moments, place.weighed))
    assert found[1][3] < 0.4 * found[0][3]
    assert len(filter._state.poses) == 5000
    expected = -1.5 * np.log(1.0 + 1.0 / 0.02**2) - 0.5 * 3 * 0.5**2 / (1.0 + 0.02**2)
    for evidence, mean, covariance, _ in found:
        assert evidence == pytest.approx(expected, abs=5.0)
        np.testing.assert_allclose(mean, 0.5, atol=0.5 * 0.02)
        np.testing.assert_allclose(np.sqrt(np.diag(covariance)), 0.02, rtol=0.2)


def test_what_no_particle_explains_is_taken_in_few_shares():
    """A likelihood so steep that each share leaves but one particle."""
    left, count = 1.0, 0
    while left > 0.0:
        left -= largest_share(np.full(50, -np.log(50.0)), -1e9 * np.arange(50.0), left, 25.0)
        count += 1
    assert count < 500


def test_ticks_move_no_particle(log):
    """Until something is seen the particles wait, however many ticks there are; the estimate has the moments that they have once
    they are moved: of 4,000 the mean to 5 standard errors, the covariance to 7, which fails in fewer than one of 10,000 runs."""
    found = []
    for ticks in (np.arange(0.0, 0.85, 0.05), [0.0, 0.8]):
        settings = {"particles": 4000, "self_calibration": False}
        estimator = made("particle_filter", log.rig, log.world, SENSORS, 1, **settings)
        estimator.initialize(PosePrior(0.0, log.reference.poses[0], np.diag((0.1, 0.1, 0.05)) ** 2))
        for m in log.measurements(("odometry",)):
            if m.t < 0.9:
                estimator.process(m)
        for t in ticks:
            estimator.process(Tick(t))
        found.append((estimator.estimate(0.8), estimator.belief(0.8)))
    (one, cloud), (other, same) = found
    assert one.pose[0] != log.reference.poses[0, 0]
    np.testing.assert_array_equal(cloud.particles, same.particles)
    np.testing.assert_array_equal(one.pose, other.pose)
    mean, covariance = pose_moments(cloud.particles, cloud.weights)
    sigmas = np.sqrt(np.diag(one.covariance))
    assert np.all(np.abs(mean - one.pose) < 5.0 * sigmas / np.sqrt(4000))
    assert np.all(np.abs(covariance - one.covariance) < 7.0 * np.outer(sigmas, sigmas) / np.sqrt(2000))


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
    return with_signals(simulate_office(preset("office", {"drive": {"duration": 30.0}, "phase": {}, "rssi": {}}), seed))


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


def transition_log_density(predicted, constants, after, constants_after, covariance):
    """Log-density (M, N), up to a constant, of states ``after`` (M, 3), (M, P) given noise-free predictions (N, 3), (N, P).

    The body-frame error is taken to first order: log(p^-1 * a) is the difference, turned into the frame of p.
    """
    whitener = np.linalg.inv(positive.root(covariance))
    c, s = np.cos(predicted[:, 2]), np.sin(predicted[:, 2])
    dx = after[:, None, 0] - predicted[:, 0]
    dy = after[:, None, 1] - predicted[:, 1]
    heading = np.mod(after[:, None, 2] - predicted[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    pose = np.stack((c * dx + s * dy, c * dy - s * dx, heading), axis=-1)
    error = np.concatenate((pose, constants_after[:, None] - constants), axis=-1) @ whitener.T
    return -0.5 * np.sum(error**2, axis=-1)


@pytest.mark.parametrize("size", [0, 2])
def test_each_draw_is_the_one_that_its_uniform_number_names(size):
    rng = np.random.default_rng(5)
    predicted, after = rng.normal(size=(300, 3)), rng.normal(size=(40, 3))
    predicted[:, 2] *= 3.0  # headings that wrap
    constants, constants_after = rng.normal(size=(300, size)), rng.normal(size=(40, size))
    log_weights = np.log(rng.dirichlet(np.ones(300)))
    root = rng.normal(size=(3 + size, 3 + size)) * 0.3 + np.eye(3 + size)
    covariance, uniform = root @ root.T, rng.random(40)

    log_density = transition_log_density(predicted, constants, after, constants_after, covariance) + log_weights
    weights = np.exp(log_density - log_density.max(axis=1, keepdims=True))
    cumulative = np.cumsum(weights / weights.sum(axis=1, keepdims=True), axis=1)
    expected = [int(np.searchsorted(c, u, side="right")) for c, u in zip(cumulative, uniform, strict=True)]

    drawn = draw_ancestors(predicted, constants, log_weights, after, constants_after, covariance, uniform)
    assert drawn.tolist() == expected


def test_a_state_that_no_particle_explains_has_an_ancestor_by_the_weights():
    predicted, after = np.zeros((3, 3)), np.array(((1e200, 0.0, 0.0),) * 200)
    log_weights = np.log((0.5, 1e-9, 0.5))
    uniform = np.random.default_rng(1).random(200)
    # singular as numbers go
    covariance = np.outer((1e-3, 1e3, 1.0), (1e-3, 1e3, 1.0))
    none = np.empty((3, 0)), np.empty((200, 0))
    drawn = draw_ancestors(predicted, none[0], log_weights, after, none[1], covariance, uniform)
    assert drawn.tolist() == np.where(uniform < 0.5, 0, 2).tolist()
