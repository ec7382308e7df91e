"""Colour features see the same in an image that is turned, zoomed, or of another brightness: how much of it, is stated here.

Of 400 points each, in the part that both images show, at least REPEATED are found again: within half a size of where they should
be, and with a size that is wrong by a factor of at most 1.3. Of those at least MATCHED pass the ratio of 0.8 as mutual nearest
neighbours, and at least RIGHT of these pairs are the right ones; their directions turn with the image, by the median to within
0.1 rad.
"""

from functools import cache

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factorgraph_loc.vision.features import extractor
from factorgraph_loc.vision.keypoints import Keypoints
from factorgraph_loc.vision.matching import match

REPEATED, MATCHED, RIGHT = 0.65, 0.6, 0.85
COUNT = 400


@cache
def texture() -> np.ndarray:
    """A picture with structure of all sizes (480, 480, 3)."""
    rng = np.random.default_rng(9)
    noise = rng.normal(size=(480, 480, 3))
    layers = [cv2.GaussianBlur(noise, (0, 0), s) * s for s in (1.5, 3.0, 6.0, 12.0, 24.0)]
    return np.asarray(np.clip(128 + 40 * sum(layers), 0, 255).astype(np.uint8))


FEATURES = extractor("colour", COUNT)


@cache
def found_in_texture() -> tuple[Keypoints, np.ndarray]:
    return FEATURES.detectAndCompute(texture())


def warped(angle: float, zoom: float) -> tuple[np.ndarray, np.ndarray]:
    """The picture turned by ``angle`` [rad] and zoomed around its middle, and the affine map (2, 3) that does it."""
    middle = (np.array(texture().shape[1::-1]) - 1.0) / 2.0
    linear = zoom * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    affine = np.column_stack([linear, middle - linear @ middle])
    # what is made smaller is blurred first, as a lens does it
    source = cv2.GaussianBlur(texture(), (0, 0), 0.5 * np.sqrt(zoom**-2 - 1.0)) if zoom < 0.99 else texture()
    image = cv2.warpAffine(source, affine, texture().shape[1::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return image, affine


def within(points: np.ndarray, margin: float) -> np.ndarray:
    return np.all((points > margin) & (points < np.array(texture().shape[1::-1]) - 1.0 - margin), axis=1)


def check(image: np.ndarray, affine: np.ndarray) -> None:
    before, first = found_in_texture()
    after, second = FEATURES.detectAndCompute(image)
    linear, shift = affine[:, :2], affine[:, 2]
    zoom = np.sqrt(np.linalg.det(linear))
    expected = before.points @ linear.T + shift
    same = found_again(expected, before.sizes * zoom, after)

    # scales that are finer than the finest, and what is behind the border, can not be found again
    back = (after.points - shift) @ np.linalg.inv(linear).T
    possible = min(
        np.count_nonzero(within(expected, 20.0) & (before.sizes * zoom > 3.0)),
        np.count_nonzero(within(back, 20.0) & (after.sizes / zoom > 3.0)),
    )
    assert possible >= 10
    again = same.any(axis=1)
    assert np.count_nonzero(again) >= REPEATED * possible

    i, j = match(first, second).indices.T
    i, j = i[again[i]], j[again[i]]
    assert len(i) >= MATCHED * np.count_nonzero(again)
    assert np.mean(same[i, j]) >= RIGHT
    turn = np.arctan2(linear[1, 0], linear[0, 0])
    assert np.median(np.abs(np.angle(np.exp(1j * (after.angles[j] - before.angles[i] - turn))))) < 0.1


def found_again(points: np.ndarray, sizes: np.ndarray, keypoints: Keypoints) -> np.ndarray:
    away = np.linalg.norm(points[:, None] - keypoints.points, axis=2)
    ratio = keypoints.sizes / sizes[:, None]
    return np.asarray((away < 0.5 * sizes[:, None]) & (np.maximum(ratio, 1.0 / ratio) < 1.3))


@settings(max_examples=15)
@given(angle=st.floats(-np.pi, np.pi), zoom=st.floats(0.6, 1.6))
def test_rotation_and_zoom(angle: float, zoom: float) -> None:
    check(*warped(angle, zoom))


@settings(max_examples=15)
@given(contrast=st.floats(0.3, 1.0), brightness=st.floats(0.0, 1.0))
def test_brightness_and_contrast(contrast: float, brightness: float) -> None:
    image = texture() * contrast + 255.0 * (1.0 - contrast) * brightness
    check(np.rint(image).astype(np.uint8), np.eye(2, 3))


def test_what_is_another_picture_fails_the_check() -> None:
    other = np.ascontiguousarray(texture()[::-1, :, ::-1])
    with pytest.raises(AssertionError):
        check(other, np.eye(2, 3))
