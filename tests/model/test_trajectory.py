"""Trajectories: interpolation along the arc, and the TUM format."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tum_files import read_tum

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.planar import Mounting, rotations_of
from factorgraph_loc.model.scoring import Ticks, check_tick_gap
from factorgraph_loc.model.trajectory import Trajectory, write_tum


def quarter_circle():
    return Trajectory(np.array((0.0, 1.0)), np.array(((0.0, 0.0, 0.0), (1.0, 1.0, math.pi / 2))))


def test_between_poses_it_follows_the_arc():
    half = quarter_circle().at(np.array((0.5,)))[0]
    r = math.sqrt(0.5)
    np.testing.assert_allclose(half, (r, 1.0 - r, math.pi / 4))


def test_at_the_poses_it_is_exact():
    trajectory = quarter_circle()
    np.testing.assert_array_equal(trajectory.at(trajectory.t), trajectory.poses)


def test_nothing_outside_or_in_gaps():
    trajectory = Trajectory(np.array((0.0, 1.0, 5.0)), np.zeros((3, 3)))
    found = trajectory.at(np.array((-0.1, 0.5, 1.0, 3.0, 5.0, 5.1)), max_gap=1.0)
    assert np.isnan(found[:, 0]).tolist() == [True, False, False, True, False, True]
    assert np.isnan(Trajectory(np.empty(0), np.empty((0, 3))).at(np.array((0.0,)))).all()


def test_the_turn_across_pi_is_the_short_one():
    trajectory = Trajectory(np.array((0.0, 1.0)), np.array(((0, 0, 3.0), (0, 0, -3.0))))
    assert abs(trajectory.at(np.array((0.5,)))[0, 2]) == pytest.approx(math.pi)


@pytest.mark.parametrize(("t", "poses"), [((0.0, 0.0), np.zeros((2, 3))), ((0.0,), np.zeros((2, 3)))])
def test_what_is_no_trajectory(t, poses):
    with pytest.raises(ValueError, match=r"stamps|shape"):
        Trajectory(np.array(t), poses)


@given(
    st.lists(st.integers(-(10**12), 10**12), min_size=1, max_size=5, unique=True).map(sorted),
    st.integers(-2 * 10**18, 2 * 10**18),
    st.floats(-math.pi, math.pi),
)
def test_tum_comes_back_to_the_nanosecond(tmp_path_factory, stamps, t0_ns, heading):
    trajectory = Trajectory(np.array(stamps) / 1e9, np.tile((1.5, -2.25, heading), (len(stamps), 1)))
    file = tmp_path_factory.mktemp("tum") / "a.tum"
    write_tum(trajectory, file, t0_ns)
    back = read_tum(file, t0_ns)
    np.testing.assert_array_equal(back.t, trajectory.t)
    np.testing.assert_allclose(np.cos(back.poses[:, 2] - heading), 1.0)
    np.testing.assert_array_equal(back.poses[:, :2], trajectory.poses[:, :2])


def test_tilted_poses_and_comments(tmp_path):
    (tmp_path / "a.tum").write_text("\ufeff# t x y z qx qy qz qw\r\n\r\n1.0 1 2 3 0.70710678 0 0 0.70710678\r\n")
    np.testing.assert_allclose(read_tum(tmp_path / "a.tum").poses, ((1, 2, 0),), atol=1e-7)


def test_a_mounting_turns_about_x_then_y_then_z():
    for roll, pitch, yaw in np.random.default_rng(1).uniform(-6.0, 6.0, (100, 3)).tolist():
        turned = Rotation.from_euler("xyz", (roll, pitch, yaw)).as_matrix()
        np.testing.assert_allclose(Mounting(roll=roll, pitch=pitch, yaw=yaw).rotation(), turned, rtol=0, atol=1e-14)


def test_quaternions_that_are_almost_of_length_one_are_rotations():
    rng = np.random.default_rng(2)
    turns = Rotation.random(100, rng=rng)
    found = rotations_of("poses", np.arange(100), turns.as_quat() * rng.uniform(0.991, 1.009, (100, 1)))
    np.testing.assert_allclose(found, turns.as_matrix(), rtol=0, atol=1e-14)
    assert rotations_of("poses", np.arange(0), np.empty((0, 4))).shape == (0, 3, 3)


def fired(start, stamps, gap=60.0):
    ticks = Ticks(start, gap)
    found = [tick for t in stamps for tick in ticks.advance(t)]
    return [*found, *ticks.rest()], ticks


def grid(start, last):
    return (start + np.arange(np.floor((last - start) * 10 + 1e-6) + 1) / 10).tolist()


@pytest.mark.parametrize("start", [0.0, 0.1234, 1.7e9 + 0.3])
def test_they_stand_on_a_grid_across_gaps_that_are_short_enough(start):
    stamps = start + np.cumsum(np.random.default_rng(1).uniform(0.0, 1.0, 300)) + np.repeat((0.0, 59.0), 150)
    found, ticks = fired(start, stamps.tolist())
    assert found == grid(start, stamps[-1])
    assert ticks.seconds == pytest.approx(stamps[-1] - start)
    assert not ticks.skipped


def test_there_are_none_inside_a_gap_that_is_too_long():
    stamps = [0.0, 0.25, 0.5, 60.77, 61.0]
    found, ticks = fired(0.0, stamps)
    assert found == [t for t in grid(0.0, 61.0) if t <= 0.5 or t >= 60.77]
    assert ticks.skipped == [(0.5, 60.77)]
    assert ticks.seconds == pytest.approx(61.0 - 60.27)
    assert fired(0.0, stamps, 61.0)[0] == grid(0.0, 61.0)


@pytest.mark.parametrize("far", [1e6, 1.7e9, 1e17])
def test_a_clock_that_jumps_costs_nothing(far):
    found, ticks = fired(0.0, [0.0, 0.05, far, far, far + 0.5])
    assert found[0] == 0.0
    assert all(t >= far for t in found[1:])
    assert len(found) <= 8
    assert ticks.count == len(found)


def test_the_start_counts_as_measured_and_what_is_late_fills_no_gap():
    found, _ = fired(0.0, [100.0, 100.2, 300.0, 200.0, 300.1])
    assert found == pytest.approx([0.0, 100.0, 100.1, 100.2, 300.0, 300.1])


def test_what_the_setting_may_be():
    check_tick_gap(60.0)
    for wrong in (0.0, 0.5, -1.0, float("nan"), float("inf"), 1e6):
        with pytest.raises(InputError, match="tick_gap is"):
            check_tick_gap(wrong)
