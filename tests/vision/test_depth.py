"""Depths at pixels of a depth image."""

import cv2
import numpy as np
import pytest

from factorgraph_loc.errors import InputError
from factorgraph_loc.vision.depth import depths_at

SIZE = (40, 30)


def written(path, image):
    cv2.imwrite(str(path), image)
    return path


def test_depths_are_told_where_they_are_sure(tmp_path):
    image = np.full((30, 40), 2000, dtype=np.uint16)
    image[:, 20:] = 3000  # an edge
    image[10, 5] = 0  # nothing was measured
    image[22:26, 8:12] = 65535  # nothing was near enough
    pixels = np.array(((10.4, 20.0), (30.0, 3.6), (19.6, 15.0), (18.6, 15.0), (5.0, 10.0), (6.0, 9.0), (39.4, 29.4)))
    found = depths_at(written(tmp_path / "depth.png", image), np.vstack((pixels, (9.0, 23.0))), SIZE, 0.001)
    np.testing.assert_allclose(found, (2.0, 3.0, np.nan, np.nan, np.nan, np.nan, 3.0, np.nan))


def test_a_slope_is_no_edge(tmp_path):
    image = np.tile(np.linspace(1000.0, 1200.0, 40), (30, 1)).astype(np.uint16)
    found = depths_at(written(tmp_path / "depth.png", image), np.array(((20.0, 15.0),)), SIZE, 0.0002)
    np.testing.assert_allclose(found, 0.0002 * image[15, 20])


@pytest.mark.parametrize(
    ("image", "told"),
    [
        (np.zeros((30, 40), dtype=np.uint8), "40 x 30 px of uint8"),
        (np.zeros((30, 41), dtype=np.uint16), "41 x 30 px of uint16"),
        (np.zeros((30, 40, 3), dtype=np.uint16), "3 channels"),
    ],
)
def test_what_is_no_depth_image_is_told(tmp_path, image, told):
    with pytest.raises(InputError, match=told):
        depths_at(written(tmp_path / "depth.png", image), np.zeros((1, 2)), SIZE, 0.001)
