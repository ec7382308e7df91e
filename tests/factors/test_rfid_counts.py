"""Counts that list only some tags of a map tell what counts of all tags tell."""

from dataclasses import replace

import numpy as np
import pytest

from factors.rfid.detection import RfidLikelihood, TagArray, TagReadCounts, merged
from factors.rfid.factor import RfidFactor
from factors.rfid.index import tag_index, within
from factors.rfid.model import Antenna, BeamModel, LogisticModel, RfidModel, bake

ANTENNAS = tuple(Antenna(0.2, 0.1 * k, 1.2, 1.5 * k) for k in range(4))
POSE = np.array((40.0, 20.0, 0.4))
PRIOR = -2.7


def scene(seed=0):
    """A likelihood with 400 tags, and looks at POSE that list all tags, and only those that were read or are in doubt."""
    rng = np.random.default_rng(seed)
    count = 400
    points = np.column_stack((rng.uniform(0.0, (80.0, 40.0), (count, 2)), np.full(count, 1.2)))
    likelihood = RfidLikelihood(RfidModel(ANTENNAS, (BeamModel(),), tempering=0.8), TagArray(points, np.zeros(count)))
    chance = np.stack([likelihood.probabilities(POSE[None], k)[0] for k in range(len(ANTENNAS))])
    hits = (rng.random(chance.shape) < chance).astype(np.int64)
    offsets = rng.normal(size=(len(ANTENNAS), 3)) * 0.1
    odds, elsewhere = np.full(count, PRIOR), np.where(hits.any(axis=0), -5.0, 0.0)
    odds[::9] = 1.0
    rounds = np.ones(len(ANTENNAS), dtype=np.int64)
    whole = TagReadCounts(offsets, np.arange(len(ANTENNAS)), rounds, hits, odds, elsewhere)
    tags = np.flatnonzero(hits.any(axis=0) | (odds != PRIOR))
    listed = {"hits": np.ascontiguousarray(hits[:, tags]), "odds": odds[tags], "elsewhere": elsewhere[tags]}
    return likelihood, whole, replace(whole, **listed, tags=tags, unlisted_odds=PRIOR)


def displaced(likelihood, poses, looks):
    hypotheses, odds = np.array(((0.0, 0.0, 0.0, 0.0), (1.0, -0.5, 0.0, 0.0))), np.zeros(len(likelihood.tags.points))
    return likelihood.displaced(poses, looks, hypotheses, 1.5, likelihood.parameters, odds)


def test_few_tags_are_looked_at():
    likelihood, _, some = scene()
    near = likelihood.expected(POSE, some, likelihood.parameters).tags
    assert len(some.tags) < len(near) < 200
    reachable = displaced(likelihood, POSE[None], some)[0]
    assert 10 < len(reachable) < 150


@pytest.mark.parametrize("change", [0.0, 0.2])
def test_scores_are_the_same(change):
    likelihood, whole, some = scene()
    parameters = change + likelihood.parameters
    adjusted = likelihood.adjusted(parameters)
    for pose in (POSE, POSE + np.array((6.0, -4.0, 1.0)), POSE + np.array((500.0, 0.0, 0.0))):
        for a, b in zip(adjusted.score(pose, whole), adjusted.score(pose, some), strict=True):
            assert b == pytest.approx(a, rel=1e-9, abs=1e-9)
        joint = (likelihood.joint_score(pose, parameters, looks) for looks in (whole, some))
        for a, b in zip(*joint, strict=True):
            assert b == pytest.approx(a, rel=1e-9, abs=1e-9)


def test_scores_do_not_depend_on_what_was_looked_at_before():
    """To the last bit, and with the same tags."""
    likelihood, _, some = scene()
    tags, told = likelihood.expected(POSE, some, likelihood.parameters).tags, likelihood.score(POSE, some)
    for pose in POSE + np.linspace(-0.45, 0.45, 6)[:, None] * (1.0, 0.5, 0.0):
        likelihood, _, some = scene()
        likelihood.score(pose, some)
        np.testing.assert_array_equal(likelihood.expected(POSE, some, likelihood.parameters).tags, tags)
        for a, b in zip(likelihood.score(POSE, some), told, strict=True):
            np.testing.assert_array_equal(a, b)


def test_updates_are_the_same():
    likelihood, whole, some = scene()
    start, covariance = POSE + np.array((0.5, -0.4, 0.2)), np.diag((0.5, 0.5, 0.3)) ** 2
    a, b = (RfidFactor(likelihood, looks).correct(start, covariance) for looks in (whole, some))
    assert b.delta == pytest.approx(a.delta, abs=1e-9)
    for name in ("covariance", "nis", "excess_nll", "variance", "evidence"):
        assert getattr(b, name) == pytest.approx(getattr(a, name), rel=1e-9)


@pytest.mark.parametrize("spread", [0.3, 15.0])
def test_particles_weigh_the_same(spread):
    likelihood, whole, some = scene()
    poses = POSE + np.random.default_rng(1).normal(size=(200, 3)) * (spread, spread, 0.3)
    parameters = np.zeros((200, len(likelihood.parameters)))
    parameters[:, :2] = np.random.default_rng(2).normal(size=(200, 2)) * (0.1, 0.3)
    for each in (None, parameters):
        a, b = (likelihood.log_likelihood(poses, looks, each) for looks in (whole, some))
        assert b == pytest.approx(a, abs=1e-3)  # each tag that may have moved is added in single precision


def test_what_scans_tell_of_tags_is_the_same():
    likelihood, whole, some = scene()
    poses = POSE + np.random.default_rng(1).normal(size=(6, 3)) * 0.1
    told = [displaced(likelihood, poses, looks) for looks in (whole, some)]
    for a, b in zip(*told, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


def test_merged_counts_list_what_any_of_them_lists():
    _, whole, some = scene(0)
    _, other, fewer = scene(1)
    fewer = replace(fewer, odds=np.full(len(fewer.tags), 3.0))
    whole_of_two, of_two = merged([whole, other]), merged([some, fewer])
    assert set(of_two.tags) == set(some.tags) | set(fewer.tags)
    at = np.searchsorted(of_two.tags, some.tags)
    assert np.array_equal(of_two.odds[at], some.odds)
    assert np.array_equal(of_two.hits, whole_of_two.hits[:, of_two.tags])
    assert of_two.elsewhere == pytest.approx(whole_of_two.elsewhere[of_two.tags])
    assert set(of_two.read_tags) == set(np.flatnonzero(whole_of_two.hits.any(axis=0)))


BEAM = BeamModel()
WIDTH, DEPTH = 60.0, 40.0
HEIGHTS = (0.4, 1.2, 2.0)


def scattered(heights, tempering=1.0, detection=BEAM):
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
    plain, looks, near, anywhere = scattered(heights, 0.7, detection)
    likelihood = plain.adjusted(np.array((*parameters, *plain.parameters[2:])))
    poses = np.concatenate((near, anywhere))
    together = likelihood.log_likelihood(poses, looks)
    exact = -likelihood.score(poses, looks).nll
    # cells of 5 cm; the likelihoods differ by hundreds
    assert np.ptp(exact) > 50.0
    assert np.mean(together - exact) == pytest.approx(0.0, abs=bound)
    assert np.std(together - exact) < (0.25 if bound < 0.1 else 0.4)


def test_what_is_out_of_reach_tells_what_silence_and_false_reads_tell():
    likelihood, looks, near, _ = scattered((1.2,))
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
