"""The likelihood of reads for poses anywhere, and the index of tags by place."""

import numpy as np
import pytest

from factors.rfid.detection import RfidLikelihood, TagArray, TagReadCounts
from factors.rfid.index import tag_index, within
from factors.rfid.model import Antenna, BeamModel, LogisticModel, RfidModel, bake

BEAM = BeamModel()
ANTENNAS = tuple(Antenna(0.2, 0.1 * k, 1.2, 1.5 * k) for k in range(4))
WIDTH, DEPTH = 60.0, 40.0
HEIGHTS = (0.4, 1.2, 2.0)


def scene(heights, tempering=1.0, detection=BEAM):
    """A likelihood, looks from a pose in a hall with tags of all states, and poses near it and anywhere."""
    rng = np.random.default_rng(1)
    count = 300
    points = np.column_stack((rng.uniform(0.0, (WIDTH, DEPTH), (count, 2)), rng.choice(heights, count)))
    model = RfidModel(ANTENNAS, (detection,), tempering=tempering)
    facing = rng.uniform(-3.0, 3.0, count) if detection.uses_facing else np.full(count, np.nan)
    likelihood = RfidLikelihood(model, TagArray(points, facing))
    pose = np.array((30.0, 20.0, 0.4))
    chance = np.stack([likelihood.probabilities(pose[None], k)[0] for k in range(len(ANTENNAS))])
    hits = rng.binomial(2, chance)
    odds = np.full(count, -2.7)
    odds[::7], odds[3::50] = rng.normal(-2.0, 3.0, len(odds[::7])), -np.inf
    elsewhere = np.where(hits.any(axis=0), np.where(rng.random(count) < 0.5, -np.inf, -7.0), 0.0)
    rounds = np.full(len(ANTENNAS), 2)
    looks = TagReadCounts(np.zeros((len(ANTENNAS), 3)), np.arange(len(ANTENNAS)), rounds, hits, odds, elsewhere)
    near = pose + rng.normal(size=(300, 3)) * (0.5, 0.5, 0.2)
    anywhere = rng.uniform((0.0, 0.0, -3.0), (WIDTH, DEPTH, 3.0), (300, 3))
    return likelihood, looks, near, anywhere


LOGISTIC = LogisticModel((5.0, -0.6, -0.1, -3.0, 0.2, -0.1, -0.5, 1.5, 0.3, 0.1, -0.2))
FACING = bake(LOGISTIC, 6.0, 0.3, (-0.8, 0.0, 0.8), 5)


@pytest.mark.parametrize(
    ("detection", "parameters", "heights", "bound"),
    [
        (BEAM, (0.0, 0.0), (1.2,), 0.05),
        (BEAM, (0.0, 0.0), HEIGHTS, 0.05),
        (BEAM, (0.1, -0.6), HEIGHTS, 0.1),
        (BEAM, (-0.2, 0.5), HEIGHTS, 0.1),
        (LOGISTIC, (0.0, 0.0), HEIGHTS, 0.1),
        (LOGISTIC, (0.1, -0.6), HEIGHTS, 0.1),
        (FACING, (0.0, 0.0), HEIGHTS, 0.1),
        (FACING, (-0.1, 0.4), HEIGHTS, 0.1),
    ],
)
def test_poses_anywhere_are_as_likely_as_when_looked_at_alone(detection, parameters, heights, bound):
    """With models as the rig says, adjusted ones, and those that use facings."""
    plain, looks, near, anywhere = scene(heights, 0.7, detection)
    likelihood = plain.adjusted(np.array((*parameters, *plain.parameters[2:])))
    poses = np.concatenate((near, anywhere))
    together = likelihood.log_likelihood(poses, looks)
    exact = -likelihood.score(poses, looks).nll
    # cells of 5 cm; the likelihoods differ by hundreds
    assert np.ptp(exact) > 50.0
    assert np.mean(together - exact) == pytest.approx(0.0, abs=bound)
    assert np.std(together - exact) < (0.25 if bound < 0.1 else 0.4)


def test_what_is_out_of_reach_tells_what_silence_and_false_reads_tell():
    likelihood, looks, near, _ = scene((1.2,))
    away = np.concatenate((near, near + np.array((500.0, 0.0, 0.0))))
    together = likelihood.log_likelihood(away, looks)[len(near) :]
    assert together == pytest.approx(-likelihood.score(away[len(near) :], looks).nll, rel=1e-6)


@pytest.mark.parametrize("size", [(30.0, 10.0), (0.0, 0.0), (1e6, 3.0)])
def test_the_index_finds_all_tags_in_a_box(size):
    rng = np.random.default_rng(2)
    points = np.column_stack((rng.uniform(-1.0, 1.0, (200, 2)) * size, np.zeros(200)))
    index = tag_index(points)
    for _ in range(50):
        low = rng.uniform(-1.5, 1.5, 2) * size
        high = low + rng.uniform(0.0, 1.0, 2) * size
        found = within(index, low, high)
        inside = np.flatnonzero(np.all((points[:, :2] >= low) & (points[:, :2] <= high), axis=1))
        assert set(inside) <= set(found)
        assert np.all(np.diff(found) > 0)
        apart = np.maximum(low - points[found, :2], points[found, :2] - high).max(initial=0.0)
        assert apart <= index.cell
