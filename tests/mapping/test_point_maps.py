"""Maps of points that are merged and thinned."""

import numpy as np
import pytest

from factorgraph_loc import InputError, PointMap
from factorgraph_loc.mapping.point_maps import merged, thinned

SIGMA = 0.02


def drive(seed, which, noise=SIGMA):
    """Points of a hall as one drive maps them: 400 places with a look each, seen twice, and errors of its own."""
    hall, rng = np.random.default_rng(1), np.random.default_rng(seed)
    places, looks = hall.uniform((0.0, 0.0, 0.0), (10.0, 5.0, 2.0), (400, 3)), hall.normal(size=(400, 64))
    owners = np.repeat(np.arange(len(which)), 2)
    return PointMap(
        tuple(f"p{i}" for i in range(len(which))),
        places[which] + noise * rng.normal(size=(len(which), 3)),
        np.tile(SIGMA**2 * np.eye(3), (len(which), 1, 1)),
        "sift",
        owners,
        (looks[which][owners] + 0.1 * rng.normal(size=(len(owners), 64))).astype(np.float32),
        rng.normal(size=(len(owners), 3)),
    ), places[which]


def test_points_of_two_drives_are_one_where_place_and_look_agree():
    first, places = drive(2, np.arange(300))
    second, others = drive(3, np.arange(200, 400))
    both, same = merged(first, second)
    assert 80 <= same <= 100  # 100 are common; a tenth of them look less alike than most views of one point
    assert len(both) == 500 - same
    assert len(set(both.names)) == len(both)
    assert both.names[:300] == first.names
    assert len(both.owners) == len(first.owners) + len(second.owners)
    np.testing.assert_allclose(both.positions[300:], second.positions[-(200 - same) :][: len(both) - 300], atol=0.2)
    fused = np.flatnonzero(np.any(both.positions[:300] != first.positions, axis=1))
    assert len(fused) == same
    assert fused.min() >= 200
    off, before = (np.sqrt(np.mean((p - places)[fused] ** 2)) for p in (both.positions[:300], first.positions))
    assert off < 0.85 * before
    np.testing.assert_allclose(both.covariances[fused], first.covariances[fused], rtol=1e-6)  # errors may be common
    counts = np.bincount(both.owners)
    assert set(counts[fused]) == {4}
    assert set(np.delete(counts, fused)) == {2}
    assert len(others) == 200


def test_points_that_look_alike_elsewhere_stay_apart():
    first, _ = drive(2, np.arange(50))
    second, _ = drive(3, np.arange(50))
    moved = PointMap(
        **{**vars_of(second), "positions": second.positions + np.array((0.0, 0.0, 1.0))},
    )
    both, same = merged(first, moved)
    assert (len(both), same) == (100, 0)


def vars_of(points):
    return {name: getattr(points, name) for name in points.__dataclass_fields__}


def test_other_features_and_named_points():
    first, _ = drive(2, np.arange(5))
    named = PointMap.of(("door",), np.ones((1, 3)))
    assert merged(first, named)[0].names[-1] == "door"
    assert merged(named, first)[0].feature == "sift"
    with pytest.raises(InputError, match="door is in both maps"):
        merged(named, named)
    with pytest.raises(InputError, match="orb and sift"):
        merged(first, PointMap(**{**vars_of(first), "feature": "orb"}))


def test_thinned_maps_keep_the_best_points_in_all_places():
    points, _ = drive(2, np.arange(400))
    worse = np.arange(400) % 2 == 1
    covariances = points.covariances * np.where(worse, 4.0, 1.0)[:, None, None]
    named = PointMap.of(("door",), np.ones((1, 3)))
    everything = merged(PointMap(**{**vars_of(points), "covariances": covariances}), named)[0]
    few = thinned(everything, 150)
    assert len(few) == 151
    assert "door" in few.names
    old = np.array([everything.index[name] for name in few.names[:150]])
    np.testing.assert_array_equal(few.positions[:150], everything.positions[old])
    assert np.mean(worse[old]) < 0.35
    cells = [len(np.unique(np.floor(p / 0.5), axis=0)) for p in (everything.positions[old], everything.positions[:150])]
    assert cells[0] == 150 > cells[1]
    np.testing.assert_array_equal(np.bincount(few.owners), 2)
    assert thinned(few, 150) is few


def test_chosen_points_keep_their_views():
    points, _ = drive(2, np.arange(10))
    some = points.chosen(np.array([7, 2]))
    assert some.names == ("p7", "p2")
    np.testing.assert_array_equal(some.descriptors[some.owners == 0], points.descriptors[points.owners == 7])
