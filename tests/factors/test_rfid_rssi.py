"""RSSI: the model's derivatives, its density, and what it says of a pose."""

from __future__ import annotations

import numpy as np
import pytest
from numerical import by_pose
from scipy import stats

from factors import se2
from factors.rfid.detection import TagArray
from factors.rfid.model import Antenna
from factors.rfid.signals import RssiLikelihood, RssiModel, RssiReads, features
from factors.se2 import Array

ANTENNAS = (Antenna(-0.2, -0.3, 1.0, -1.5, 0.1), Antenna(0.1, 0.2, 0.5, 0.7))
COEFFICIENTS = (-50.0, 2.2, -6.0, -1.5, 3.0, 2.0)
POSE = np.array((0.4, -0.2, 0.6))


def tags(rng: np.random.Generator, count: int = 20) -> TagArray:
    points = np.column_stack((rng.uniform(-4.0, 4.0, (count, 2)), rng.uniform(0.2, 1.8, count)))
    facing = np.where(rng.random(count) < 0.3, np.nan, rng.uniform(-3.0, 3.0, count))
    return TagArray(points, facing)


def simulated(rng: np.random.Generator, model: RssiModel, world: TagArray, count: int) -> RssiReads:
    offsets = rng.normal(0.0, (0.3, 0.3, 0.2), (count, 3))
    antennas, which = rng.integers(0, 2, count), rng.integers(0, len(world.points), count)
    reads = RssiReads(offsets, antennas, which, np.zeros(count))
    expected = features(ANTENNAS, world, POSE, reads) @ np.array(model.coefficients)
    return RssiReads(offsets, antennas, which, expected + model.sigma * rng.standard_t(model.dof, count))


@pytest.fixture
def likelihood() -> RssiLikelihood:
    model = RssiModel(ANTENNAS, COEFFICIENTS, sigma=2.0, dof=4.0, tempering=0.5)
    return RssiLikelihood(model, tags(np.random.default_rng(0)))


def test_value_is_students_density(likelihood: RssiLikelihood) -> None:
    reads = simulated(np.random.default_rng(1), likelihood.model, likelihood.tags, 50)
    residuals = reads.rssi - features(ANTENNAS, likelihood.tags, POSE, reads) @ np.array(COEFFICIENTS)
    density = stats.t(4.0, scale=2.0)
    expected = 0.5 * np.sum(density.logpdf(0.0) - density.logpdf(residuals))
    assert likelihood.score(POSE, reads).nll[0] == pytest.approx(expected)
    assert likelihood.log_likelihood(POSE[None], reads)[0] == pytest.approx(-expected)


def test_gradient_is_that_of_the_value(likelihood: RssiLikelihood) -> None:
    reads = simulated(np.random.default_rng(2), likelihood.model, likelihood.tags, 50)
    poses = POSE + np.random.default_rng(3).normal(0.0, 0.5, (5, 3))
    numeric = [by_pose(lambda p: likelihood.score(p, reads).nll[0], pose) for pose in poses]
    assert np.allclose(likelihood.score(poses, reads).gradient, numeric, rtol=1e-5, atol=1e-5)


def test_information_is_the_expected_square_of_the_gradient(likelihood: RssiLikelihood) -> None:
    """Of independent reads: the mean over 4,000 draws lies within 10 % (its own spread is 2 %)."""
    rng = np.random.default_rng(4)
    scores = [likelihood.score(POSE, simulated(rng, likelihood.model, likelihood.tags, 1)) for _ in range(4000)]
    # both are tempered, so the square of the gradient is so twice
    squared = np.mean([np.outer(s.gradient[0], s.gradient[0]) for s in scores], axis=0) / 0.5
    information: Array = np.mean([s.information[0] for s in scores], axis=0)
    assert np.abs(squared - information).max() < 0.1 * np.trace(information)
    assert np.linalg.eigvalsh(information).min() > 0.0


def test_a_tag_at_the_antenna_is_no_trouble(likelihood: RssiLikelihood) -> None:
    at = se2.transform_from(POSE, np.array((ANTENNAS[0].x, ANTENNAS[0].y)))
    world = TagArray(np.array([(*at, ANTENNAS[0].z)]), np.array([0.0]))
    reads = RssiReads(np.zeros((1, 3)), np.zeros(1, np.int64), np.zeros(1, np.int64), np.array([-40.0]))
    assert all(np.isfinite(part).all() for part in RssiLikelihood(likelihood.model, world).score(POSE, reads))
