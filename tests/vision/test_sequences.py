"""Sequences of images: folders read as they are, damaged ones named, photographs warped by what is said."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.features.sequences import (
    OTHER,
    ROTATION,
    ROTATIONS,
    SCALE,
    VIEWPOINT,
    ZOOMS,
    find_sequences,
    project,
    view,
    warped,
)

HALF = "0.5 0 20 0 0.5 10 0 0 1"


@pytest.fixture
def picture():
    """Smooth colours, (240, 320, 3)."""
    noise = np.random.default_rng(4).random((240, 320, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 6.0)
    return np.asarray(cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX), dtype=np.uint8)


@pytest.fixture
def folder(tmp_path, picture):
    """A sequence of three images with both homographies."""
    made = tmp_path / "park"
    made.mkdir()
    for k in (1, 2, 3):
        cv2.imwrite(str(made / f"img{k}.png"), picture)
    (made / "H1to2p").write_text(HALF)
    (made / "H1to3p.txt").write_text("0.25 0 20 0 0.25 10 0 0 1")
    return made


def test_a_folder_and_a_folder_of_folders(folder):
    (one,) = find_sequences([folder])
    (same,) = find_sequences([folder.parent])
    assert one.name == same.name == "park"
    assert len(one.others) == len(same.others) == 2
    assert one.change == SCALE
    assert one.amounts == pytest.approx((2.0, 4.0))
    assert one.homographies[0] == pytest.approx(np.fromstring(HALF, sep=" ").reshape(3, 3))


@pytest.mark.parametrize(
    ("matrix", "change", "amount"),
    [
        ("1 0 3 0 1 2 0 0 1", OTHER, 2.0),
        ("0 -1 300 1 0 2 0 0 1", ROTATION, 90.0),
        ("0.5 0 0 0 1 0 0 0 1", VIEWPOINT, 2.0),
    ],
)
def test_what_a_sequence_is_about_is_seen_from_its_homographies(folder, matrix, change, amount):
    (folder / "img3.png").unlink()
    (folder / "H1to3p.txt").unlink()
    (folder / "H1to2p").write_text(matrix)
    (one,) = find_sequences([folder])
    assert (one.change, one.amounts) == (change, (pytest.approx(amount),))


def test_oxford_sequences(data_root):
    found = {s.name: s for s in find_sequences([data_root / "oxford_affine"])}
    assert {name: s.change for name, s in found.items()} == {"bark": SCALE, "boat": SCALE, "graf": VIEWPOINT}
    assert all(len(s.others) == 5 for s in found.values())
    assert found["bark"].amounts[-1] == pytest.approx(4.0, abs=0.1)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: (f / "H1to2p").unlink(), "has no homography H1to2p"),
        (lambda f: (f / "img2.png").unlink(), "has no img2, expected img1, img2, ... without gaps"),
        (lambda f: (f / "img2.png").write_bytes(b"no picture"), "img2.png: is not an image that can be decoded"),
        (lambda f: (f / "img2.jpg").write_bytes(b""), "has both img2.jpg and img2.png, expected one img2"),
    ],
)
def test_damaged_folders_are_named(folder, damage, message):
    damage(folder)
    with pytest.raises(InputError, match=message):
        find_sequences([folder])


def test_a_photograph_is_warped_by_what_is_said(picture):
    zoomed, rotated = warped(picture, Path("holiday/beach.jpg"))
    assert (zoomed.name.split("/")[1], rotated.name.split("/")[1]) == ("beach zoomed", "beach rotated")
    assert (zoomed.change, zoomed.amounts) == (SCALE, ZOOMS)
    assert (rotated.change, rotated.amounts) == (ROTATION, ROTATIONS)
    for sequence in (zoomed, rotated):
        views = [view(h, sequence.first.shape) for h in sequence.homographies]
        stated = [1.0 / v.zoom if sequence is zoomed else np.degrees(v.rotation) for v in views]
        assert stated == pytest.approx(sequence.amounts, rel=0.01)


@pytest.mark.parametrize("which", [0, 1])
def test_pixels_lie_where_the_homography_says(picture, which):
    sequence = warped(picture, Path("beach.jpg"))[which]
    side = np.array(sequence.first.shape[1::-1])
    points = side / 2.0 + np.random.default_rng(1).uniform(-0.3, 0.3, (200, 2)) * side
    points = np.round(points)
    values = sequence.first[points[:, 1].astype(int), points[:, 0].astype(int)].astype(float)
    for image, homography in zip(sequence.others, sequence.homographies, strict=True):
        at = project(homography, points).astype(np.float32)
        seen = cv2.remap(image, at[:, None, 0], at[:, None, 1], cv2.INTER_LINEAR)[:, 0].astype(float)
        # a shift by half a pixel would be twice as much; what is made smaller by 4 is blurred
        assert np.abs(seen - values).mean() < 2.0
