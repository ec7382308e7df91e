"""Drives: through doors, not through walls, within the limits."""

import numpy as np
import pytest

from factorgraph_loc.maps.free_space import crosses, distance_to_walls
from factorgraph_loc.simulation import PRESETS, preset
from factorgraph_loc.simulation.settings import DriveSettings
from factorgraph_loc.simulation.simulate import drive
from factorgraph_loc.simulation.worlds import make_world
from factors import se2


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
