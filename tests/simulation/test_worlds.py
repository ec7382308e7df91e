"""Worlds: as many tags as asked for, on the surfaces asked for, and nothing within a wall."""

import math
from itertools import pairwise

import numpy as np
import pytest
from function_calls import calls_of

from factorgraph_loc import InputError, World
from factorgraph_loc.maps.free_space import CELL, SPACING, crosses, distance_to_walls, free_space, shortest_path
from factorgraph_loc.simulation import PRESETS, preset
from factorgraph_loc.simulation.settings import DriveSettings, WorldSettings
from factorgraph_loc.simulation.simulate import drive
from factorgraph_loc.simulation.worlds import STANDOFF, make_world
from factors import se2


def world(seed=0, **settings):
    return make_world(WorldSettings(**{"tags": 20} | settings), np.random.default_rng(seed))


def places(made):
    return np.array([(t.x, t.y) for t in made.tags.values()])


@pytest.mark.parametrize("name", [name for name in PRESETS if name not in ("symmetric", "gates")])
@pytest.mark.parametrize("seed", range(3))
def test_tags_hang_on_a_surface_and_face_free_space(name, seed):
    settings = preset(name).world
    made = make_world(settings, np.random.default_rng(seed))
    assert len(made.tags) == settings.tag_count() > 0
    assert all(tag.z == settings.tag_height for tag in made.tags.values())
    np.testing.assert_allclose(distance_to_walls(made, places(made)), STANDOFF, atol=2e-3)
    facing = np.array([tag.facing for tag in made.tags.values()])
    ahead = places(made) + 0.25 * np.column_stack((np.cos(facing), np.sin(facing)))
    assert not crosses(made, places(made), ahead).any()
    inside = (ahead > 0.0) & (ahead < (settings.width, settings.depth))
    assert inside.all()


def test_tags_on_the_floor_lie_low_and_face_nowhere():
    made = world(surfaces=("floor",))
    assert len(made.tags) == 20
    assert all(tag.z == 0.0 and tag.facing is None for tag in made.tags.values())
    mixed = [tag.z for tag in world(surfaces=("wall", "floor")).tags.values()]
    assert mixed.count(0.0) == 10


def test_tags_on_shelves_alone_are_not_on_the_outline():
    made = world(plan="warehouse", width=30.0, depth=20.0, surfaces=("shelf",))
    x, y = places(made).T
    assert (np.minimum(np.minimum(x, 30.0 - x), np.minimum(y, 20.0 - y)) > 1.0).all()


def test_a_hall_with_even_tags_looks_the_same_from_both_ends():
    made = world(plan="hall", width=40.0, depth=3.0, even=True)
    turned = np.array((40.0, 3.0)) - places(made)
    gaps = np.hypot(*(turned[:, None] - places(made)[None]).transpose(2, 0, 1))
    assert gaps.min(axis=1).max() < 2e-3


def test_corridors_look_the_same_when_they_are_turned_by_half():
    made = world(plan="corridors", width=30.0, depth=24.0, tags=3)
    assert len(made.tags) == 3
    for points in (places(made), np.array(made.walls).reshape(-1, 2)):
        turned = np.array((30.0, 24.0)) - points
        gaps = np.hypot(*(turned[:, None] - points[None]).transpose(2, 0, 1))
        assert gaps.min(axis=1).max() < 2e-3


def test_the_tags_of_corridors_are_to_the_left_or_to_the_right():
    """Over 20 seeds both occur, but for one chance in half a million."""
    found = [places(world(seed, plan="corridors", width=30.0, depth=24.0, tags=3)) for seed in range(20)]
    assert {bool(tags[1, 1] < 12.0) for tags in found} == {True, False}
    for tags in found:
        np.testing.assert_allclose(tags[1] + tags[2], (30.0, 24.0), atol=1e-9)


def test_tags_are_spread_wider_than_at_random():
    """Drawn without a choice, 40 tags in this office have their nearest neighbour at 0.5 m to 1.2 m, in the median."""
    gaps = []
    for seed in range(10):
        at = places(world(seed, tags=40))
        distance = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1)) + 1e9 * np.eye(40)
        gaps.append(np.median(distance.min(axis=1)))
    assert min(gaps) > 1.5


def test_landmarks_are_in_the_map():
    made = world(landmarks=7)
    assert len(made.landmarks) == 7
    assert all(math.isfinite(m.x) for m in made.landmarks.values())


def driven(name, seed, **settings):
    world = make_world(preset(name).world, np.random.default_rng(seed))
    return world, drive(world, DriveSettings(**settings), np.random.default_rng(seed + 1000))


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("seed", range(4))
def test_no_wall_is_crossed_or_touched(name, seed):
    world, truth = driven(name, seed, duration=300.0)
    at = truth.poses[:, :2]
    assert not crosses(world, at[:-1], at[1:]).any()
    assert distance_to_walls(world, at).min() > 0.15


def test_the_least_clearance_and_the_largest_speed_cross_no_wall_either():
    for seed in range(4):
        world, truth = driven("office", seed, duration=300.0, clearance=0.25, speed=1.5, turn_rate=2.0)
        at = truth.poses[:, :2]
        assert not crosses(world, at[:-1], at[1:]).any()


@pytest.mark.parametrize(("speed", "turn_rate", "rate"), [(0.5, 1.0, 10.0), (1.0, 0.5, 25.0)])
def test_limits_hold(speed, turn_rate, rate):
    _, truth = driven("warehouse", 3, duration=120.0, speed=speed, turn_rate=turn_rate, rate=rate)
    np.testing.assert_allclose(np.diff(truth.t), 1.0 / rate)
    assert truth.t[0] == 0.0
    assert truth.t[-1] == pytest.approx(120.0)
    moves = se2.between(truth.poses[:-1], truth.poses[1:])
    assert (np.hypot(moves[:, 0], moves[:, 1]) * rate).max() <= speed + 1e-9
    assert (np.abs(moves[:, 2]) * rate).max() <= turn_rate + 1e-9


def test_a_robot_gets_around():
    """In ten minutes at 0.5 m/s: not much is lost on turns, and most rooms are visited."""
    for seed in range(3):
        _, truth = driven("office", seed)
        assert np.hypot(*np.diff(truth.poses[:, :2], axis=0).T).sum() > 0.8 * 600.0 * 0.5
        x, y = truth.poses[:, :2].T
        rooms = {(int(a / 5.0), b > 6.0) for a, b in zip(x, y, strict=True) if abs(b - 6.0) > 1.5}
        assert len(rooms) >= 4


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


def test_the_python_calls_of_free_space_do_not_grow_with_the_walls():
    edge = [(0.0, 0.0, 20.0, 0.0), (20.0, 0.0, 20.0, 20.0), (20.0, 20.0, 0.0, 20.0), (0.0, 20.0, 0.0, 0.0)]

    def calls(walls):
        world = World(name="hall", walls=walls)
        return sum(
            calls_of(lambda: (free_space(world, 0.3), crosses(world, np.zeros((9, 2)), np.ones((9, 2))))).values()
        )

    calls(edge)  # compiles
    cut = [(x, 0.0, x + 0.01, 0.0) for x in np.arange(0.0, 20.0, 0.02).tolist()]  # the lower wall in a thousand pieces
    assert calls([*edge[1:], *cut]) < 1.1 * calls(edge)


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


def test_fixed_antennas_are_at_doors_and_then_on_walls():
    made = world(tags=0, antennas=20)
    at = np.array([(a.x, a.y) for a in made.antennas.values()])
    yaw = np.array([a.yaw for a in made.antennas.values()])
    assert list(made.antennas)[:2] == ["A000", "A001"]
    ahead = at + 0.5 * np.column_stack((np.cos(yaw), np.sin(yaw)))
    assert not crosses(made, at, ahead).any()
    doors, walls = distance_to_walls(made, at[:16]), distance_to_walls(made, at[16:])
    assert doors.min() > 0.4  # half of a door, whose both sides have an antenna
    np.testing.assert_allclose(walls, STANDOFF, atol=2e-3)
    assert sorted(np.round(yaw[:16], 3).tolist()) == [-1.571] * 8 + [1.571] * 8
