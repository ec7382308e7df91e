"""Homographies: geometry against finite differences, files that are as they should be, and files that are not."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusal import refusal

from factorgraph_loc.evaluation.features.sequences import (
    inside,
    jacobians,
    project,
    read_homography,
    view,
)

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
        ("1 0 0 0 1 0 0 0", "has 8 numbers, expected the 3 x 3"),
        ("1 0 0 0 one 0 0 0 1", "could not convert string to float: 'one', expected nine numbers"),
        ("1 2 3 2 4 6 0 0 1", "is singular"),
        ("1 0 0 0 1 0 -0.01 0 1", "sends part of the first image to infinity"),
        ("-1 0 0 0 1 0 0 0 1", "mirrors the image"),
        ("<opencv_storage><H12>", "is not XML"),
    ],
)
def test_bad_files_are_one_line(tmp_path, text, message):
    file = tmp_path / "H1to2p"
    file.write_text(text)
    refusal(lambda: read_homography(file, SHAPE), f"{file}: ", message)
