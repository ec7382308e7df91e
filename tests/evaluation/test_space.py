"""Errors of poses in space, against what they are by construction."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factorgraph_loc.evaluation import space
from factorgraph_loc.model.trajectory3 import Trajectory3

T = np.arange(0.0, 2.0, 0.05)
TURN, SHIFT = np.array((0.0, 0.02, 0.0)), np.array((0.03, 0.0, 0.04))


def truth(t=T):
    rotations = Rotation.from_rotvec(np.column_stack((0.1 * t, -0.2 * t, 0.3 * t))).as_matrix()
    return Trajectory3(t, np.column_stack((t, 0.5 * t, -t)), rotations)


def off(t=T, sigma=0.1):
    """Turned by 0.02 rad and shifted by 0.05 m in its own frame, with a covariance that says ``sigma`` of each value."""
    right = truth(t)
    turned = Rotation.from_rotvec(TURN).as_matrix()
    spread = np.repeat(sigma**2 * np.eye(6)[None], len(t), axis=0)
    return Trajectory3(t, right.positions + right.rotations @ SHIFT, right.rotations @ turned, spread)


def test_an_error_that_is_known():
    figures = space.accuracy(off(), truth())
    assert figures["space_position_rmse"] == pytest.approx(0.05)
    assert figures["space_position_max"] == pytest.approx(0.05)
    assert figures["space_rotation_rmse"] == pytest.approx(0.02)
    assert figures["space_anees"] == pytest.approx((0.02**2 + 0.05**2) / 0.1**2)
    assert figures["space_coverage_95"] == 1.0
    assert figures["space_scored"] == len(T) / 2  # at most ten a second


def test_a_covariance_that_says_too_little_is_seen():
    assert space.accuracy(off(sigma=0.01), truth())["space_coverage_95"] == 0.0


def test_where_the_reference_has_a_gap_or_ends_nothing_is_scored():
    kept = (T < 0.5) | (T > 1.0)
    whole = truth()
    gappy = Trajectory3(T[kept], whole.positions[kept], whole.rotations[kept])
    late = np.append(T, 5.0)
    # from 0 s and from 1.05 s on, twenty stamps a second of which each second one is scored
    assert space.accuracy(off(late), gappy)["space_scored"] == 15
    assert space.accuracy(off(late[-1:]), gappy)["space_scored"] == 0


def test_a_reference_of_few_poses_is_met_between_the_estimates():
    t = np.arange(0.033, 1.9, 0.13)
    figures = space.accuracy(off(), truth(t))
    assert figures["space_scored"] == len(t)
    assert figures["space_position_rmse"] == pytest.approx(0.05, abs=1e-3)
    assert figures["space_rotation_rmse"] == pytest.approx(0.02, abs=1e-3)
    assert figures["space_anees"] == pytest.approx((0.02**2 + 0.05**2) / 0.1**2, rel=0.05)
    assert space.accuracy(off(), truth(t), max_gap=0.04)["space_scored"] == 0
