"""The factor of a tag whose place is not known: exact value and gradient, and what moves pose and tag together changes nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numerical import by_each

from factors import se2
from factors.rfid.detection import RfidLikelihood, TagArray, TagReadCounts
from factors.rfid.factor import RfidTagFactor
from factors.rfid.model import Antenna, BeamModel, LogisticModel, RfidModel, bake

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
