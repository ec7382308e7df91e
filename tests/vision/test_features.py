"""Features by name: one interface, and what it makes of bad input."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from factorgraph_loc.errors import InputError
from factorgraph_loc.vision.features import EXTRACTORS, Keypoints, extractor
from factorgraph_loc.vision.images import as_image, read_image

NAMES = sorted(EXTRACTORS)


@pytest.mark.parametrize("name", NAMES)
class TestEveryExtractor:
    def test_gives_the_strongest_with_a_descriptor_each(self, name: str, picture: np.ndarray) -> None:
        features = extractor(name, 100)
        keypoints, descriptors = features.detectAndCompute(picture)
        assert 80 <= len(keypoints) <= 100
        assert len(descriptors) == len(keypoints)
        assert descriptors.dtype == (np.uint8 if name == "orb" else np.float32)
        assert np.all((keypoints.points >= 0) & (keypoints.points <= (319, 239)))
        assert np.all(np.diff(keypoints.responses) <= 0)

    def test_a_crowd_leaves_room_for_others_where_features_are_everywhere(self, name: str, picture: np.ndarray) -> None:
        rng = np.random.default_rng(7)
        crowded = picture.copy()
        noise = rng.integers(0, 256, (40, 13, 3), dtype=np.uint8)
        crowded[:, 100:204] = cv2.resize(noise, (104, 240), interpolation=cv2.INTER_CUBIC)
        strongest, everywhere = (
            extractor(name, 100, everywhere=way).detectAndCompute(crowded)[0] for way in (False, True)
        )
        inside = [np.mean((p.points[:, 0] > 96) & (p.points[:, 0] < 208)) for p in (strongest, everywhere)]
        assert len(everywhere) == len(strongest) == 100
        assert inside[0] > 0.7
        assert inside[1] < 0.6
        assert np.all(np.diff(everywhere.responses) <= 0)

    def test_the_detected_points_are_those_that_are_described(self, name: str, picture: np.ndarray) -> None:
        features = extractor(name, 100)
        both, _ = features.detectAndCompute(picture)
        assert np.allclose(np.sort(both.points, axis=0), np.sort(features.detect(picture).points, axis=0))

    def test_more_than_there_are_gives_what_there_is(self, name: str, picture: np.ndarray) -> None:
        keypoints, descriptors = extractor(name, 10**6).detectAndCompute(picture)
        assert 0 < len(keypoints) == len(descriptors) < 10**5

    @pytest.mark.parametrize("shape", [(15, 200), (200, 15, 3), (1, 1), (16, 16), (17, 40, 3), (33, 16)])
    def test_the_smallest_images_do_not_fail(self, name: str, shape: tuple[int, ...]) -> None:
        image = np.random.default_rng(0).integers(0, 255, shape, dtype=np.uint8)
        keypoints, descriptors = extractor(name).detectAndCompute(image)
        assert len(keypoints) == len(descriptors)
        assert descriptors.ndim == 2
        assert min(shape[:2]) >= 16 or len(extractor(name).detect(image)) == len(keypoints) == 0

    @pytest.mark.parametrize("value", [0, 77, 255])
    def test_a_constant_image_has_no_features(self, name: str, value: int) -> None:
        keypoints, descriptors = extractor(name).detectAndCompute(np.full((90, 120, 3), value, dtype=np.uint8))
        assert len(keypoints) == len(descriptors) == 0

    def test_other_kinds_of_pixels_give_the_same_features(self, name: str, picture: np.ndarray) -> None:
        features = extractor(name, 100)
        expected = features.detect(picture).points
        alpha = np.dstack([picture, np.full(picture.shape[:2], 9, dtype=np.uint8)])
        for same in (picture.astype(np.uint16) * 257, picture / 255.0, (picture / 255.0).astype(np.float32), alpha):
            assert np.array_equal(features.detect(same).points, expected)

    def test_grey_images_work(self, name: str, picture: np.ndarray) -> None:
        grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
        keypoints, descriptors = extractor(name, 100).detectAndCompute(grey)
        assert 80 <= len(keypoints) == len(descriptors)
        assert np.array_equal(keypoints.points, extractor(name, 100).detect(grey[:, :, None]).points)


def test_an_unknown_name_is_an_error_with_the_nearest() -> None:
    with pytest.raises(InputError, match=r"feature 'shift' is not known: did you mean sift\?"):
        extractor("shift")
    with pytest.raises(InputError, match="count is 0, expected at least 1"):
        extractor("sift", 0)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.empty((0, 0), dtype=np.uint8), "is empty"),
        ([[1, 2]], "is list, expected an array"),
        (np.zeros((8, 8, 2), dtype=np.uint8), r"has shape \(8, 8, 2\)"),
        (np.zeros((8, 8), dtype=np.int32), "has pixels of type int32"),
        (np.full((8, 8), np.nan), "has 64 values that are not finite"),
        (np.full((8, 8), 200.0), "has floating-point values from 200 to 200, expected 0 to 1"),
    ],
)
def test_what_is_no_image_is_an_error(array: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        as_image(array)


def test_files_that_are_no_images_are_errors(tmp_path: Path) -> None:
    for name, content in (("empty.png", b""), ("text.png", b"no picture")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=rf"{name}: is not an image that can be decoded"):
            read_image(tmp_path / name)
    with pytest.raises(InputError, match="cannot be read: No such file"):
        read_image(tmp_path / "missing.png")


def test_keypoints_go_to_opencv_and_back() -> None:
    rng = np.random.default_rng(2)
    keypoints = Keypoints(
        rng.uniform(0, 100, (5, 2)).astype(np.float32).astype(float),
        rng.uniform(1, 9, 5),
        np.array([0.1, -2.0, 3.1, np.nan, 0.0]),
        rng.uniform(0, 1, 5),
    )
    back = Keypoints.from_cv2(keypoints.to_cv2())
    assert np.array_equal(back.points, keypoints.points)
    assert np.allclose(back.sizes, keypoints.sizes)
    assert np.allclose(np.exp(1j * back.angles), np.exp(1j * keypoints.angles), atol=1e-5, equal_nan=True)
    assert np.allclose(back.responses, keypoints.responses)
    assert len(Keypoints.from_cv2([])) == 0
