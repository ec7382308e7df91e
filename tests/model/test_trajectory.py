"""Trajectories: interpolation along the arc, and the TUM format."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tum_files import read_tum

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
