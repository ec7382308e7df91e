"""Rotations of mountings and of quaternions, against scipy's, whose import takes a quarter of a second."""

import numpy as np
from scipy.spatial.transform import Rotation

from factorgraph_loc.model.planar import Mounting, rotations_of


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
