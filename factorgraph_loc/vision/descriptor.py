"""Values that describe a colour feature: 2 of space, 21 of scale, 5 of orientation and 9 of texture.

They are those of Algorithm 1 and figure 2 of Raoui, Bouyakhf, Devy, ICINCO 2011 ("the paper"). The intensity E is sampled on a
lattice of 24 x 24 places around a point, oriented by the direction of the point and in units of its scale. The values are the
product of the samples and a matrix of filters. In place of the paper's neighbours, four places in a cross around the point are
used. Normalised Laplacian of Gaussian: Lindeberg, IJCV 30, 1998. Gabor wavelets: Daugman, J. Opt. Soc. Am. A 2(7), 1985."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from factorgraph_loc.vision.keypoints import Float, Integers, Keypoints
from factorgraph_loc.vision.scale_space import ScaleSpace
from factors.se2 import Array

# the first of five places is the point, the other four are the cross around it; responses and texture are in grey levels
RECORD = np.dtype(
    [
        ("position", np.float32, 2),  # x, y [px]
        ("scale_responses", np.float32, (5, 4)),  # Laplacian of Gaussian at each place and scale
        ("scale", np.float32),  # [px]
        (
            "orientation",
            np.float32,
            5,
        ),  # of the gradient at each place, relative to the point's direction [rad], in (-pi, pi]
        ("texture", np.float32, (3, 3)),  # magnitude of the Gabor wavelet of each wavelength and direction
    ]
)
VALUES = 35  # number of values that are compared: all but the position
OWN_SCALE = 20  # index of the point's own scale, which gets no weight, because it changes with the camera's distance

# parameters of the filters, in units of a point's scale. The lattice is too small for the coarsest filters and truncates them
SIDE = 24
LOG_SCALES = (1.6, 2.4, 3.6, 5.4)
LOG_ARMS = (2.0, 4.0, 6.0, 8.0)
GRADIENT_SCALE = 3.3
GRADIENT_ARM = 6.0
WAVELENGTHS = (3.5, 7.0, 14.0)
ENVELOPE = 0.4  # standard deviation of a Gabor wavelet's envelope, divided by the wavelength

_FLAT = 1e-6  # grey levels: norm of a patch's responses below which they are set to 0


def records(space: ScaleSpace, keypoints: Keypoints, *, paper_literal: bool = False) -> NDArray[np.void]:
    """Return the values that describe N ``keypoints`` of an image, as records (N,) of the type :data:`RECORD`.

    ``space``: the scale space of the image. ``keypoints`` must have directions. By default the values describe the
    keypoint and four places around it. ``paper_literal``: describe the four nearest keypoints instead of the places, as
    Raoui et al. 2011. The nearest keypoints often differ between images, which makes the values less repeatable.
    """
    sigmas = keypoints.sizes / 2.0
    answers = space.patches(keypoints.points, sigmas, keypoints.angles, LATTICE) @ FILTERS
    result = np.empty(len(keypoints), dtype=RECORD)
    result["position"] = keypoints.points
    result["scale"] = sigmas
    result["scale_responses"] = answers[:, :20].reshape(-1, 5, 4)
    gradients = answers[:, 20:30].reshape(-1, 5, 2)
    result["orientation"] = np.arctan2(gradients[:, :, 1], gradients[:, :, 0])
    if paper_literal:
        near = _nearest(keypoints.points)
        result["scale_responses"][:, 1:] = result["scale_responses"][near, 0]
        relative = keypoints.angles[near] - keypoints.angles[:, None]
        result["orientation"][:, 1:] = np.angle(np.exp(1j * relative))
    wavelets = answers[:, 30:].reshape(-1, 3, 3, 2)
    result["texture"] = np.hypot(wavelets[..., 0], wavelets[..., 1])
    return result


def values(record: NDArray[np.void]) -> Float:
    """Return 35 dimensionless values (N, 35) for the comparison of N features. ``record`` (N,): see :func:`records`.

    Responses and textures are divided by their norm, for invariance to contrast. Scale is in octaves. Orientations are
    replaced by their sine, which is continuous where an angle wraps around.
    """
    responses = record["scale_responses"].reshape(-1, 20)
    texture = record["texture"].reshape(-1, 9)
    return np.hstack(
        [_unit(responses), np.log2(record["scale"])[:, None], np.sin(record["orientation"]), _unit(texture)]
    ).astype(np.float32)


def _nearest(points: Array) -> Integers:
    """Return the indices (N, 4) of the four nearest neighbours of each of ``points`` (N, 2), nearest first. If there
    are too few neighbours, the index of the point itself is used."""
    indices = cKDTree(points).query(points, k=np.arange(2, 6))[1] if len(points) else np.empty((0, 4), dtype=np.int64)
    return np.where(indices < len(points), indices, np.arange(len(points))[:, None]).astype(np.int64)


def _unit(block: Float) -> Float:
    return np.asarray(block / np.maximum(np.linalg.norm(block, axis=1, keepdims=True), _FLAT), dtype=np.float32)


def cross(arm: float) -> Array:
    """Return five places (5, 2) relative to a point: the origin, and one on each diagonal at the distance ``arm``."""
    angles = np.pi / 4.0 + np.pi / 2.0 * np.arange(4.0)
    return np.vstack([np.zeros(2), arm * np.stack([np.cos(angles), np.sin(angles)], axis=1)])


def _gaussian(scale: float, centre: Array) -> tuple[Array, Array, float]:
    """Return the weights (M,) of a Gaussian at the M places of :data:`LATTICE`, their offsets (M, 2) from ``centre``
    (2,), and the variance. It is ``scale``**2 - 1, because the samples already have a blur with the variance 1."""
    variance = scale**2 - 1.0
    away = LATTICE - centre
    return np.exp(-0.5 * (away**2).sum(axis=1) / variance) / (2.0 * np.pi * variance), away, variance


def _laplacian(scale: float, centre: Array) -> Array:
    window, away, variance = _gaussian(scale, centre)
    response = scale**2 * ((away**2).sum(axis=1) / variance - 2.0) / variance * window
    # the sum of the truncated filter is not zero: subtract it, because the response must not depend on brightness
    return np.asarray(response - window * (response.sum() / window.sum()))


def _gradient(scale: float, centre: Array) -> list[Array]:
    window, away, variance = _gaussian(scale, centre)
    slopes = [scale * away[:, axis] / variance * window for axis in (0, 1)]
    return [slope - window * (slope.sum() / window.sum()) for slope in slopes]


def _gabor(wavelength: float, angle: float) -> list[Array]:
    """Return the weights of a Gabor wavelet at the M places of :data:`LATTICE`, as two arrays (M,): the real part
    without its mean, and the imaginary part. ``angle`` [rad]: direction of the wave."""
    x, y = LATTICE.T
    window = np.exp(-0.5 * (x**2 + y**2) / (ENVELOPE * wavelength) ** 2)
    window /= window.sum()
    phase = 2.0 * np.pi / wavelength * (x * np.cos(angle) + y * np.sin(angle))
    even = window * np.cos(phase)
    return [even - window * even.sum(), window * np.sin(phase)]


def _filters() -> Float:
    columns = [
        _laplacian(scale, cross(arm)[place])
        for place in range(5)
        for scale, arm in zip(LOG_SCALES, LOG_ARMS, strict=True)
    ]
    for centre in cross(GRADIENT_ARM):
        columns += _gradient(GRADIENT_SCALE, centre)
    for wavelength in WAVELENGTHS:
        for turn in range(3):
            columns += _gabor(wavelength, turn * np.pi / 3.0)
    return np.stack(columns, axis=1).astype(np.float32)


_arm = np.arange(SIDE) - (SIDE - 1) / 2.0
LATTICE: Float = np.stack(np.meshgrid(_arm, _arm), axis=-1).reshape(-1, 2).astype(np.float32)
FILTERS = _filters()
