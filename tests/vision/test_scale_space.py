"""The pyramid: how much its planes are blurred, and what is read from them."""

import numpy as np
import pytest

from factorgraph_loc.vision.scale_space import FINEST, SCALES, SIGMAS, STEP, ScaleSpace


def test_planes_are_blurred_to_their_scales() -> None:
    space = ScaleSpace((257, 257), 0)
    impulse = np.zeros((257, 257), dtype=np.float32)
    impulse[128, 128] = 1.0
    space.fill(impulse)
    for octave in space.octaves[:3]:
        height, width = octave.planes.shape[1:]
        y, x = np.mgrid[:height, :width] * octave.step - 128.0
        for sigma, plane in zip(SIGMAS, octave.planes, strict=True):
            weights = plane / plane.sum()
            for away in (x, y):
                assert np.isclose(np.sqrt((weights * away**2).sum()), sigma * octave.step, rtol=0.02)
                assert abs((weights * away).sum()) < 1e-3


def test_octaves_end_at_sixteen_pixels() -> None:
    assert [octave.planes.shape[1:] for octave in ScaleSpace((100, 131), 0).octaves] == [(100, 131), (50, 66), (25, 33)]
    assert len(ScaleSpace((16, 16), 2).octaves) == 1
    assert ScaleSpace((64, 48), 2).octaves[1].colours.shape == (2, 32, 24)


def test_levels_are_the_nearest_scales_of_all_octaves() -> None:
    space = ScaleSpace((64, 64), 0)
    scales = FINEST * STEP ** np.arange(3 * SCALES)
    assert np.array_equal(space.levels(scales * 1.05), np.arange(3 * SCALES))
    assert space.levels(np.array([0.1, 1e3])).tolist() == [0, 3 * SCALES - 1]


@pytest.mark.parametrize("sigma", [1.3, 2.9, 6.0])
def test_patches_of_a_slope_are_the_slope(sigma: float) -> None:
    space = ScaleSpace((200, 240), 0)
    y, x = np.mgrid[:200, :240].astype(np.float32)
    space.fill(2.0 * x - 3.0 * y)
    offsets = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 2.0], [-3.0, 1.0]], dtype=np.float32)
    point, angle = np.array([[111.3, 93.6]]), 0.7
    patch = space.patches(point, np.array([sigma]), np.array([angle]), offsets)[0]
    c, s = np.cos(angle), np.sin(angle)
    places = point + sigma * offsets @ np.array([[c, s], [-s, c]])
    assert np.allclose(patch, places @ (2.0, -3.0), atol=0.01)


def test_memory_that_is_used_again_keeps_nothing() -> None:
    rng = np.random.default_rng(5)
    first, second = rng.normal(size=(2, 50, 60)).astype(np.float32)
    used, new = ScaleSpace((50, 60), 0), ScaleSpace((50, 60), 0)
    used.fill(first)
    used.fill(second)
    new.fill(second)
    assert all(np.array_equal(a.planes, b.planes) for a, b in zip(used.octaves, new.octaves, strict=True))
