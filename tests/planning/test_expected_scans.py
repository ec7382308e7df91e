"""Scans that are drawn on the way, and how particles are weighed by them: against the likelihood that estimators use."""

import math

import numpy as np
import pytest

from factorgraph_loc.sensors.rfid import forecast as expected_scans
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
