"""Detector of colour features: corners in colour images, with a scale and a direction.

Strength: the Harris measure of the second moment matrix (Harris, Stephens, "A combined corner and edge detector", 1988), summed
over the channels of the Gaussian colour model. The matrix has a derivative scale and an integration scale (Mikolajczyk, Schmid,
"Scale & affine invariant interest point detectors", IJCV 60, 2004, eq. 1). The scale of a corner maximises the normalised
Laplacian of Gaussian (ibid., section 2.1). The direction is the peak of a histogram of gradients (Lowe, "Distinctive image
features", IJCV 60, 2004, section 5). Corners near a stronger corner of about the same scale are suppressed (Brown, Szeliski,
Winder, "Multi-image matching using multi-scale oriented patches", CVPR 2005, section 2.1)."""

import cv2
import numpy as np

from factorgraph_loc.vision.kernels import (
    Int32,
    corner_strength,
    locally_strongest,
    orientation_histograms,
    refined_peaks,
    structure_tensor,
)
from factorgraph_loc.vision.keypoints import PARTS, Float, Keypoints, spread_out
from factorgraph_loc.vision.scale_space import SCALES, SIGMAS, STEP, Octave, ScaleSpace, blur, more_blur
from factors.se2 import Array

INTEGRATION = 0.8  # ratio of integration scale and characteristic scale; the derivative scale is the next finer scale
WEAKEST = 1.0  # squared grey levels: weaker corners are camera noise
# Exponents of the response, which ranks corners. A corner with a strong Laplacian has a well-defined scale. A corner with a large
# scale remains visible when the camera moves away.
BY_STRENGTH, BY_LAPLACIAN, BY_SCALE = 0.7, 0.6, 0.3
BORDER = 4  # pixels of an octave: no corners are detected this near to the image border
CLEARANCE = 1.2  # in units of a point's scale: the point is suppressed if a stronger one is nearer

_NEIGHBOURS = np.ones((3, 3), dtype=np.uint8)

ORIENTATION_SIDE = 13
ORIENTATION_SPACING = 0.85  # in units of a point's scale
ORIENTATION_WINDOW = 2.25  # standard deviation of the Gaussian weight, in units of a point's scale
ORIENTATION_BINS = 36

_arm = ORIENTATION_SPACING * (np.arange(ORIENTATION_SIDE) - ORIENTATION_SIDE // 2)
_grid = np.stack(np.meshgrid(_arm, _arm), axis=-1)
_OFFSETS: Float = _grid.reshape(-1, 2).astype(np.float32)
_WEIGHTS: Float = np.exp(-(_grid[1:-1, 1:-1] ** 2).sum(axis=2) / (2.0 * ORIENTATION_WINDOW**2)).astype(np.float32)


def detect(space: ScaleSpace, colours: list[Float], count: int, *, everywhere: bool = False) -> Keypoints:
    """Return the corners in an image, at most ``count``, by descending response.

    ``space``: the scale space of the image's intensity. ``colours``: the colour channels (H, W), empty for a grey
    image. ``everywhere``: True to choose points in all parts of the image, False to choose the strongest.
    """
    corners = np.vstack(_corners(space, colours))
    corners = corners[np.argsort(-corners[:, 3], kind="stable")]
    places, scales = corners[:, :2].astype(np.float32), corners[:, 2].astype(np.float32)
    is_best = locally_strongest(places, scales, CLEARANCE, STEP, len(corners) if everywhere else count)
    best, crowded = np.flatnonzero(is_best), np.flatnonzero(~is_best)
    if everywhere:
        best = best[spread_out(corners[best, :2], count, cells=PARTS)]
    corners = corners[np.sort(np.concatenate((best, crowded[: count - len(best)])))]
    points, sigmas = corners[:, :2], corners[:, 2]
    angles = orientations(space, points, sigmas)
    return Keypoints(points, 2.0 * sigmas, angles, corners[:, 3])


def orientations(space: ScaleSpace, points: Array, sigmas: Array) -> Array:
    """Return the dominant direction (N,) [rad] of the intensity gradient around points, in (-pi, pi].

    ``space``: the scale space of the image. ``points`` (N, 2) [px]. ``sigmas`` (N,) [px]: the scales of the points. The
    angle is counted from x (right) to y (down).
    """
    patches = space.patches(points, sigmas, np.zeros(len(points)), _OFFSETS)
    histograms = np.zeros((len(points), ORIENTATION_BINS), dtype=np.float32)
    orientation_histograms(patches, ORIENTATION_SIDE, _WEIGHTS, histograms)
    for _ in range(2):
        histograms = 0.25 * np.roll(histograms, 1, axis=1) + 0.5 * histograms + 0.25 * np.roll(histograms, -1, axis=1)
    best = histograms.argmax(axis=1)
    left, peak, right = (
        np.take_along_axis(histograms, ((best + i) % ORIENTATION_BINS)[:, None], axis=1)[:, 0].astype(float)
        for i in (-1, 0, 1)
    )
    bend = left - 2.0 * peak + right
    shift = np.divide(0.5 * (left - right), bend, out=np.zeros(len(points)), where=bend < 0.0)
    turns = (best + shift) / ORIENTATION_BINS
    return np.asarray(2.0 * np.pi * (turns - np.ceil(turns - 0.5)), dtype=float)


def _corners(space: ScaleSpace, colours: list[Float]) -> list[Array]:
    """Return the corners of each scale of an image, as an array (N, 4) for each scale. Its columns are x and y [px],
    scale [px] and response."""
    by_scale = []
    for o, octave in enumerate(space.octaves):
        if o > 0:
            octave.colours[:] = space.octaves[o - 1].colours[:, ::2, ::2]
        else:
            for source, plane in zip(colours, octave.colours, strict=True):
                blur(source, plane, SIGMAS[0])
        for i in range(1, SCALES + 1):
            fill_strength(octave, i)
            by_scale.append(_peaks(octave, i))
            for plane in octave.colours:
                blur(plane, plane, more_blur(SIGMAS[i - 1], SIGMAS[i]))
    return by_scale


def fill_strength(octave: Octave, i: int) -> None:
    """Write the Harris corner measure at the scale ``SIGMAS[i]`` of an octave to ``octave.strength``.
    ``octave.colours`` must already have the blur ``SIGMAS[i - 1]``."""
    structure_tensor(octave.planes[i - 1], octave.colours, octave.products)
    for product in octave.products:
        blur(product, product, INTEGRATION * SIGMAS[i])
    corner_strength(octave.products, np.float32(SIGMAS[i - 1] ** 2), octave.strength)


def _peaks(octave: Octave, i: int) -> Array:
    inner = (slice(BORDER, -BORDER), slice(BORDER, -BORDER))
    cv2.dilate(octave.strength, _NEIGHBOURS, dst=octave.largest)
    maxima = cv2.findNonZero(cv2.compare(octave.strength[inner], octave.largest[inner], cv2.CMP_EQ))
    pixels: Int32 = np.empty((0, 2), dtype=np.int32)
    if maxima is not None:
        pixels = (maxima.reshape(-1, 2) + BORDER).astype(np.int32)
    peaks = np.empty((len(pixels), 5))
    around = slice(i - 1, i + 2)
    count = refined_peaks(octave.strength, WEAKEST, octave.planes[around], SIGMAS[around] ** 2, pixels, peaks)
    x, y, steps, strength, laplacian = peaks[:count].T
    sigma = SIGMAS[i] * octave.step * STEP**steps
    response = strength**BY_STRENGTH * laplacian**BY_LAPLACIAN * sigma**BY_SCALE
    return np.stack([x * octave.step, y * octave.step, sigma, response], axis=1)
