"""Keyframes of a map that look like an image, and the points that are most like its features."""

import numpy as np
import pytest

from factorgraph_loc.vision.relocalization import NEAREST, KeyframeLooks

KEYFRAMES, EACH, SIZE = 400, 60, 24


def drive(rng, binary):
    """Descriptors of keyframes in a row, each of which shares half of its points with the next, and where they were seen from."""
    points = rng.normal(size=(KEYFRAMES * EACH // 2 + EACH // 2, SIZE)).astype(np.float32)
    if binary:
        points = rng.integers(0, 256, points.shape, dtype=np.uint8)
    rows = np.arange(EACH) + (EACH // 2) * np.arange(KEYFRAMES)[:, None]
    seen_from = np.repeat(np.column_stack((np.arange(KEYFRAMES), np.zeros((KEYFRAMES, 2)))), EACH, axis=0)
    order = rng.permutation(rows.size)
    return points[rows.ravel()][order], seen_from[order].astype(float), points[rows]


@pytest.mark.parametrize("binary", [False, True])
def test_the_keyframe_that_saw_the_same_is_among_the_most_alike(binary):
    rng = np.random.default_rng(0)
    descriptors, seen_from, by_keyframe = drive(rng, binary)
    places = KeyframeLooks(descriptors, seen_from)
    assert len(places) == KEYFRAMES
    for k in range(5, KEYFRAMES, 20):
        image = by_keyframe[k][: EACH // 2].copy()
        other = rng.permutation(by_keyframe.reshape(-1, SIZE))[: 2 * EACH]  # as much again that is elsewhere
        if not binary:
            image += 0.2 * rng.normal(size=image.shape).astype(np.float32)
        views = places.views(np.concatenate((image, other)))
        assert len(views) == NEAREST * EACH
        assert np.count_nonzero(seen_from[views, 0] == k) == EACH


def test_a_map_with_few_keyframes_is_taken_as_a_whole():
    descriptors, seen_from, _ = drive(np.random.default_rng(0), binary=False)
    few = seen_from[:, 0] < NEAREST
    places = KeyframeLooks(descriptors[few], seen_from[few])
    np.testing.assert_array_equal(places.views(descriptors[:10]), np.arange(np.count_nonzero(few)))
