"""Sequences of images of one planar scene with known homographies: folders in the Oxford format, or warps of one photograph.

A homography maps points of the first image to another image. It contains a zoom, a rotation and a tilt.

A folder in the Oxford format (Mikolajczyk et al., "A Comparison of Affine Region Detectors", IJCV 65, 2005) has the
images ``img1`` to ``imgN``, and the homographies ``H1to2p`` to ``H1toNp`` from the first image to each other image.
"""

import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence as Several
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import read_text
from factorgraph_loc.text import error_text
from factorgraph_loc.vision.images import Image, read_image
from factors.se2 import Array

_MAX_CONDITION = 1e12  # maximum condition number of a homography; for images of 1000 px it is usually 1e4 to 1e7
ZOOMS = (1.25, 1.5, 2.0, 2.5, 3.0, 4.0)  # reduction factors of photographs
ROTATIONS = (15.0, 30.0, 45.0, 60.0, 75.0, 90.0)  # rotations of photographs, in degrees
MIN_WARPED = 128  # px; minimum side of a photograph, because it must have features when reduced to a quarter

SCALE, ROTATION, VIEWPOINT, OTHER = "scale change", "rotation [degrees]", "viewpoint (tilt)", "image"
_SCALED, _TURNED, _TILTED = 1.3, np.radians(10.0), 1.3  # smaller changes are not dominant
_SUFFIXES = ("", ".txt", ".xml")


class ViewChange(NamedTuple):
    """Change of view from a first image to a second one. ``zoom``: above 1 if the scene is larger in the second image.

    ``rotation`` [rad]. ``tilt``: a small circle in the first image becomes an ellipse in the second image. The tilt is
    the ratio of the axes of this ellipse, at least 1.
    """

    zoom: float
    rotation: float
    tilt: float


def project(homography: Array, points: Array) -> Array:
    """Return the pixels (N, 2) in the second image of ``points`` (N, 2) [px] in the first image, NaN if infinite.

    ``homography`` (3, 3): a matrix that :func:`checked` returned, or its inverse.
    """
    mapped = points @ homography[:, :2].T + homography[:, 2]
    w = np.where(mapped[:, 2] > 0.0, mapped[:, 2], np.nan)
    return np.asarray(mapped[:, :2] / w[:, None])


def jacobians(homography: Array, points: Array) -> Array:
    """Return the Jacobian matrices (N, 2, 2) of the mapping :func:`project` at the pixels ``points`` (N, 2) of the
    first image."""
    w = points @ homography[2, :2] + homography[2, 2]
    return np.asarray(
        (homography[:2, :2] - project(homography, points)[:, :, None] * homography[2, :2]) / w[:, None, None]
    )


def invert(homography: Array) -> Array:
    """Return the inverse homography (3, 3)."""
    return np.asarray(np.linalg.inv(homography), dtype=float)


def inside(points: Array, shape: tuple[int, ...]) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Return a mask (N,) of the ``points`` (N, 2) in an image of ``shape`` (height, width, ...). NaN lies outside."""
    last = np.array((shape[1] - 1.0, shape[0] - 1.0))
    return np.asarray(np.all((points >= 0.0) & (points <= last), axis=1))


def corners(shape: tuple[int, ...]) -> Array:
    """Return the centres (4, 2) [px] of the corner pixels of an image of ``shape`` (height, width, ...)."""
    right, bottom = shape[1] - 1.0, shape[0] - 1.0
    return np.array(((0.0, 0.0), (right, 0.0), (right, bottom), (0.0, bottom)))


def view(homography: Array, shape: tuple[int, ...]) -> ViewChange:
    """Return the zoom, rotation and tilt of a ``homography`` (3, 3) at the centre of the first image.
    ``shape``: (height, width, ...) of the first image."""
    (local,) = jacobians(homography, corners(shape).mean(axis=0, keepdims=True))
    left, axes, right = np.linalg.svd(local)
    turn = left @ right
    return ViewChange(
        float(np.sqrt(axes[0] * axes[1])), float(np.arctan2(turn[1, 0], turn[0, 0])), float(axes[0] / axes[1])
    )


def checked(matrix: Array, shape: tuple[int, ...], source: object) -> Array:
    """Return a homography (3, 3), scaled so that the third homogeneous coordinate is positive in the first image.

    ``shape``: (height, width, ...) of the first image. ``source``: file name for messages. Raises InputError if
    ``matrix`` is not a valid homography.
    """
    if matrix.shape != (3, 3):
        raise InputError(f"{source}: has {matrix.size} numbers, expected the 9 numbers of a homography")
    if not np.isfinite(matrix).all():
        raise InputError(f"{source}: has numbers that are not finite, expected a homography")
    if not np.any(matrix) or np.linalg.cond(matrix) > _MAX_CONDITION:
        raise InputError(f"{source}: is singular, expected a homography that can be inverted")
    w = corners(shape) @ matrix[2, :2] + matrix[2, 2]
    if not (np.all(w > 0.0) or np.all(w < 0.0)):
        raise InputError(
            f"{source}: maps a part of the first image to infinity, expected a homography that maps all of it"
        )
    scaled = matrix / w.mean()
    if np.linalg.det(scaled) < 0.0:
        raise InputError(f"{source}: mirrors the image, expected a homography without reflection")
    return np.asarray(scaled)


def read_homography(path: Path, shape: tuple[int, ...]) -> Array:
    """Return the homography (3, 3) in a file with nine numbers, or with a matrix in OpenCV's XML format.

    ``shape``: (height, width, ...) of the first image. Raises InputError if the file cannot be read or its matrix is
    not a valid homography.
    """
    text = read_text(path)
    if text.lstrip().startswith("<"):
        try:
            data = ET.fromstring(text.lstrip()).find(".//data")
        except ET.ParseError as error:
            raise InputError(f"{path}: is not XML: {error_text(error)}") from error
        if data is None:
            raise InputError(f"{path}: has no <data>, expected a matrix as OpenCV writes it")
        text = data.text or ""
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError as error:
        raise InputError(f"{path}: is not a matrix: {error_text(error)}, expected nine numbers") from error
    return checked(numbers.reshape(3, 3) if numbers.size == 9 else numbers, shape, path)


@dataclass(frozen=True, eq=False)
class Sequence:
    """A first image, other images, and the homographies (3, 3) [px] from the first image to each other image.

    ``change``: the dominant change, such as "scale change". ``amounts``: its amount in each other image. This is a
    ratio, an angle [degrees], or the number of the image if no change dominates.
    """

    name: str
    first: Image
    others: tuple[Image, ...]
    homographies: tuple[Array, ...]
    change: str
    amounts: tuple[float, ...]


def find_sequences(paths: Several[Path]) -> list[Sequence]:
    """Return the image sequences in the given paths. A path is a folder with a sequence, or a folder of such folders.
    It may also be a photograph: :func:`warped` makes two sequences of it.

    Raises InputError for other paths and for damaged files.
    """
    sequences: list[Sequence] = []
    for path in paths:
        if path.is_file():
            sequences += warped(read_image(path), path)
        elif path.is_dir():
            folders = [path] if _images(path) else sorted(p for p in path.iterdir() if p.is_dir() and _images(p))
            if not folders:
                raise InputError(f"{path}: has no images, expected img1, img2, ... or folders with such images")
            sequences += [read_sequence(folder) for folder in folders]
        else:
            raise InputError(f"{path}: there is no such image or folder")
    names = [sequence.name for sequence in sequences]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InputError(f"{twice[0]}: is the name of several folders or photographs, expected different names")
    return sequences


def read_sequence(folder: Path) -> Sequence:
    """Return the sequence in a folder: images ``img1.*``, ``img2.*`` and so on, with homographies ``H1to2p`` and so on.

    Raises InputError for a missing or damaged file.
    """
    paths = _images(folder)
    if sorted(paths) != list(range(1, len(paths) + 1)) or len(paths) < 2:
        missing = next(k for k in range(1, max(paths, default=0) + 2) if k not in paths)
        raise InputError(f"{folder}: has no img{missing}, expected img1, img2, ... without gaps")
    first = read_image(paths[1])
    images, homographies = [], []
    for k in range(2, len(paths) + 1):
        candidates = [folder / f"H1to{k}p{suffix}" for suffix in _SUFFIXES]
        file = next((candidate for candidate in candidates if candidate.exists()), None)
        if file is None:
            raise InputError(f"{folder}: has no homography H1to{k}p (plain text, .txt, or .xml of OpenCV) for img{k}")
        images.append(read_image(paths[k]))
        homographies.append(read_homography(file, first.shape))
    change, amounts = _change([view(h, first.shape) for h in homographies])
    return Sequence(folder.resolve().name, first, tuple(images), tuple(homographies), change, amounts)


def warped(photograph: Image, source: Path) -> list[Sequence]:
    """Return two sequences made from a photograph: reduced by :data:`ZOOMS`, and rotated by :data:`ROTATIONS`.

    The background of a reduced photograph is its mirror image at full size. All images of the rotated sequence are
    cropped to the largest square without empty corners. ``source``: path of the photograph, used for the names of the
    sequences and for messages. Raises InputError if the photograph is too small.
    """
    height, width = photograph.shape[:2]
    if min(height, width) < MIN_WARPED:
        expected = f"a photograph with at least {MIN_WARPED} px on each side"
        raise InputError(f"{source}: has {width} x {height} px, expected {expected}")
    name = f"{source.resolve().parent.name}/{source.stem}"
    return [_zoomed(photograph, f"{name} zoomed"), _rotated(photograph, f"{name} rotated")]


def _zoomed(photograph: Image, name: str) -> Sequence:
    """Return the sequence ``name`` of images of the ``photograph`` that are reduced by :data:`ZOOMS`."""
    height, width = photograph.shape[:2]
    images, homographies = [], []
    for zoom in ZOOMS:
        size = (round(width / zoom), round(height / zoom))
        small = np.asarray(cv2.resize(photograph, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        left, top = (width - size[0]) // 2, (height - size[1]) // 2
        whole = photograph[:, ::-1].copy()
        whole[top : top + size[1], left : left + size[0]] = small
        images.append(whole)
        # (0, 0) is the centre of a pixel, not its corner
        x, y = size[0] / width, size[1] / height
        shift = (0.5 * (x - 1.0) + left, 0.5 * (y - 1.0) + top)
        homographies.append(np.array(((x, 0.0, shift[0]), (0.0, y, shift[1]), (0.0, 0.0, 1.0))))
    return Sequence(name, photograph, tuple(images), tuple(homographies), SCALE, ZOOMS)


def _rotated(photograph: Image, name: str) -> Sequence:
    """Return the sequence ``name`` of images of the ``photograph`` that are rotated by :data:`ROTATIONS`."""
    height, width = photograph.shape[:2]
    side = int(min(height, width) / np.sqrt(2.0))
    centre, middle = np.array((width - 1.0, height - 1.0)) / 2.0, (side - 1.0) / 2.0

    def turned(degrees: float) -> tuple[Image, Array]:
        """Return the rotated square image, and the matrix (3, 3) from the photograph to it."""
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        matrix = np.eye(3)
        matrix[:2, :2] = ((c, -s), (s, c))
        matrix[:2, 2] = middle - matrix[:2, :2] @ centre
        image = cv2.warpAffine(
            photograph, matrix[:2], (side, side), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
        )
        return np.asarray(image, dtype=np.uint8), matrix

    first, to_first = turned(0.0)
    back = np.linalg.inv(to_first)
    pairs = [turned(degrees) for degrees in ROTATIONS]
    homographies = tuple(matrix @ back for _, matrix in pairs)
    return Sequence(name, first, tuple(image for image, _ in pairs), homographies, ROTATION, ROTATIONS)


def _images(folder: Path) -> dict[int, Path]:
    """Return the files ``imgK.*`` of a folder by K. Raises InputError if several files have the same number K."""
    files: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        match = re.fullmatch(r"img(\d+)\.\w+", path.name)
        if match and path.is_file():
            k = int(match[1])
            if k in files:
                raise InputError(f"{folder}: has both {files[k].name} and {path.name}, expected one img{k}")
            files[k] = path
    return files


def _change(views: Several[ViewChange]) -> tuple[str, tuple[float, ...]]:
    """Return the dominant change of a sequence, and its amount in each view. If no view changes much, for example with
    blur, the amounts are the numbers of the images."""
    zooms = [max(v.zoom, 1.0 / v.zoom) for v in views]
    if max(v.tilt for v in views) > _TILTED:
        return VIEWPOINT, tuple(v.tilt for v in views)
    if max(zooms) > _SCALED:
        return SCALE, tuple(zooms)
    if max(abs(v.rotation) for v in views) > _TURNED:
        return ROTATION, tuple(float(np.degrees(abs(v.rotation))) for v in views)
    return OTHER, tuple(float(k) for k in range(2, len(views) + 2))
