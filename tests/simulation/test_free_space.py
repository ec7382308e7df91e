"""Free space: which cells belong to it, lines of sight, and shortest paths."""

import math
from itertools import pairwise

import numpy as np
import pytest

from factorgraph_loc import InputError, World
from factorgraph_loc.maps.free_space import CELL, SPACING, crosses, distance_to_walls, free_space, shortest_path
from factorgraph_loc.simulation import preset
from factorgraph_loc.simulation.worlds import make_world


@pytest.fixture(scope="module")
def office():
    world = make_world(preset("office").world, np.random.default_rng(2))
    return world, free_space(world, 0.3)


def test_cells_are_found_again_and_keep_clear_of_walls(office):
    world, space = office
    inside = np.random.default_rng(0).uniform(-0.49, 0.49, space.centres.shape) * CELL
    np.testing.assert_array_equal(space.cells(space.centres + inside), np.arange(len(space.centres)))
    assert distance_to_walls(world, space.centres).min() > 0.3
    outside = np.array(((-1.0, 3.0), (1e6, 3.0), (3.0, -1e6), world.walls[0][:2]))
    np.testing.assert_array_equal(space.cells(outside), -1)
    i, j = np.nonzero(space.index >= 0)
    np.testing.assert_allclose(space.distance[i, j], distance_to_walls(world, space.centres)[space.index[i, j]])


def test_a_line_is_clear_where_all_its_cells_are_free(office):
    world, space = office
    rng = np.random.default_rng(1)
    counts = np.zeros(2)
    for _ in range(500):
        a, b = space.centres[rng.integers(len(space.centres), size=2)]
        points = a + np.linspace(0.0, 1.0, max(2, math.ceil(np.hypot(*(b - a)) / SPACING)))[:, None] * (b - a)
        free = bool((space.cells(points) >= 0).all())
        assert space.is_clear(a, b) == free
        counts[int(free)] += 1
        assert not (free and crosses(world, a[None], b[None])[0])
    assert counts.min() > 10
    assert not space.is_clear(space.centres[0], np.array((-50.0, -50.0)))


def test_paths_join_their_ends_over_free_cells(office):
    _, space = office
    rng = np.random.default_rng(2)
    for _ in range(20):
        start, end = rng.integers(len(space.centres), size=2).tolist()
        corners = shortest_path(space, start, end)
        np.testing.assert_array_equal(corners[[0, -1]], space.centres[[start, end]])
        assert all(space.is_clear(a, b) for a, b in pairwise(corners))


def test_a_world_without_room_is_an_error():
    with pytest.raises(InputError, match="has no walls"):
        free_space(World(), 0.3)
    box = World(walls=((0.0, 0.0, 0.5, 0.0), (0.5, 0.0, 0.5, 0.5), (0.5, 0.5, 0.0, 0.5), (0.0, 0.5, 0.0, 0.0)))
    with pytest.raises(InputError, match=r"has no place that is 0\.3 m from all walls"):
        free_space(box, 0.3)
