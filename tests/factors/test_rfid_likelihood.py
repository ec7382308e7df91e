"""The likelihood of reads and silences: value, gradient, information, tables."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numerical import by_each, by_pose

from factors import se2
from factors.rfid.detection import RfidLikelihood, TagArray, TagReadCounts, merged
from factors.rfid.factor import RfidFactor, RfidTagFactor
from factors.rfid.model import Antenna, BeamModel, DetectionModel, LogisticModel, RfidModel, bake, probability

COEFFICIENTS = (3.0, -1.2, 0.02, -1.5, 0.2, -0.06, -0.6, 0.4, 0.9, 0.1, -0.16)
MODELS: dict[str, DetectionModel] = {
    "beam": BeamModel(),
    "logistic": LogisticModel(COEFFICIENTS),
    "grid": bake(LogisticModel(COEFFICIENTS), 6.0, 0.2, heights=(-0.4, 0.0, 0.4), facings=7),
}
POSE = np.array((4.0, 3.0, 0.5))


def scene(
    model: DetectionModel, seed: int = 0, tempering: float = 1.0, pitch: float = 0.1
) -> tuple[RfidLikelihood, TagReadCounts]:
    """Four antennas with different places, 15 tags, of which some have no facing, and looks at different offsets."""
    rng = np.random.default_rng(seed)
    antennas = tuple(Antenna(0.3 * math.cos(a), 0.3 * math.sin(a), 1.0, a, pitch) for a in np.arange(4) * math.pi / 2.0)
    facing = rng.uniform(-math.pi, math.pi, 15)
    facing[:3] = np.nan
    places, heights = rng.uniform(1.0, 7.0, (15, 2)), rng.uniform(0.8, 1.4, 15)
    tags = TagArray(np.column_stack((places, 0.3 * np.rint(heights / 0.3))), facing)
    hits = rng.integers(0, 3, (4, 15))
    looks = TagReadCounts(rng.normal(size=(4, 3)) * 0.1, np.arange(4), np.full(4, 2), hits)
    return RfidLikelihood(RfidModel(antennas, (model,), 0.01, 0.02, tempering), tags), looks


@pytest.mark.parametrize("name", MODELS)
@given(seed=st.integers(0, 1000))
def test_gradient(name: str, seed: int) -> None:
    likelihood, looks = scene(MODELS[name], seed)
    numeric = by_pose(lambda pose: likelihood.score(pose, looks).nll[0], POSE)
    assert likelihood.score(POSE, looks).gradient[0] == pytest.approx(numeric, abs=1e-3, rel=1e-3)


def test_information_and_expectation_are_those_of_drawn_reads() -> None:
    """Over reads drawn from the model: the gradient has mean zero and the information as covariance. 4,000 draws: each of the
    checks is at 5 standard errors, so that all together fail by chance once in 100,000 runs."""
    likelihood, looks = scene(BeamModel(), pitch=0.0)
    looks = TagReadCounts(np.zeros((4, 3)), looks.antennas, np.ones(4, dtype=np.int64), looks.hits)
    rng = np.random.default_rng(5)
    q = np.array([likelihood.probabilities(POSE[None], a)[0] for a in range(4)])
    scores = [
        likelihood.score(
            POSE, TagReadCounts(looks.offsets, looks.antennas, looks.rounds, (rng.random(q.shape) < q).astype(np.int64))
        )
        for _ in range(4000)
    ]
    gradients = np.array([s.gradient[0] for s in scores])
    nlls = np.array([s.nll[0] for s in scores])
    information = scores[0].information[0]
    root = np.sqrt(len(scores))
    assert np.all(np.abs(gradients.mean(axis=0)) < 5.0 * gradients.std(axis=0) / root)
    products = gradients[:, :, None] * gradients[:, None, :]
    assert np.all(np.abs(products.mean(axis=0) - information) < 5.0 * products.std(axis=0) / root)
    assert abs(nlls.mean() - scores[0].expected[0]) < 5.0 * nlls.std() / root
    squares = (nlls - nlls.mean()) ** 2
    assert abs(squares.mean() - scores[0].variance[0]) < 5.0 * squares.std() / root


def test_tables_of_grids_are_the_same_from_their_planes_as_cell_by_cell() -> None:
    """They are made cell by cell for antennas with a pitch, here one of no consequence; at most a rounding may differ."""
    planes, cells = (scene(MODELS["grid"], pitch=pitch)[0]._tables for pitch in (0.0, 1e-12))
    np.testing.assert_array_equal(planes.level, cells.level)
    off = np.abs(planes.rows.astype(int) - cells.rows)
    assert len(np.unique(cells.rows)) > 500
    assert off.max() <= 1
    assert (off > 0).mean() < 1e-4


@pytest.mark.parametrize("tempering", [0.3, 1.0])
def test_what_is_left_out_of_many_tags_does_not_matter(tempering: float) -> None:
    """Looks at tags that cannot have been read, and reads from out of reach, of a dense map: tables are as wrong by their cells."""
    rng = np.random.default_rng(3)
    antennas = tuple(Antenna(0.2 * math.cos(a), 0.2 * math.sin(a), 1.0, a) for a in np.arange(8) * math.pi / 4.0)
    model = RfidModel(antennas, (BeamModel(),), 1e-3, 0.0, tempering)
    points = np.column_stack((rng.uniform(0.0, 40.0, (1500, 2)), np.full(1500, 1.1)))
    likelihood = RfidLikelihood(model, TagArray(points, np.full(1500, np.nan)))
    truth = np.array((20.0, 20.0, 0.3))
    chance = np.stack([likelihood.probabilities(truth[None], k)[0] for k in range(8)])
    assert (chance[:, np.hypot(*(points[:, :2] - truth[:2]).T) > 10.0] < 0.002).all()
    hits = (rng.random(chance.shape) < chance).astype(np.int64)
    looks = TagReadCounts(np.zeros((8, 3)), np.arange(8), np.ones(8, dtype=np.int64), hits, np.full(1500, -2.8))
    poses = truth + rng.normal(size=(300, 3)) * (0.3, 0.3, 0.1)
    parameters = np.zeros((300, len(likelihood.parameters)))
    parameters[:, :2] = rng.normal(size=(300, 2)) * (0.02, 0.1)
    found = likelihood.log_likelihood(poses, looks, parameters)
    exact = np.array(
        [-likelihood.joint_score(pose, own, looks).nll[0] for pose, own in zip(poses, parameters, strict=True)]
    )
    assert np.std(found - exact) < 0.1 * np.std(exact)
    assert np.abs(found - exact).mean() < 0.01 * np.abs(exact).mean()


@pytest.mark.parametrize("name", MODELS)
def test_many_looks_at_many_tags_add_up(name: str) -> None:
    """Tables multiply the likelihoods of looks and of tags before they take logarithms: of 600 poses, 100 rounds and 1,500 tags."""
    likelihood, looks = scene(MODELS[name])
    poses = POSE + np.random.default_rng(1).normal(size=(600, 3)) * 0.3
    often = replace(looks, rounds=50 * looks.rounds, hits=50 * looks.hits)
    expected = likelihood.log_likelihood(poses, looks)
    assert likelihood.log_likelihood(poses, often) == pytest.approx(50.0 * expected, rel=1e-8)
    tags = likelihood.tags
    copied = TagArray(np.tile(tags.points, (100, 1)), np.tile(tags.facing, 100))
    mixed = replace(looks, odds=np.linspace(-3.0, 3.0, 15), elsewhere=np.linspace(-5.0, 0.0, 15))
    expected = likelihood.log_likelihood(poses, mixed)
    tiled = {name: np.tile(getattr(mixed, name), 100) for name in ("hits", "odds", "elsewhere")}
    mixed = replace(mixed, tags=np.arange(1500), **tiled)
    found = RfidLikelihood(likelihood.model, copied).log_likelihood(poses, mixed)
    assert found == pytest.approx(100.0 * expected, rel=1e-8)


def test_one_read_and_one_silence_by_hand() -> None:
    tags = TagArray(np.array(((2.0, 0.5, 1.0), (3.0, -1.0, 1.0))), np.full(2, np.nan))
    likelihood = RfidLikelihood(RfidModel((Antenna(z=1.0),), (BeamModel(),), 0.01, 0.02, 0.5), tags)
    looks = TagReadCounts(np.zeros((1, 3)), np.zeros(1, np.int64), np.ones(1, np.int64), np.array(((1, 0),)))
    p = probability(BeamModel(), np.array(((2.0, 0.5, 0.0), (3.0, -1.0, 0.0))))
    q = 0.01 + 0.97 * p
    expected = -0.5 * (math.log(q[0]) + math.log(1.0 - q[1]))
    assert likelihood.score(np.zeros(3), looks).nll[0] == pytest.approx(expected, rel=1e-9)
    assert likelihood.probabilities(np.zeros((1, 3)), 0)[0] == pytest.approx(q, rel=1e-9)


def test_looks_around_one_pose_add_up() -> None:
    likelihood, looks = scene(BeamModel())
    moved = looks.moved(np.array((0.2, 0.0, 0.1)))
    both = likelihood.score(POSE, merged([looks, moved])).nll[0]
    apart = likelihood.score(POSE, looks).nll[0] + likelihood.score(se2.compose(POSE, (0.2, 0.0, 0.1)), looks).nll[0]
    assert both == pytest.approx(apart, rel=1e-12)


def test_tags_say_together_what_each_says() -> None:
    likelihood, looks = scene(MODELS["grid"], tempering=0.3)
    nll, gradient, information = likelihood.by_tag(POSE, looks)
    assert nll.sum() == pytest.approx(likelihood.score(POSE, looks).nll[0])
    step = 1e-6
    for t in (0, 7):
        for axis in range(2):
            ends = []
            for s in (step, -step):
                points = likelihood.tags.points.copy()
                points[t, axis] += s
                other = RfidLikelihood(likelihood.model, TagArray(points, likelihood.tags.facing))
                ends.append(other.score(POSE, looks).nll[0])
            assert gradient[t, axis] == pytest.approx((ends[0] - ends[1]) / (2.0 * step), abs=1e-3)
    assert np.all(np.linalg.eigvalsh(information) > -1e-12)


def test_a_model_without_a_floor_stays_finite() -> None:
    tags = TagArray(np.array(((0.5, 0.0, 0.0), (50.0, 0.0, 0.0))), np.full(2, np.nan))
    likelihood = RfidLikelihood(RfidModel((Antenna(),), (BeamModel(p0=1.0 - 1e-16),), 0.0, 0.0), tags)
    looks = TagReadCounts(np.zeros((1, 3)), np.zeros(1, np.int64), np.ones(1, np.int64), np.array(((0, 1),)))
    assert all(np.all(np.isfinite(part)) for part in likelihood.score(np.zeros(3), looks))
    assert not np.any(np.isnan(likelihood.log_likelihood(np.zeros((2, 3)), looks)))


def test_factor_has_the_cost_gradient_and_curvature_of_the_likelihood() -> None:
    likelihood, looks = scene(MODELS["logistic"], tempering=0.2)
    factor, score = RfidFactor(likelihood, looks), likelihood.score(POSE, looks)
    residual, (jacobian,) = factor.linearize([POSE])
    assert residual.shape == (4,)
    assert 0.5 * residual @ residual == pytest.approx(score.nll[0], rel=1e-6)
    assert jacobian.T @ residual == pytest.approx(score.gradient[0], rel=1e-5, abs=1e-7)
    assert jacobian.T @ jacobian == pytest.approx(score.information[0], rel=1e-4, abs=1e-6)
    assert factor.cost([POSE]) == pytest.approx(score.nll[0])


def doubtful(seed: int, name: str = "beam") -> tuple[RfidLikelihood, TagReadCounts, TagReadCounts]:
    """A scene in which most tags are silent: all of them as surveyed, and with odds from certain to nearly given up."""
    likelihood, looks = scene(MODELS[name], seed, tempering=0.3)
    looks.hits[:, 4:] = 0
    elsewhere = np.where(looks.hits.any(axis=0), -1.5, np.resize(np.array((0.0, -0.2)), 15))
    return (
        likelihood,
        looks,
        replace(looks, odds=np.resize(np.array((-np.inf, -3.0, 0.5, 8.0)), 15), elsewhere=elsewhere),
    )


def out_of_reach(likelihood: RfidLikelihood, looks: TagReadCounts) -> float:
    """The negative log-likelihood of a tag out of reach that is not read."""
    model = likelihood.model
    floor = model.false_read + (1.0 - model.false_read - model.miss) / (1.0 + math.exp(14.0))
    return -model.tempering * float(looks.rounds.sum()) * math.log1p(-floor)


def mixture(likelihood: RfidLikelihood, looks: TagReadCounts, pose: np.ndarray) -> float:
    """The negative log-likelihood of tags that may be dead or moved, tag by tag."""
    none = out_of_reach(likelihood, looks)
    each, _, _ = likelihood.by_tag(pose, looks)
    other = 1.0 / (1.0 + np.exp(-looks.odds))
    return float(-np.log((1.0 - other) * np.exp(-each) + other * np.exp(looks.elsewhere - none)).sum())


@pytest.mark.parametrize("name", MODELS)
def test_a_tag_that_may_not_be_as_surveyed_counts_as_a_mixture(name: str) -> None:
    likelihood, looks, mixed = doubtful(0, name)
    found = likelihood.score(POSE, mixed)
    assert found.nll[0] == pytest.approx(mixture(likelihood, mixed, POSE), rel=1e-6)
    numeric = by_pose(lambda pose: mixture(likelihood, mixed, pose), POSE, 1e-5)
    assert found.gradient[0] == pytest.approx(numeric, abs=1e-3, rel=1e-3)
    assert np.all(np.linalg.eigvalsh(found.information[0]) > -1e-9)
    assert np.trace(found.information[0]) < np.trace(likelihood.score(POSE, looks).information[0])
    poses = POSE + np.random.default_rng(0).normal(size=(300, 3)) * 0.5
    exact = -likelihood.score(poses, mixed).nll
    tabled = likelihood.log_likelihood(poses, mixed)
    assert np.median(np.abs(tabled - exact)) < 0.1 * np.std(exact)
    assert np.abs(tabled - exact).mean() < 0.05 * np.abs(exact).mean()


def test_a_tag_that_is_not_as_surveyed_is_no_surprise() -> None:
    likelihood, looks, mixed = doubtful(1)
    plain, given_up = (likelihood.score(POSE, replace(mixed, odds=np.full(15, odds))) for odds in (-50.0, 50.0))
    usual = likelihood.score(POSE, looks)
    for found, expected in zip(plain, usual, strict=True):
        assert found == pytest.approx(expected)
    assert given_up.nll == pytest.approx(15 * out_of_reach(likelihood, looks) - mixed.elsewhere.sum())
    assert given_up.expected == pytest.approx(given_up.nll)
    assert given_up.variance == pytest.approx(0.0, abs=1e-12)
    assert not np.any(np.abs(given_up.gradient) > 1e-12)


@pytest.mark.parametrize("name", MODELS)
def test_likelihood_of_a_tag_that_was_moved(name: str) -> None:
    """Tag by tag, at each place, as the likelihood of a map that has it there, and its mean over poses."""
    likelihood, looks, _ = doubtful(2, name)
    poses = POSE + np.random.default_rng(2).normal(size=(4, 3)) * 0.2
    tags = np.array((0, 2, 7, 11))
    states = np.array(((0.0, 0.0, 0.0, 0.0), (1.0, -0.5, 0.0, 0.0), (40.0, 0.0, 0.0, 0.0), (0.0, 0.0, -0.2, -1.0)))
    every, told, heard = likelihood.displaced(poses, looks, states, 50.0, likelihood.parameters, np.zeros(15))
    assert np.array_equal(every, np.arange(15))
    assert np.array_equal(heard, looks.hits.any(axis=0))
    found = told[tags]
    assert found.shape == (4, 4)
    for k, state in enumerate(states):
        points = likelihood.tags.points + np.append(state[:2], 0.0)
        there = RfidLikelihood(likelihood.model, replace(likelihood.tags, points=points))
        there = there.adjusted(np.concatenate((state[2:], np.zeros(len(likelihood.parameters) - 2))))
        each = np.array([there.by_tag(pose, looks)[0][tags] for pose in poses]) - out_of_reach(likelihood, looks)
        expected = np.log(np.mean(np.exp(-each), axis=0))
        assert found[:, k] == pytest.approx(expected, abs=0.15 + 0.05 * np.abs(expected).max())
    assert found[2:, 2] == pytest.approx(0.0, abs=1e-5)


ROWS = 6

LOGISTIC = LogisticModel((3.0, -0.8, -0.1, -1.5, 0.2, -0.1, -0.4, 0.8, 0.1, -0.05, 0.1))
GRID = bake(LOGISTIC, 5.0, 0.25, heights=(-1.0, 0.0, 1.0), facings=9)


def factor(model, seed, tempering=0.3):
    """Looks of two antennas from eight places at tags of which the second is the one that counts."""
    rng = np.random.default_rng(seed)
    antennas = (Antenna(0.2, -0.1, 1.0, 0.5, 0.1), Antenna(-0.1, 0.2, 1.2, -1.8, 0.0))
    tags = TagArray(np.column_stack((rng.normal(size=(3, 2)), rng.uniform(0.8, 1.4, 3))), rng.uniform(-3.0, 3.0, 3))
    likelihood = RfidLikelihood(RfidModel(antennas, (model,), 0.01, 0.02, tempering), tags)
    rounds = rng.integers(1, 4, 8)
    looks = TagReadCounts(
        rng.normal(scale=(0.3, 0.3, 0.2), size=(8, 3)),
        rng.integers(0, 2, 8),
        rounds,
        rng.integers(0, rounds[:, None] + 1, (8, 3)),
    )
    pose, tag = rng.normal(size=3), rng.normal(scale=1.5, size=2)
    return RfidTagFactor(likelihood, 1, looks), [pose, tag]


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("model", [BeamModel(), LOGISTIC, GRID], ids=["beam", "logistic", "grid"])
def test_gradients_by_pose_and_place_are_those_of_the_cost(model, seed):
    subject, values = factor(model, seed)
    residual, blocks = subject.linearize(values)
    assert residual.shape == (ROWS,)
    assert [b.shape for b in blocks] == [(ROWS, 3), (ROWS, 2)]
    assert 0.5 * residual @ residual == pytest.approx(subject.cost(values), rel=1e-6)
    numeric = np.concatenate(by_each(subject.cost, values))
    np.testing.assert_allclose(np.hstack(blocks).T @ residual, numeric, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_it_says_of_the_pose_and_of_the_place_what_the_likelihood_says_of_each(seed):
    subject, (pose, place) = factor(LOGISTIC, seed)
    nll, gradient, information = subject.score([pose, place])
    one = TagReadCounts(
        subject.counts.offsets, subject.counts.antennas, subject.counts.rounds, subject.counts.hits[:, 1:2].copy()
    )
    tags = subject.likelihood.tags
    there = TagArray(np.array([[*place, tags.points[1, 2]]]), tags.facing[1:2])
    single = RfidLikelihood(subject.likelihood.model, there)
    score = single.score(pose, one)
    assert nll == pytest.approx(float(score.nll[0]))
    np.testing.assert_allclose(gradient[:3], score.gradient[0], atol=1e-9)
    np.testing.assert_allclose(information[:3, :3], score.information[0], atol=1e-9)
    _, by_place, of_place = single.by_tag(pose, one)
    np.testing.assert_allclose(gradient[3:], by_place[0], atol=1e-9)
    np.testing.assert_allclose(information[3:, 3:], of_place[0], atol=1e-9)


def test_the_frame_is_free():
    """Robot and tag moved together, the tag's facing too, look the same: the information has no part in those three directions."""
    subject, (pose, place) = factor(BeamModel(), 3)
    frame = np.array((2.0, -1.0, 0.7))
    there = [se2.compose(frame, pose), se2.transform_from(frame, place)]
    assert subject.cost(there) == pytest.approx(subject.cost([pose, place]), rel=1e-12)
    information = subject.score([pose, place])[2]
    c, s = math.cos(pose[2]), math.sin(pose[2])
    away = place - pose[:2]
    # body-frame steps of the pose, and those of the tag, under a shift in x, in y, and a turn about the robot
    free = np.array(((c, -s, 0.0, 1.0, 0.0), (s, c, 0.0, 0.0, 1.0), (0.0, 0.0, 1.0, -away[1], away[0])))
    np.testing.assert_allclose(free @ information @ free.T, 0.0, atol=1e-9 * np.trace(information))


def test_beyond_the_reach_it_says_nothing():
    subject, (pose, _) = factor(BeamModel(), 1)
    nll, gradient, information = subject.score([pose, pose[:2] + 50.0])
    assert nll > 0.0
    assert not gradient.any()
    assert not information.any()
    residual, blocks = subject.linearize([pose, pose[:2] + 50.0])
    assert np.isfinite(residual).all()
    assert np.allclose(np.hstack(blocks), 0.0, atol=1e-4)
