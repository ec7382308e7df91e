"""Candidate paths, how far they can be driven, and what a proximity sensor finds on the way."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factorgraph_loc.maps.free_space import CELL, crosses, distance_to_walls, free_space
from factorgraph_loc.model.world import World
from factorgraph_loc.planning.paths import STEP, Path, free_steps, primitives, waypoint_paths, waypoints
from factorgraph_loc.planning.robot import SIGMA, TEMPERING, UNEXPECTED, ProximitySensor
from factorgraph_loc.simulation import preset
from factorgraph_loc.simulation.worlds import make_world
from factors import se2

CLEARANCE = 0.3
ROOM = World(walls=((0.0, 0.0, 10.0, 0.0), (10.0, 0.0, 10.0, 6.0), (10.0, 6.0, 0.0, 6.0), (0.0, 6.0, 0.0, 0.0)))


@pytest.fixture(scope="module")
def office():
    world = make_world(preset("office").world, np.random.default_rng(4))
    return world, free_space(world, CLEARANCE)


def straight(length):
    (found,) = [p for p in primitives(length) if p.length > 0.9 * length and not p.poses[:, 1:].any()]
    return found


@settings(max_examples=30)
@given(st.floats(0.3, 20.0))
def test_primitives_have_their_length_and_start_at_the_robot(length):
    paths = primitives(length)
    assert 30 <= len(paths) <= 60
    for path in paths:
        np.testing.assert_array_equal(path.poses[0], 0.0)
        assert np.diff(path.metres).max() <= STEP + 1e-9
        assert path.length == pytest.approx(length) or path.length == pytest.approx(length / 2.0)
        # the robot drives forwards: along its heading, or on an arc
        steps = se2.log(se2.between(path.poses[:-1], path.poses[1:]))
        np.testing.assert_allclose(steps[:, 1], 0.0, atol=1e-9)
        assert (steps[:, 0] > -1e-9).all()


def test_a_turn_takes_time_and_no_way():
    straight_back = Path(np.array(((0.0, 0.0, 0.0), (0.0, 0.0, math.pi), (-1.0, 0.0, math.pi))), "arc")
    assert straight_back.length == pytest.approx(1.0)
    assert straight_back.passed(0.5)[-1] == pytest.approx(1.0 + 0.5 * math.pi)


def test_ways_to_places_go_through_no_wall(office):
    world, space = office
    rng = np.random.default_rng(0)
    targets = waypoints(space, 40)
    for _ in range(5):
        pose = np.array((*space.centres[rng.integers(len(space.centres))], rng.uniform(-3.0, 3.0)))
        paths = waypoint_paths(space, pose, targets)
        assert len(paths) >= 39
        for path in paths:
            at = se2.compose(pose, path.poses)[:, :2]
            assert not crosses(world, at[:-1], at[1:]).any()
            assert distance_to_walls(world, at).min() > CLEARANCE - CELL
            np.testing.assert_allclose(at[0], pose[:2])
            assert np.hypot(*(targets - at[-1]).T).min() < 1e-9


def test_a_way_to_a_place_in_sight_is_straight_and_others_are_the_shortest():
    space = free_space(ROOM, CLEARANCE)
    pose = np.array((2.0, 3.0, 1.0))
    (path,) = waypoint_paths(space, pose, np.array(((8.05, 3.05),)))
    cell = space.centres[space.cells(np.array(((8.05, 3.05),)))[0]]
    assert path.length == pytest.approx(math.hypot(*(cell - pose[:2])), rel=1e-6)
    # a wall up to 5 of 6 m: the way leads around its end
    split = World(walls=(*ROOM.walls, (5.0, 0.0, 5.0, 5.0)))
    (around,) = waypoint_paths(free_space(split, CLEARANCE), np.array((4.0, 2.0, 0.0)), np.array(((6.0, 2.0),)))
    shortest = 2.0 * math.hypot(1.0, 3.0)
    assert shortest < around.length < 1.15 * shortest + 2.0 * CLEARANCE


def test_no_way_to_a_place_within_a_wall_or_where_the_robot_is():
    space = free_space(ROOM, CLEARANCE)
    here = np.array((2.0, 3.0, 0.0))
    assert waypoint_paths(space, here, np.array(((0.1, 0.1), (-5.0, 3.0), (2.0, 3.0)))) == []


def test_a_robot_too_close_to_a_wall_has_ways_too():
    space = free_space(ROOM, CLEARANCE)
    (path,) = waypoint_paths(space, np.array((0.1, 3.0, 0.0)), np.array(((5.0, 3.0),)))
    np.testing.assert_array_equal(path.poses[0], 0.0)
    assert path.length == pytest.approx(4.9, abs=CELL)


def test_waypoints_are_spread(office):
    _, space = office
    found = waypoints(space, 30)
    assert len(np.unique(found, axis=0)) == 30
    # nowhere is farther from all of them than any two of them are apart
    apart = np.hypot(*(found[:, None] - found[None]).transpose(2, 0, 1)) + 1e9 * np.eye(30)
    nearest = np.hypot(*(space.centres[:, None] - found[None]).transpose(2, 0, 1)).min(axis=1)
    assert nearest.max() <= apart.min() + 1e-9
    assert len(waypoints(space, 10**6)) == len(space.centres)


def free_length(space, poses, path):
    return path.metres[free_steps(space, poses, [path])[0]]


def test_free_length_agrees_with_distances_to_walls(office):
    world, space = office
    rng = np.random.default_rng(1)
    poses = np.column_stack((space.centres[rng.integers(len(space.centres), size=200)], rng.uniform(-3.1, 3.1, 200)))
    paths = primitives(6.0)
    steps = free_steps(space, poses, paths)
    free, before, after, beyond = [], [], [], []
    for path, last in zip(paths, steps, strict=True):
        np.testing.assert_array_equal(free_length(space, poses, path), path.metres[last])
        for pose, end in zip(poses[:20], last[:20].tolist(), strict=True):
            at = se2.compose(pose, path.poses)[:, :2]
            free.append(at[: end + 1])
            before.append(at[:end])
            after.append(at[1 : end + 1])
            beyond.append(at[end + 1 : end + 2])
    free, before, after, beyond = (np.concatenate(points) for points in (free, before, after, beyond))
    assert distance_to_walls(world, free).min() > CLEARANCE - CELL * math.sqrt(0.5)
    assert not crosses(world, before, after).any()
    assert distance_to_walls(world, beyond).max() < CLEARANCE + CELL * math.sqrt(0.5)
    assert len(beyond) > 100


def test_a_robot_at_a_wall_may_leave_it_but_not_go_through():
    space = free_space(ROOM, CLEARANCE)
    path = straight(2.0)
    off, into, outside = np.array(((0.15, 3.0, 0.0), (0.15, 3.0, math.pi), (-4.0, 3.0, 0.0)))
    np.testing.assert_allclose(free_length(space, np.array((off, into, outside)), path), (2.0, 0.0, 0.0), atol=1e-9)


SIGHT, APART = 3.0, 0.35


@pytest.fixture(scope="module")
def sensor() -> ProximitySensor:
    """In the corridors of an H, 3 m wide: arms along y at both ends, a crossbar along x at y = 12 m."""
    return ProximitySensor(free_space(make_world(preset("symmetric").world, np.random.default_rng(0)), APART), SIGHT)


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
