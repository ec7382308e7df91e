"""Scans that are drawn on the way, and how particles are weighed by them: against the likelihood that estimators use."""

import math

import numpy as np
import pytest

from factorgraph_loc.planning import particle_kernels
from factorgraph_loc.sensors.rfid import forecast as expected_scans
from factors import se2
from factors.rfid.detection import RfidLikelihood, TagArray
from factors.rfid.model import Antenna, BeamModel, LogisticModel, RfidModel, bake

ANTENNAS = tuple(Antenna(0.2 * math.cos(a), 0.2 * math.sin(a), 1.2, a) for a in (0.0, 1.6, -2.0))
FACING_MODEL = LogisticModel((2.0, -0.9, -0.05, -3.0, 0.2, 0.1, -0.4, 1.0, 0.2, 0.0, 0.0))


def likelihood(model=None, tempering=1.0, facing=np.nan):
    model = RfidModel(ANTENNAS, (model or BeamModel(),), 1e-3, 0.02, tempering)
    points = np.array(((3.0, 1.0, 1.0), (1.5, -2.0, 1.0), (-2.0, 1.0, 1.5), (30.0, 0.0, 1.0)))
    return RfidLikelihood(model, TagArray(points, np.full(4, facing)))


def weighed(found, poses, rounds, stops, scans, seeds):
    """Log-weights (R, J, M) of R sets of scans."""
    tables = expected_scans.make_tables(found)
    out = np.empty((len(seeds), scans, poses.shape[1]), np.float32)
    for each, seed in zip(out, seeds, strict=True):
        arguments = (np.array(rounds), np.array(stops), scans, np.uint64(seed), found.model.tempering)
        expected_scans.log_weights(tables, poses, *arguments, each)
    return out


def divergence(found, a, b, rounds):
    """Kullback-Leibler divergence of the scans at poses ``b`` (S, 3) from those at ``a``, and the variance of what it is the mean
    of; tags beyond the reach of all are left out."""
    mean = variance = 0.0
    for k, count in enumerate(rounds):
        for antenna in range(len(found.model.antennas)):
            p, q = (found.probabilities(x[k : k + 1], antenna)[0, :3] for x in (a, b))
            yes, no = np.log(p / q), np.log((1.0 - p) / (1.0 - q))
            mean += count * np.sum(p * yes + (1.0 - p) * no)
            variance += count * np.sum(p * (1.0 - p) * (yes - no) ** 2)
    return mean, variance


@pytest.mark.parametrize(
    ("model", "facing"),
    [(BeamModel(), np.nan), (bake(BeamModel(), 6.0), np.nan), (FACING_MODEL, 2.0), (FACING_MODEL, np.nan)],
)
def test_log_weights_differ_in_the_mean_by_the_divergence(model, facing):
    """Draws and weights together: the mean over scans of log p(z|a) - log p(z|b) is a divergence that the exact model tells. Five
    standard deviations of that mean are allowed (one false alarm in 10^6), and 10 % for the cells of the tables."""
    found = likelihood(model, facing=facing)
    poses = np.array([[(0.0, 0.0, 0.1), (0.4, -0.3, 0.5)], [(1.0, 0.2, 0.1), (1.2, 0.3, 0.6)]])
    rounds = (4, 7)
    got = weighed(found, poses, rounds, (2, 2), 2, range(4000))
    for a, b in ((0, 1), (1, 0)):
        mean, variance = divergence(found, poses[:, a], poses[:, b], rounds)
        assert mean > 0.2
        tolerance = 5.0 * math.sqrt(variance / 4000) + 0.1 * mean + 0.02
        assert np.mean(got[:, a, a] - got[:, a, b]) == pytest.approx(mean, abs=tolerance)


def test_tempering_scales_weights_of_the_same_scans():
    poses = np.array([[(0.0, 0.0, 0.1), (0.4, -0.3, 0.5)]])
    whole, half = (weighed(likelihood(tempering=t), poses, (5,), (1, 1), 2, range(20)) for t in (1.0, 0.5))
    np.testing.assert_allclose(half, whole / 2.0, rtol=1e-5)
    assert np.ptp(whole) > 1.0


def test_who_is_stopped_scans_no_more():
    poses = np.array([[(0.0, 0.0, 0.1), (0.4, -0.3, 0.5)], [(1.0, 0.2, 0.1), (1.2, 0.3, 0.6)]])
    found = likelihood()
    none, one, two = (weighed(found, poses, (4, 7), (s, 2), 2, range(5)) for s in (0, 1, 2))
    np.testing.assert_array_equal(none[:, 0], 0.0)
    np.testing.assert_array_equal(one[:, 0], weighed(found, poses[:1], (4,), (1, 1), 2, range(5))[:, 0])
    assert not np.allclose(one[:, 0], two[:, 0])
    np.testing.assert_array_equal(one[:, 1], two[:, 1])


def test_draws_are_uniform_and_rounds_binomial():
    """Kolmogorov's bound at a false-alarm rate of 10^-6."""
    u = np.sort([expected_scans._uniform(np.uint64(7), n) for n in range(20_000)])
    assert abs(u - (np.arange(20_000) + 0.5) / 20_000).max() < 2.7 / math.sqrt(20_000)
    n, q = 6, 0.3
    found = [expected_scans._binomial(n, q, x) for x in u.tolist()]
    counts = np.bincount([k for k, _ in found], minlength=n + 1) / len(u)
    expected = [math.comb(n, k) * q**k * (1.0 - q) ** (n - k) for k in range(n + 1)]
    np.testing.assert_allclose(counts, expected, atol=0.005)
    # what is left of a draw is uniform once more, whatever it gave
    for k in range(4):
        left = np.sort([rest for got, rest in found if got == k])
        even = (np.arange(len(left)) + 0.5) / len(left)
        assert abs(left - even).max() < 2.7 / math.sqrt(len(left))


def stations(noise=0.0, seed=0):
    along = se2.exp(np.column_stack((0.25 * np.arange(21), np.zeros(21), 0.1 * np.arange(21))))
    steps = np.array((0, 3, 9, 15, 20))
    rng = np.random.default_rng(seed)
    particles = np.column_stack((rng.normal(size=(4000, 2)), rng.uniform(-3.0, 3.0, 4000)))
    sigmas = noise * np.array(((0.0, 0.0, 0.0), *[(0.02, 0.01, 0.03)] * 4))
    return along, steps, particles, sigmas, rng.standard_normal((5, 4000, 3))


def test_particles_follow_the_path_until_they_are_stopped():
    along, steps, particles, sigmas, normals = stations()
    last = np.arange(4000) % 25
    out = np.empty((5, 4000, 3))
    particle_kernels.look_poses(particles, along, steps, last, sigmas, normals, out)
    for k, step in enumerate(steps.tolist()):
        expected = se2.compose(particles, along[np.minimum(step, last)])
        np.testing.assert_allclose(out[k, :, :2], expected[:, :2], atol=1e-9)
        np.testing.assert_allclose(se2.wrap(out[k, :, 2] - expected[:, 2]), 0.0, atol=1e-9)


def test_noise_on_the_way_adds_up_as_small_motions_do():
    """Against exact composition, draw by draw, and the standard deviations of 4000 draws to 6 % (5 of their own)."""
    along, steps, particles, sigmas, normals = stations(noise=1.0)
    out = np.empty((5, 4000, 3))
    particle_kernels.look_poses(particles, along, steps, np.full(4000, 99), sigmas, normals, out)
    exact = particles
    for k in range(1, 5):
        exact = se2.compose(exact, se2.between(along[steps[k - 1]], along[steps[k]]))
        exact = se2.compose(exact, se2.exp(sigmas[k] * normals[k]))
        error = se2.between(exact, out[k])
        assert abs(error).max() < 0.03  # second order in the noise
    spread = se2.log(se2.between(se2.compose(particles, along[-1]), out[-1])).std(axis=0)
    assert spread[2] == pytest.approx(0.06, rel=0.06)
    assert spread[1] > 0.06
