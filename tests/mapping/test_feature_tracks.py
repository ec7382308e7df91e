"""Features chained over images: which images, which features, and which not."""

from dataclasses import replace

import numpy as np
import pytest

from factorgraph_loc.mapping.triangulation import (
    Cameras,
    chained,
    keyframes,
    matched_pairs,
    near_epipolar_lines,
    overlapping_pairs,
)

pytestmark = pytest.mark.kernels


def row(x):
    """Cameras at ``x`` along a line."""
    x = np.asarray(x, dtype=float)
    return Cameras(np.column_stack((x, 0.0 * x, 0.0 * x)), np.repeat(np.eye(3)[None], len(x), axis=0))


def test_keyframes_are_apart_and_none_is_of_a_place_seen_before():
    cameras = row([0.0, 0.04, 0.11, 0.15, 0.22, 0.11, 0.02])
    assert keyframes(cameras, 0.1, 0.1).tolist() == [0, 2, 4]
    assert keyframes(cameras, 0.0, 0.0).tolist() == list(range(7))
    assert keyframes(row([]), 0.1, 0.1).tolist() == []


def test_pairs_are_of_frames_that_overlap():
    cameras = row([0.0, 0.3, 5.0, 5.2])
    assert overlapping_pairs(cameras) == [(0, 1), (2, 3)]
    turned = Cameras(cameras.positions, cameras.rotations.copy())
    turned.rotations[1] = np.diag((-1.0, 1.0, -1.0))
    assert overlapping_pairs(turned) == [(2, 3)]


def test_what_shows_one_point_lies_near_the_epipolar_line(look):
    sight = look(np.random.default_rng(0), noise=0.3)
    first, second = sight.frames[2], sight.frames[7]
    near = near_epipolar_lines(sight.model, sight.cameras, 2, 7, first.pixels, second.pixels, 2.0)
    same = sight.shown[2][:, None] == sight.shown[7]
    assert near[same].mean() > 0.99
    assert near[~same].mean() < 0.05


def test_features_that_look_alike_are_told_apart_by_their_lines(look):
    """Two points with the same look cannot be matched by it; where only one of them is near the line, it is."""
    rng = np.random.default_rng(1)
    sight = look(rng, noise=0.3, points=80)
    looks = rng.standard_normal((80, 16)).astype(np.float32)
    looks[40:] = looks[:40]
    frames = [replace(f, descriptors=looks[s]) for f, s in zip(sight.frames, sight.shown, strict=True)]
    ((i, j, pairs, _),) = matched_pairs(sight.model, sight.cameras, frames, [(2, 7)], 2.0)
    right = np.count_nonzero(sight.shown[i][pairs[:, 0]] == sight.shown[j][pairs[:, 1]])
    assert right == len(pairs) > 60
    assert matched_pairs(sight.model, sight.cameras, frames, [(2, 7)], 1000.0) == []


def test_tracks_show_one_point_each(look):
    sight = look(np.random.default_rng(2), noise=0.5)
    matches = matched_pairs(sight.model, sight.cameras, sight.frames, overlapping_pairs(sight.cameras), 3.0)
    tracks = chained(sight.frames, matches)
    point = np.array([sight.shown[i][k] for i, k in zip(tracks.frame, tracks.feature, strict=True)])
    first = np.unique(tracks.track, return_index=True)[1]
    assert np.mean(point == point[first][tracks.track]) > 0.99
    assert tracks.lengths().min() >= 2
    assert np.median(tracks.lengths()) >= 8
    np.testing.assert_array_equal(
        tracks.pixels, [sight.frames[i].pixels[k] for i, k in zip(tracks.frame, tracks.feature, strict=True)]
    )


def test_no_track_has_two_features_of_an_image(look):
    """A wrong match, worse than the right ones, is not chained where it would bring two features of an image together."""
    sight = look(np.random.default_rng(3), count=3, points=10, noise=0.0)
    a, b, c = (np.argsort(s) for s in sight.shown)  # the features of points 0, 1, ...
    right = [
        (0, 1, np.column_stack((a, b)), np.full(10, 1.0)),
        (1, 2, np.column_stack((b, c)), np.full(10, 1.0)),
    ]
    wrong = (0, 2, np.array([(a[0], c[1])]), np.array([5.0]))
    tracks = chained(sight.frames, [*right, wrong])
    assert tracks.count == 10
    assert tracks.lengths().tolist() == [3] * 10
