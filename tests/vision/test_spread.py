"""What is chosen of many pixels comes from all over the image."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from factorgraph_loc.vision.keypoints import spread_out


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
