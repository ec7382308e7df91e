"""The grid filter against closed forms: motion moves it exactly, noise adds its covariance, Gaussians multiply."""

import numpy as np
import pytest
from rfid_benchmark.grid_filter import GridFilter

from factorgraph_loc.model.belief import PosePrior
from factors import se2
from factors.motion import Increment, propagate

LOW, HIGH = np.array((-1.0, -1.0)), np.array((5.0, 3.0))


def prior(sigmas=(0.1, 0.07, 0.06), pose=(1.0, 1.0, 0.4)):
    return PosePrior(0.0, np.array(pose), np.diag(np.square(sigmas)))


def test_it_begins_as_its_prior():
    given = prior()
    mean, covariance = GridFilter(given, LOW, HIGH).moments()
    assert mean == pytest.approx(given.pose, abs=1e-5)
    assert covariance == pytest.approx(given.covariance, rel=1e-3, abs=1e-7)


def test_motion_by_parts_of_a_cell_does_not_diffuse():
    """A hundred steps of 13 mm in a circle, whose noise is next to none: the linearisation differs by less."""
    step = Increment(np.array((0.013, 0.002, 0.05)), 1e-9 * np.eye(3), 0.1)
    given = prior((0.05, 0.04, 0.04), (2.0, 1.0, 3.0))
    grid = GridFilter(given, LOW, HIGH)
    pose, covariance = given.pose, se2.world_to_body(given.pose, given.covariance)
    for _ in range(100):
        grid.predict(step)
        pose, covariance = se2.compose(pose, step.delta), propagate(covariance, step)
    mean, found = grid.moments()
    assert mean == pytest.approx(pose, abs=2e-3)
    assert found == pytest.approx(se2.body_to_world(pose, covariance), rel=0.01, abs=1e-5)


def test_noise_adds_its_covariance():
    """Thirty steps whose noise is a tenth of a cell, heading and place correlated, against 200,000 samples: a variance of theirs
    has a standard deviation of 0.3 %; false alarm at five of them below one in 100,000."""
    noise = np.array(((2e-5, 3e-6, 0.0), (3e-6, 4e-5, 6e-5), (0.0, 6e-5, 3e-4)))
    step = Increment(np.array((0.06, 0.01, 0.08)), noise, 0.1)
    given = prior((0.04, 0.04, 0.05), (2.0, 0.5, 0.0))
    grid = GridFilter(given, LOW, HIGH)
    rng = np.random.default_rng(3)
    poses = rng.multivariate_normal(given.pose, given.covariance, 200_000)
    root = np.linalg.cholesky(noise).T
    for _ in range(30):
        grid.predict(step)
        poses = se2.compose(poses, se2.compose(step.delta, se2.exp(rng.standard_normal(poses.shape) @ root)))
    expected = np.cov(poses.T)
    mean, found = grid.moments()
    assert mean == pytest.approx(poses.mean(axis=0), abs=2e-3)
    sigmas = np.sqrt(np.diag(expected))
    assert found / np.outer(sigmas, sigmas) == pytest.approx(expected / np.outer(sigmas, sigmas), abs=0.016)


def test_more_noise_than_a_cell_holds_takes_several_passes():
    noise = np.diag((0.15, 0.12, 0.08)) ** 2
    given = prior((0.1, 0.1, 0.1), (2.0, 1.0, 0.0))
    grid = GridFilter(given, LOW, HIGH)
    grid.predict(Increment(np.zeros(3), noise, 0.1))
    _, found = grid.moments()
    assert found[2, 2] == pytest.approx(given.covariance[2, 2] + noise[2, 2], rel=1e-3)
    # turned with the heading, whose spread mixes x and y a little
    assert np.diag(found)[:2] == pytest.approx(np.diag(given.covariance + noise)[:2], rel=0.01)


def test_an_update_multiplies():
    given = prior()
    grid = GridFilter(given, LOW, HIGH)
    measured, sigma = np.array((1.08, 0.95, 0.35)), 0.08

    def log_likelihood(poses):
        return -0.5 * np.sum(((poses - measured) / sigma) ** 2, axis=1) - 1e4

    grid.update(log_likelihood)
    expected = np.linalg.inv(np.linalg.inv(given.covariance) + np.eye(3) / sigma**2)
    mean, covariance = grid.moments()
    assert covariance == pytest.approx(expected, rel=2e-3, abs=1e-7)
    assert mean == pytest.approx(
        expected @ (np.linalg.solve(given.covariance, given.pose) + measured / sigma**2), abs=1e-4
    )


def test_headings_go_around():
    grid = GridFilter(prior(pose=(1.0, 1.0, np.pi - 0.01)), LOW, HIGH)
    grid.predict(Increment(np.array((0.1, 0.0, 0.03)), 1e-6 * np.eye(3), 0.1))
    mean, covariance = grid.moments()
    assert mean[2] == pytest.approx(-np.pi + 0.02, abs=1e-4)
    assert covariance[2, 2] == pytest.approx(0.06**2, rel=2e-3)
