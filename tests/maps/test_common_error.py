"""What the points of a map have in common where the drive that made it had no reference."""

from dataclasses import replace

import numpy as np
import pytest

from factorgraph_loc.maps.common_error import LEAST, CommonError, carried, without_common
from factorgraph_loc.maps.points import PointMap
from factors import se2

SIGMAS = (0.1, 0.2, 0.05)  # m, m, rad


def a_map(places, headings, covariances):
    """A point 2 m ahead of each of ``places`` (K, 2), seen from there with the error that is common there."""
    ahead = np.column_stack((np.cos(headings), np.sin(headings)))
    positions = np.column_stack((places + 2.0 * ahead, np.ones(len(places))))
    own = np.diag((0.03, 0.04, 0.05)) ** 2
    total = np.repeat(own[None], len(places), axis=0)
    total[:, :2, :2] += carried(covariances, 2.0 * ahead)[:, :2, :2]
    return PointMap(
        tuple(f"p{i}" for i in range(len(places))),
        positions,
        total,
        "colour",
        np.arange(len(places)),
        np.zeros((len(places), 4), dtype=np.float32),
        np.column_stack((places, np.full(len(places), 0.9))),
        covariances,
    )


def test_an_error_is_that_of_the_place_from_which_the_same_was_seen():
    scales = np.array((1.0, 4.0, 9.0))
    covariances = scales[:, None, None] * np.diag(np.square(SIGMAS))
    error = CommonError.of(
        a_map(np.array(((0.0, 0.0), (0.0, 0.0), (5.0, 0.0))), np.array((0.0, 3.0, 0.0)), covariances)
    )
    # two looks from one place are of one keyframe; those of different keyframes do not lie on each other
    assert len(error.places) == 2
    there = np.array(((0.0, 0.0, 0.0), (5.1, 0.0, 0.1), (4.9, 0.0, -6.2)))
    np.testing.assert_allclose(error.at(there)[0], covariances[0])
    np.testing.assert_allclose(error.at(there)[1:, 2, 2], covariances[2, 2, 2])
    turned = a_map(np.array(((0.0, 0.0), (0.1, 0.0))), np.array((0.0, np.pi)), covariances[:2])
    np.testing.assert_allclose(CommonError.of(turned).at(np.array(((0.0, 0.0, 3.1),)))[0, 2, 2], covariances[1, 2, 2])
    # a camera that looks back
    looking_back = CommonError.of(turned).at(np.array(((0.0, 0.0, 0.0),)), looking=np.pi)
    np.testing.assert_allclose(looking_back[0, 2, 2], covariances[1, 2, 2])


def test_an_error_is_carried_as_by_a_rigid_body():
    rng = np.random.default_rng(0)
    errors = rng.multivariate_normal(np.zeros(3), np.diag(np.square(SIGMAS)) / 100.0, size=20_000)
    place, arm = np.array((1.0, 2.0, 0.0)), np.array((3.0, -1.0))
    moved = se2.compose(se2.compose(place, errors), np.array((*arm, 0.0)))
    found = np.cov((moved - np.append(place[:2] + arm, 0.0)).T)
    expected = carried(np.diag(np.square(SIGMAS))[None] / 100.0, arm[None])[0]
    np.testing.assert_allclose(found, expected, atol=0.03 * np.trace(expected))


def test_points_have_an_error_of_their_own_beside_it():
    points = a_map(np.zeros((1, 2)), np.array((0.3,)), np.diag(np.square(SIGMAS))[None])
    np.testing.assert_allclose(without_common(points).covariances[0], np.diag((0.03, 0.04, 0.05)) ** 2, atol=1e-12)
    tight = replace(points, covariances=0.5 * points.covariances)
    assert np.linalg.eigvalsh(without_common(tight).covariances).min() == pytest.approx(LEAST**2)


def test_a_map_with_a_reference_has_none():
    points = a_map(np.zeros((1, 2)), np.zeros(1), np.eye(3)[None])
    assert CommonError.of(replace(points, common=None)) is None
    assert without_common(replace(points, common=None)).covariances is points.covariances
    assert CommonError.of(PointMap.of(("a",), np.zeros((1, 3)))) is None
