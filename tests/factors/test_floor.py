"""How level a floor is, from the tilt that images tell."""

import numpy as np
import pytest

from factors.camera.model import SCALES, TiltScale

GUESS = 0.005
PRIOR = GUESS  # of the tilt in an image
SPREAD = np.diag((1.5e-3, 2.5e-3)) ** 2  # of what an image tells of it, in rad


def seen(tilt, rng):
    """Posterior mean and covariance of a tilt."""
    covariance = np.linalg.inv(np.linalg.inv(SPREAD) + np.eye(2) / PRIOR**2)
    return covariance @ np.linalg.solve(SPREAD, rng.multivariate_normal(tilt, SPREAD)), covariance, PRIOR


@pytest.mark.parametrize("scale", [0.004, 0.01, 0.03])
def test_the_scale_of_the_tilt_is_learnt(scale):
    """Over 20 floors: a scale is known from 60 images to 1 / sqrt(240) = 6 %, and to more where noise hides it."""
    for seed in range(20):
        rng, floor = np.random.default_rng(seed), TiltScale.guessed(GUESS)
        for _ in range(120):
            floor, _ = floor.learnt(*seen(scale * rng.standard_normal(2), rng))
        assert floor.sigma == pytest.approx(scale, rel=0.4)


def test_a_level_floor_is_found_to_be_level():
    for seed in range(20):
        rng, floor = np.random.default_rng(seed), TiltScale.guessed(GUESS)
        for _ in range(120):
            floor, _ = floor.learnt(*seen(np.zeros(2), rng))
        assert SCALES[0] < floor.sigma < 0.0015


def test_what_tells_nothing_changes_nothing():
    floor = TiltScale.guessed(GUESS)
    for _ in range(100):
        floor, here = floor.learnt(np.zeros(2), PRIOR**2 * np.eye(2) * (1.0 - 1e-9), PRIOR)
        assert floor.sigma == pytest.approx(GUESS, rel=0.02)
        assert here == pytest.approx(GUESS, rel=0.1)  # it may be a sill


def test_a_sill_on_a_level_floor_is_a_tilt_of_that_image_alone():
    rng, floor = np.random.default_rng(0), TiltScale.guessed(GUESS)
    for _ in range(60):
        floor, _ = floor.learnt(*seen(np.zeros(2), rng))
    floor, here = floor.learnt(*seen(np.array((0.03, -0.02)), rng))
    assert here > 0.015
    assert floor.sigma < 0.002
    assert floor.learnt(*seen(np.zeros(2), rng))[1] < 0.002
