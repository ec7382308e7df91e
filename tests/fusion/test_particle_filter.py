"""The particle filter: unknown start, wrong start, kidnapping; constants of the sensor; its cloud as a density; standing still."""

import numpy as np
import pytest
from by_hand import made
from landmark_world import simulate, with_sightings

from factorgraph_loc import RunFailedError, Tick
from factorgraph_loc.experiments.output import write_run
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion.cloud import Cloud, largest_share, pose_moments, systematic
from factorgraph_loc.model.belief import PosePrior
from factorgraph_loc.model.log import cut
from factors import se2

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
    assert result.warnings == ("simulated: never localized: its landmarks leave several places possible",)
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
    with pytest.raises(
        RunFailedError, match=r"^at 2.500 s the likelihood of a measurement is a finite number for none"
    ):
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
