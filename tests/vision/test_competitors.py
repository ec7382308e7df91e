"""The competing detectors: blobs and corners of known place and size, box filters against sums of pixels, odd images."""

import cv2
import numpy as np
import pytest

from factorgraph_loc.evaluation.features.competitors import BOX_SIGMA, BOX_XY, DETECTORS, box_hessian
from factorgraph_loc.evaluation.features.repeatability import repeatability
from factorgraph_loc.evaluation.features.sequences import find_sequences

NAMES = sorted(DETECTORS)


def blob(x, y, sigma, shape=(160, 200)):
    """A bright Gaussian spot on grey, 8 bits."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    return np.uint8(60.0 + 180.0 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2.0 * sigma**2)))


@pytest.mark.parametrize("name", ["hessian_laplace", "fast_hessian"])
@pytest.mark.parametrize("sigma", [4.0, 6.0, 9.0])
def test_a_blob_is_found_with_its_size(name, sigma):
    found = DETECTORS[name](blob(90.4, 71.7, sigma), 10)
    assert found.points[0] == pytest.approx((90.4, 71.7), abs=0.4)
    # normalised derivatives of a Gaussian blob are extreme at its own scale; boxes have lobes of a larger one than they are called
    ratio, tolerance = (1.0, 0.1) if name == "hessian_laplace" else (6.0 * BOX_SIGMA, 0.15)
    assert found.sizes[0] == pytest.approx(2.0 * sigma * ratio, rel=tolerance)


def test_corners_of_a_square_are_found_by_harris():
    image = np.full((160, 200), 40, dtype=np.uint8)
    image[50:100, 60:130] = 210
    found = DETECTORS["harris_laplace"](image, 100)
    found = found[found.sizes < 20.0]  # the square itself is found too
    corners = np.array(((59.5, 49.5), (129.5, 49.5), (59.5, 99.5), (129.5, 99.5)))
    to_corner = np.linalg.norm(found.points[:, None] - corners, axis=2)
    # smoothing moves a corner inwards, in proportion to its scale
    assert np.all(to_corner.min(axis=1) < 1.4 * found.sizes / 2.0)
    assert set(to_corner.argmin(axis=1).tolist()) == {0, 1, 2, 3}


@pytest.mark.parametrize("side", [9, 27])
def test_box_hessian_is_that_of_kernels(side):
    image = np.random.default_rng(1).random((60, 70)).astype(np.float32)
    lobe, reach = side // 3, side // 2
    yy, xy = np.zeros((side, side)), np.zeros((side, side))
    yy[:, reach - lobe + 1 : reach + lobe] = 1.0
    yy[lobe : 2 * lobe, reach - lobe + 1 : reach + lobe] = -2.0
    xy[reach - lobe : reach, reach + 1 : reach + 1 + lobe] = xy[reach + 1 : reach + 1 + lobe, reach - lobe : reach] = (
        1.0
    )
    xy[reach - lobe : reach, reach - lobe : reach] = xy[
        reach + 1 : reach + 1 + lobe, reach + 1 : reach + 1 + lobe
    ] = -1.0
    dyy, dxx, dxy = (cv2.filter2D(image, cv2.CV_64F, kernel) for kernel in (yy, yy.T, xy))
    expected = (dxx * dyy - (BOX_XY * dxy) ** 2) / side**4
    inner = np.s_[reach:-reach, reach:-reach]
    found = box_hessian(cv2.integral(image, sdepth=cv2.CV_64F), side)
    assert found[inner] == pytest.approx(expected[inner], rel=1e-4, abs=1e-7)
    assert not found[:reach].any()


@pytest.mark.parametrize("name", NAMES)
def test_interface(name):
    image = cv2.GaussianBlur(np.random.default_rng(3).integers(0, 255, (120, 160, 3)).astype(np.uint8), (0, 0), 2.0)
    every, few = DETECTORS[name](image, 10_000), DETECTORS[name](image, 7)
    assert len(few) == 7 < len(every)
    assert few.points == pytest.approx(every.points[:7])
    assert np.all(np.diff(every.responses) <= 0.0)
    assert np.all((every.points >= 0.0) & (every.points <= (159.0, 119.0)))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("turns", [1, 2, 3])
def test_turning_the_image_turns_the_points(name, turns):
    image = cv2.GaussianBlur(np.random.default_rng(4).integers(0, 255, (128, 128)).astype(np.uint8), (0, 0), 2.0)
    straight, turned = DETECTORS[name](image, 60), DETECTORS[name](np.rot90(image, turns).copy(), 80)
    x, y = turned.points.T
    for _ in range(turns):
        x, y = 127.0 - y, x
    distance = np.linalg.norm(straight.points[:, None] - np.column_stack((x, y)), axis=2)
    assert np.mean(distance.min(axis=1) < 0.1) > 0.9


@pytest.mark.parametrize(
    ("name", "images", "expected"),
    [("hessian_laplace", "bark", 0.80), ("fast_hessian", "boat", 0.45), ("harris_laplace", "bark", 0.66)],
)
def test_they_repeat_as_well_as_when_they_were_written(data_root, name, images, expected):
    (sequence,) = find_sequences([data_root / "oxford_affine" / images])
    first, *others = (DETECTORS[name](image, 1000) for image in (sequence.first, *sequence.others[::2]))
    found = [
        repeatability(first, other, h, (sequence.first.shape, image.shape)).repeatability
        for other, h, image in zip(others, sequence.homographies[::2], sequence.others[::2], strict=True)
    ]
    assert np.mean(found) == pytest.approx(expected, abs=0.08)
