"""Bends of a reference against the map made with it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factorgraph_loc.mapping.bends import Bends
from factorgraph_loc.mapping.image_localization import Located
from factorgraph_loc.mapping.triangulation import Cameras

NOTHING = np.empty(0, dtype=np.int64)
SIGMA = 2e-4  # m, rad: of a place in the map
BEND = 0.01  # m, rad per sqrt(m)


def a_walk(rng, count=200, step=0.03, bend=BEND):
    """True cameras along a line, and a reference of them that is off by a random walk of ``bend`` per sqrt(m) about each axis."""
    turns = Rotation.from_rotvec(0.01 * rng.standard_normal((count, 3)).cumsum(axis=0))
    true = Cameras(np.column_stack((step * np.arange(count), np.zeros((count, 2)))), turns.as_matrix())
    apart = np.hypot(step, 0.8 * 0.01 * np.sqrt(3.0))
    errors = bend * np.sqrt(apart) * rng.standard_normal((count, 6)).cumsum(axis=0)
    reference = Cameras(
        true.positions - np.einsum("nij,nj->ni", true.rotations, errors[:, 3:]),
        true.rotations @ Rotation.from_rotvec(-errors[:, :3]).as_matrix(),
    )
    return true, reference


def places(rng, cameras):
    noise = SIGMA * rng.standard_normal((len(cameras), 6))
    turned = cameras.rotations @ Rotation.from_rotvec(noise[:, :3]).as_matrix()
    return [
        Located(position + SIGMA * rng.standard_normal(3), rotation, SIGMA**2 * np.eye(6), NOTHING, NOTHING)
        for position, rotation in zip(cameras.positions, turned, strict=True)
    ]


def off(found, position, rotation):
    turn = Rotation.from_matrix(rotation.T @ found.rotation).as_rotvec()
    return np.concatenate((turn, found.rotation.T @ (found.position - position)))


def test_a_place_between_cameras_is_where_their_reference_has_it():
    """Every second camera makes the map; the errors of the others in it are the bends, and are in the covariances."""
    rng = np.random.default_rng(0)
    true, reference = a_walk(rng)
    located = places(rng, true)
    bends = Bends.of(reference[::2], located[::2])
    raw, better, squared = [], [], []
    for i in range(1, len(true), 2):
        found = bends.in_reference(located[i])
        error = off(found, reference.positions[i], reference.rotations[i])
        raw.append(off(located[i], reference.positions[i], reference.rotations[i]))
        better.append(error)
        squared.append(error @ np.linalg.solve(found.covariance, error))
    assert np.std(better) < 0.3 * np.std(raw)
    assert 2.0 < np.mean(squared) < 9.0  # 6 at a whole distance between cameras; these are half of it away


def test_far_from_the_cameras_bends_are_not_known():
    rng = np.random.default_rng(1)
    true, reference = a_walk(rng)
    bends = Bends.of(reference[:100], places(rng, true[:100]))
    (far,) = places(rng, true[150:151])
    found = bends.in_reference(far)
    np.testing.assert_allclose(found.position, far.position, atol=1e-9)
    spread = np.diag(found.covariance - far.covariance) / (true.positions[150] - true.positions[99])[0]
    assert np.all((spread > 0.2 * BEND**2) & (spread < 5.0 * BEND**2))


def test_images_together_have_an_error_in_common_that_an_image_alone_has_not():
    """The graph is off by what is not known of the bends, each image alone by noise of its own."""
    rng = np.random.default_rng(2)
    true, reference = a_walk(rng)
    bends = Bends.of(reference[:100], places(rng, true[:100]))
    common = 0.5 * BEND * np.sqrt(true.positions[150, 0] - true.positions[99, 0])
    slid = [replace(place, position=place.position + common) for place in places(rng, true)]
    for noise, limit in ((2e-4, 0.1), (0.05, 1.05)):  # of its own, and what remains of the common error
        covariance = noise**2 * np.eye(6)
        found = [
            bends.combined(replace(one, position=p + noise * rng.standard_normal(3), covariance=covariance), both)
            for p, one, both in zip(true.positions[145:155], slid[145:155], slid[145:155], strict=True)
        ]
        errors = np.array([place.position for place in found]) - true.positions[145:155]
        assert np.sqrt(np.mean(errors**2)) < limit * common
        assert all(np.linalg.eigvalsh(covariance - place.covariance)[0] > -1e-9 for place in found)


def test_of_two_places_that_contradict_each_other_the_map_tells_which_is_right():
    rng = np.random.default_rng(2)
    true, reference = a_walk(rng)
    found = places(rng, true)
    bends = Bends.of(reference[:100], found[:100])
    seen = replace(found[50], points=np.arange(20), features=np.arange(20))
    assert bends.combined(seen, found[90]) is seen
    assert bends.combined(found[90], seen) is seen
    assert bends.combined(None, found[50]) is found[50]
    assert bends.combined(found[50], None) is found[50]


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_places_tell_no_bends(count):
    rng = np.random.default_rng(3)
    true, reference = a_walk(rng, 3)
    found = places(rng, true)
    bends = Bends.of(reference, [*found[:count], *[None] * (3 - count)])
    assert bends.in_reference(found[2]) is found[2]
    assert bends.in_reference(None) is None
