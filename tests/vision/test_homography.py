"""Homographies: geometry against finite differences, files that are as they should be, and files that are not."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusal import refusal

from factorgraph_loc.evaluation.features.sequences import inside, jacobians, project, read_homography, view
from factorgraph_loc.vision.keypoints import spread_out
from factorgraph_loc.vision.relocalization import NEAREST, KeyframeIndex

SHAPE = (480, 640)
TILTED = np.array(((0.9, -0.2, 40.0), (0.15, 1.1, -12.0), (2e-4, -1e-4, 1.0)))
POINTS = np.array(((10.0, 20.0), (320.0, 240.0), (600.0, 33.5)))
XML = """<?xml version="1.0"?>
<opencv_storage><H12 type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
<data> 0.9 -0.2 40. 0.15
	1.1 -12. 2e-4 -1E-4 1.0</data></H12></opencv_storage>"""


def similarity(zoom, angle, shift=(0.0, 0.0)):
    c, s = zoom * np.cos(angle), zoom * np.sin(angle)
    return np.array(((c, -s, shift[0]), (s, c, shift[1]), (0.0, 0.0, 1.0)))


def test_jacobians_are_the_derivatives():
    steps = 1e-4 * np.eye(2)
    numeric = [(project(TILTED, POINTS + s) - project(TILTED, POINTS - s)) / 2e-4 for s in steps]
    assert jacobians(TILTED, POINTS) == pytest.approx(np.stack(numeric, axis=2), abs=1e-7)


def test_points_behind_infinity_have_no_image():
    beyond = np.array(((0.0, 2e4),))
    assert np.isnan(project(TILTED, beyond)).all()
    assert not inside(project(TILTED, beyond), SHAPE).any()


def test_inside_is_up_to_the_centres_of_the_border_pixels():
    points = np.array(((0.0, 0.0), (639.0, 479.0), (639.1, 0.0), (-0.1, 5.0), (5.0, 479.1)))
    assert inside(points, SHAPE).tolist() == [True, True, False, False, False]


@given(zoom=st.floats(0.2, 5.0), angle=st.floats(-3.1, 3.1))
def test_view_of_a_similarity(zoom, angle):
    found = view(similarity(zoom, angle, (30.0, -7.0)), SHAPE)
    assert found == pytest.approx((zoom, angle, 1.0), rel=1e-6, abs=1e-6)


@pytest.mark.parametrize(
    "text", [XML, "0.9 -0.2 40\n0.15 1.1 -12\n2e-4 -1e-4 1\n", "-9 2 -400 -1.5 -11 120 -2e-3 1e-3 -10"]
)
def test_text_and_xml_give_the_same(tmp_path, text):
    file = tmp_path / "H1to2p"
    file.write_text(text)
    found = read_homography(file, SHAPE)
    assert project(found, POINTS) == pytest.approx(project(TILTED, POINTS))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 0 0 0 1 0 0 0", "has 8 numbers, expected the 9"),
        ("1 0 0 0 one 0 0 0 1", "could not convert string to float: 'one', expected nine numbers"),
        ("1 2 3 2 4 6 0 0 1", "is singular"),
        ("1 0 0 0 1 0 -0.01 0 1", "maps a part of the first image to infinity"),
        ("-1 0 0 0 1 0 0 0 1", "mirrors the image"),
        ("<opencv_storage><H12>", "is not XML"),
    ],
)
def test_bad_files_are_one_line(tmp_path, text, message):
    file = tmp_path / "H1to2p"
    file.write_text(text)
    refusal(lambda: read_homography(file, SHAPE), f"{file}: ", message)


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
    places = KeyframeIndex(descriptors, seen_from)
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
    places = KeyframeIndex(descriptors[few], seen_from[few])
    np.testing.assert_array_equal(places.views(descriptors[:10]), np.arange(np.count_nonzero(few)))


@given(st.integers(1, 60), st.integers(1, 40), st.integers(0, 1000))
def test_so_many_as_asked_each_once(size, count, seed):
    pixels = np.random.default_rng(seed).uniform(0.0, 100.0, (size, 2))
    chosen = spread_out(pixels, count)
    assert len(chosen) == min(size, count)
    assert (np.diff(chosen) > 0).all()


def test_a_crowd_leaves_room_for_others_and_its_first_comes_first():
    rng = np.random.default_rng(23)
    crowd = rng.uniform((0.0, 0.0), (80.0, 80.0), (300, 2))
    others = np.array([(x, y) for x in (200.0, 400.0, 600.0) for y in (100.0, 300.0, 460.0)])
    pixels = np.concatenate((crowd, others))
    priority = [0] * len(pixels)
    priority[5] = 1
    chosen = spread_out(pixels, 20, priority).tolist()
    assert set(range(300, 309)) <= set(chosen)
    assert 5 in chosen


def test_few_cells_are_coarse_ones():
    pixels = np.concatenate([np.random.default_rng(5).uniform(low, low + 100.0, (50, 2)) for low in (0.0, 100.0)])
    pixels = np.concatenate((pixels, pixels[:50]))  # the first corner has twice as many
    fine, coarse = (spread_out(pixels, 60, cells=cells) for cells in (None, 4))
    assert np.count_nonzero(coarse % 100 >= 50) >= 25
    # the first ones of a coarse cell are from all over it, or not
    assert coarse[:25].max() < fine[:25].max()


def test_pixels_in_one_place_are_no_fault():
    assert len(spread_out(np.zeros((30, 2)), 10)) == 10
