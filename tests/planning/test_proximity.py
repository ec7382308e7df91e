"""What a proximity sensor finds, and how particles are weighed by it."""

import math

import numpy as np
import pytest

from factorgraph_loc.maps.free_space import CELL, free_space
from factorgraph_loc.planning.robot import SIGMA, TEMPERING, UNEXPECTED, ProximitySensor
from factorgraph_loc.simulation import preset
from factorgraph_loc.simulation.worlds import make_world

SIGHT, CLEARANCE = 3.0, 0.35


@pytest.fixture(scope="module")
def sensor() -> ProximitySensor:
    """In the corridors of an H, 3 m wide: arms along y at both ends, a crossbar along x at y = 12 m."""
    return ProximitySensor(
        free_space(make_world(preset("symmetric").world, np.random.default_rng(0)), CLEARANCE), SIGHT
    )


def test_lengths_are_those_to_the_walls_less_the_clearance(sensor: ProximitySensor) -> None:
    lengths = sensor.expected(np.array(((15.0, 12.0, 0.0), (1.5, 22.0, math.pi / 2.0))))
    # to the front, left, back and right: 1.5 m from the walls of the crossbar; 2 m from the end of an arm
    assert lengths[0, [0, 3, 6, 9]] == pytest.approx([3.0, 1.15, 3.0, 1.15], abs=0.25 + CELL)
    assert lengths[1, [0, 3, 6, 9]] == pytest.approx([1.65, 1.15, 3.0, 1.15], abs=0.25 + CELL)
    assert lengths.max() <= SIGHT


def test_readings_scatter_as_they_are_weighed(sensor: ProximitySensor) -> None:
    """Of 4,000 readings where no length is near either end: mean and standard deviation miss by a twentieth of sigma in less than
    one of 500 cases each."""
    pose = np.array((15.0, 12.0, 0.0))
    rng = np.random.default_rng(0)
    drawn = np.array([sensor.read(pose, rng)[3] for _ in range(4000)])
    assert abs(drawn.mean() - sensor.expected(pose[None])[0, 3]) < 0.05 * SIGMA
    assert abs(drawn.std() - SIGMA) < 0.05 * SIGMA
    assert min(sensor.read(pose, rng).min() for _ in range(100)) >= 0.0
    assert max(sensor.read(pose, rng).max() for _ in range(100)) <= SIGHT


def test_likelihood_is_the_formula(sensor: ProximitySensor) -> None:
    pose = np.array((15.0, 12.0, 0.0))
    exact = sensor.expected(pose[None])[0]
    shifted = exact.copy()
    shifted[2] += 2.0 * SIGMA
    best, worse = (sensor.log_likelihood(pose[None], lengths)[0] for lengths in (exact, shifted))
    assert best == pytest.approx(0.0, abs=1e-12)
    assert worse == pytest.approx(TEMPERING * math.log((1.0 - UNEXPECTED) * math.exp(-2.0) + UNEXPECTED))
    # whatever one length says, it can be one of those that are anything
    shifted[2] += 100.0
    assert sensor.log_likelihood(pose[None], shifted)[0] > TEMPERING * math.log(UNEXPECTED) - 1e-9


def test_an_h_looks_the_same_when_it_is_turned_by_half(sensor: ProximitySensor) -> None:
    """To the last bit: where cells at one wall were free and those at the other not, a robot would know the end that it is at."""
    rng = np.random.default_rng(0)
    places = rng.choice(sensor.space.centres, 2000) + CELL * (rng.random((2000, 2)) - 0.5)
    poses = np.column_stack((places, rng.uniform(-math.pi, math.pi, 2000)))
    turned = np.column_stack((30.0 - poses[:, 0], 24.0 - poses[:, 1], poses[:, 2] + math.pi))
    assert np.array_equal(sensor.expected(poses), sensor.expected(turned))
