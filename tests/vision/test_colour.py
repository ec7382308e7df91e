"""The Gaussian colour model, on pixels of which it is known."""

import numpy as np

from factorgraph_loc.vision.colour_features import colour_channels


def test_channels_are_the_published_combinations_of_red_green_and_blue() -> None:
    blue, green, red = 10.0, 200.0, 90.0
    image = np.full((16, 16, 3), (blue, green, red), dtype=np.uint8)
    e, yellow_blue, red_green = (channel[3, 4] for channel in colour_channels(image))
    assert np.isclose(e, 0.06 * red + 0.63 * green + 0.27 * blue)
    assert np.isclose(yellow_blue, 0.30 * red + 0.04 * green - 0.35 * blue)
    assert np.isclose(red_green, 0.34 * red - 0.60 * green + 0.17 * blue)


def test_grey_has_one_channel_and_no_colour() -> None:
    grey = np.arange(256, dtype=np.uint8).reshape(16, 16)
    (alone,) = colour_channels(grey)
    assert np.array_equal(alone, grey)
    e, *colours = colour_channels(np.dstack([grey] * 3))
    assert np.allclose(e, 0.96 * alone, atol=1e-3)
    assert all(np.abs(colour).max() < 0.1 * e.max() for colour in colours)
