"""Homographies between two images: mapping of points and regions, and the zoom, rotation and tilt they contain."""

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import NamedTuple

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import read_text
from factorgraph_loc.text import told
from factors.se2 import Array

_MAX_CONDITION = 1e12  # of the matrix in pixels: typical values for images of 1000 px are 1e4 to 1e7


class ViewChange(NamedTuple):
    """Change of view to a second image: ``zoom`` (above 1: larger there), ``rotation`` [rad], ``tilt`` (ratio of the axes of the
    ellipse that a small circle becomes, at least 1)."""

    zoom: float
    rotation: float
    tilt: float


def project(homography: Array, points: Array) -> Array:
    """Map points (N, 2) [px] of the first image to the second (N, 2); NaN if they lie at or behind infinity.

    ``homography`` (3, 3) has the sign set by :func:`checked`; its inverse then has the sign for the way back.
    """
    mapped = points @ homography[:, :2].T + homography[:, 2]
    w = np.where(mapped[:, 2] > 0.0, mapped[:, 2], np.nan)
    return np.asarray(mapped[:, :2] / w[:, None])


def jacobians(homography: Array, points: Array) -> Array:
    """Derivatives (N, 2, 2) of :func:`project`: the affine map of a small region around each of ``points`` (N, 2)."""
    w = points @ homography[2, :2] + homography[2, 2]
    return np.asarray(
        (homography[:2, :2] - project(homography, points)[:, :, None] * homography[2, :2]) / w[:, None, None]
    )


def invert(homography: Array) -> Array:
    """The inverse homography (3, 3)."""
    return np.asarray(np.linalg.inv(homography), dtype=float)


def inside(points: Array, shape: tuple[int, ...]) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which of ``points`` (N, 2) lie in an image of ``shape`` (height, width, ...); NaN do not."""
    last = np.array((shape[1] - 1.0, shape[0] - 1.0))
    return np.asarray(np.all((points >= 0.0) & (points <= last), axis=1))


def corners(shape: tuple[int, ...]) -> Array:
    """The centres (4, 2) of an image's corner pixels."""
    right, bottom = shape[1] - 1.0, shape[0] - 1.0
    return np.array(((0.0, 0.0), (right, 0.0), (right, bottom), (0.0, bottom)))


def corner_error(estimate: Array, truth: Array, shape: tuple[int, ...]) -> float:
    """Mean distance [px] in the second image between the corners of the first, of ``shape``, mapped by both homographies;
    infinite if ``estimate`` maps one to infinity."""
    at = corners(shape)
    distances = np.linalg.norm(project(estimate, at) - project(truth, at), axis=1)
    return float(np.mean(distances)) if np.isfinite(distances).all() else np.inf


def view(homography: Array, shape: tuple[int, ...]) -> ViewChange:
    """Zoom, rotation and tilt at the centre of the first image, of ``shape``."""
    (local,) = jacobians(homography, corners(shape).mean(axis=0, keepdims=True))
    left, axes, right = np.linalg.svd(local)
    turn = left @ right
    return ViewChange(
        float(np.sqrt(axes[0] * axes[1])), float(np.arctan2(turn[1, 0], turn[0, 0])), float(axes[0] / axes[1])
    )


def checked(matrix: Array, shape: tuple[int, ...], source: object) -> Array:
    """``matrix`` (3, 3) scaled so that the first image, of ``shape``, has w > 0. Raises InputError, naming ``source``, if it is
    not a homography.
    """
    if matrix.shape != (3, 3):
        raise InputError(f"{source}: has {matrix.size} numbers, expected the 3 x 3 of a homography")
    if not np.isfinite(matrix).all():
        raise InputError(f"{source}: has numbers that are not finite, expected a homography")
    if not np.any(matrix) or np.linalg.cond(matrix) > _MAX_CONDITION:
        raise InputError(f"{source}: is singular, expected a homography that can be inverted")
    w = corners(shape) @ matrix[2, :2] + matrix[2, 2]
    if not (np.all(w > 0.0) or np.all(w < 0.0)):
        raise InputError(f"{source}: sends part of the first image to infinity, expected a view of all of it")
    scaled = matrix / w.mean()
    if np.linalg.det(scaled) < 0.0:
        raise InputError(f"{source}: mirrors the image, expected a view of the same side")
    return np.asarray(scaled)


def read_homography(path: Path, shape: tuple[int, ...]) -> Array:
    """Read a homography (3, 3) for a first image of ``shape``: nine numbers as text, or a matrix in OpenCV's XML format.

    Raises InputError if it cannot be read or :func:`checked` rejects it.
    """
    text = read_text(path)
    if text.lstrip().startswith("<"):
        try:
            data = ET.fromstring(text.lstrip()).find(".//data")
        except ET.ParseError as error:
            raise InputError(f"{path}: is not XML: {told(error)}") from error
        if data is None:
            raise InputError(f"{path}: has no <data>, expected a matrix as OpenCV writes it")
        text = data.text or ""
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError as error:
        raise InputError(f"{path}: is not a matrix: {told(error)}, expected nine numbers") from error
    return checked(numbers.reshape(3, 3) if numbers.size == 9 else numbers, shape, path)
