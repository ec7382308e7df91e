"""Detectors for comparison with the colour features, written for evaluation: compact, not fast, without descriptors.

Harris-Laplace and Hessian-Laplace: Mikolajczyk, Schmid, "Scale & Affine Invariant Interest Point Detectors", IJCV 60, 2004,
section 2. This is the simplified detector: it keeps points of each scale where the Laplacian has its maximum over scales.
Fast-Hessian: Bay, Tuytelaars, Van Gool, "SURF: Speeded Up Robust Features", ECCV 2006, section 3. All use the luminance.
"""

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.vision.features import Keypoints
from factorgraph_loc.vision.images import Image, as_image, is_blank
from factors.se2 import Array

SIGMAS: Array = 1.2 * np.exp2(0.25 * np.arange(18.0))  # px, to 23
HARRIS_TRACE = 0.05  # weight of the squared trace in Harris' measure
DERIVATIVE = 0.7  # derivative scale over integration scale
OCTAVES = (
    (9, 15, 21, 27),
    (15, 27, 39, 51),
    (27, 51, 75, 99),
    (51, 99, 147, 195),
)  # sides of Fast-Hessian's filters, px
BOX_SIGMA = 1.2 / 9.0  # scale over side of a filter, as in the paper; the lobes are those of a Gaussian of side / 6
BOX_XY = 0.9  # weight of the mixed derivative, which boxes overestimate

_TAIL = 1e-8  # of responses, relative to the strongest: smaller ones are flat image regions
_ONE, _SLOPE, _BEND = (np.array(kernel, dtype=np.float32) for kernel in ((0, 1, 0), (-0.5, 0, 0.5), (1, -2, 1)))

Plane = NDArray[np.float32]
Truths = NDArray[np.bool_]


def maximal_laplacian(strength: Callable[[Plane, float], Plane], image: object, count: int) -> Keypoints:
    """Local maxima of ``strength`` in the image, at scales of maximal Laplacian; at most ``count``, the strongest first. Sizes are
    twice the scale of the Laplacian."""
    plane = _luminance(image)
    if plane is None:
        return Keypoints.empty()
    strengths = np.stack([strength(plane, sigma) for sigma in SIGMAS])
    laplacians = np.stack([np.abs(_laplacian(plane, sigma)) for sigma in SIGMAS])
    inner = slice(1, len(SIGMAS) - 1)
    in_scale = (laplacians[inner] > laplacians[:-2]) & (laplacians[inner] >= laplacians[2:])
    peaks = np.zeros(strengths.shape, dtype=bool)
    peaks[inner] = in_scale & np.stack([_peaks(s) for s in strengths[inner]])
    return _strongest(strengths, laplacians, peaks, SIGMAS, count)


def fast_hessian(image: object, count: int) -> Keypoints:
    """Local maxima over image and scale of the determinant of the Hessian, with derivatives from box filters; at most ``count``.
    Sizes are twice the scale of the filter.

    Each octave is computed at full resolution: the paper skips every second pixel of the second octave, and so on.
    """
    plane = _luminance(image)
    if plane is None:
        return Keypoints.empty()
    integral = np.asarray(cv2.integral(plane, sdepth=cv2.CV_64F), dtype=float)
    sides = sorted({side for octave in OCTAVES for side in octave})
    maps = {side: box_hessian(integral, side) for side in sides}
    points = []
    for octave in OCTAVES:
        stack = np.stack([maps[side] for side in octave])
        peaks = np.zeros(stack.shape, dtype=bool)
        for level in (1, 2):
            beside = np.maximum(_highest(stack[level - 1]), _highest(stack[level + 1]))
            peaks[level] = _peaks(stack[level]) & (stack[level] > beside)
        points.append(_strongest(stack, stack, peaks, BOX_SIGMA * np.array(octave), count))
    return _merged(points, count)


def harris(plane: Plane, sigma: float) -> Plane:
    """Harris measure at the integration scale ``sigma`` [px], normalised for scale (Mikolajczyk, Schmid, 2004, eqs. 1 and 2)."""
    dx, dy = _gradient(plane, DERIVATIVE * sigma)
    weight = (DERIVATIVE * sigma) ** 2
    xx, xy, yy = (weight * _blur(product, sigma) for product in (dx * dx, dx * dy, dy * dy))
    return np.asarray(xx * yy - xy * xy - HARRIS_TRACE * (xx + yy) ** 2, dtype=np.float32)


def hessian(plane: Plane, sigma: float) -> Plane:
    """Determinant of the Hessian at the scale ``sigma`` [px], normalised for scale."""
    xx, xy, yy = _second(plane, sigma)
    return np.asarray(xx * yy - xy * xy, dtype=np.float32)


def box_hessian(integral: Array, side: int) -> Plane:
    """Determinant of the Hessian by box filters of ``side`` px on an integral image (H + 1, W + 1), divided by their area; 0 where
    they do not fit."""
    height, width = integral.shape[0] - 1, integral.shape[1] - 1
    out = np.zeros((height, width), dtype=np.float32)
    reach, lobe = side // 2, side // 3
    if height <= 2 * reach or width <= 2 * reach:
        return out

    def box(top: int, left: int, rows: int, columns: int) -> Array:
        """Sums of boxes with a corner at (``top``, ``left``) from the pixel, for all pixels where the filter fits."""

        def at(dy: int, dx: int) -> Array:
            return integral[reach + dy : height - reach + dy, reach + dx : width - reach + dx]

        bottom, right = top + rows, left + columns
        return np.asarray(at(bottom, right) - at(top, right) - at(bottom, left) + at(top, left))

    half, wide = lobe // 2, 2 * lobe - 1
    yy = box(-reach, -lobe + 1, side, wide) - 3.0 * box(-half, -lobe + 1, lobe, wide)
    xx = box(-lobe + 1, -reach, wide, side) - 3.0 * box(-lobe + 1, -half, wide, lobe)
    xy = box(-lobe, 1, lobe, lobe) + box(1, -lobe, lobe, lobe) - box(-lobe, -lobe, lobe, lobe) - box(1, 1, lobe, lobe)
    determinant = (xx * yy - (BOX_XY * xy) ** 2) / float(side) ** 4
    out[reach : height - reach, reach : width - reach] = determinant
    return out


def _luminance(image: object) -> Plane | None:
    """Luminance 0 to 1; None if the image has no features."""
    pixels: Image = as_image(image)
    if is_blank(pixels):
        return None
    grey = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
    return np.asarray(grey, dtype=np.float32) / np.float32(255.0)


def _blur(plane: Plane, sigma: float) -> Plane:
    return np.asarray(cv2.GaussianBlur(plane, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101), dtype=np.float32)


def _gradient(plane: Plane, sigma: float) -> tuple[Plane, Plane]:
    """Derivatives in x and y [1/px] at a scale, by central differences."""
    smooth = _blur(plane, sigma)
    kernels = ((_SLOPE, _ONE), (_ONE, _SLOPE))
    x, y = (np.asarray(cv2.sepFilter2D(smooth, cv2.CV_32F, *pair), dtype=np.float32) for pair in kernels)
    return x, y


def _second(plane: Plane, sigma: float) -> tuple[Plane, Plane, Plane]:
    """Second derivatives xx, xy, yy at a scale, normalised for it."""
    smooth = _blur(plane, sigma) * np.float32(sigma**2)
    kernels = ((_BEND, _ONE), (_SLOPE, _SLOPE), (_ONE, _BEND))
    xx, xy, yy = (np.asarray(cv2.sepFilter2D(smooth, cv2.CV_32F, *pair), dtype=np.float32) for pair in kernels)
    return xx, xy, yy


def _laplacian(plane: Plane, sigma: float) -> Plane:
    xx, _, yy = _second(plane, sigma)
    return xx + yy


def _highest(plane: Plane) -> Plane:
    """The maximum of the 3 x 3 neighbourhood of each pixel."""
    return np.asarray(cv2.dilate(plane, np.ones((3, 3), dtype=np.uint8)))


def _peaks(plane: Plane) -> Truths:
    """Pixels not below any of their eight neighbours, excluding the border and flat regions."""
    out = np.zeros(plane.shape, dtype=bool)
    out[1:-1, 1:-1] = ((plane >= _highest(plane)) & (plane > 0.0))[1:-1, 1:-1]
    return out


def _strongest(strengths: Plane, across: Plane, peaks: Truths, sigmas: Array, count: int) -> Keypoints:
    """The ``count`` strongest of ``peaks`` in stacks (L, H, W), refined in position in ``strengths`` and in scale in ``across``."""
    level, y, x = np.nonzero(peaks)
    response = strengths[level, y, x]
    order = np.argsort(-response, kind="stable")
    order = order[response[order] > _TAIL * response.max(initial=0.0)][:count]
    level, y, x, response = level[order], y[order], x[order], response[order]
    dx = _vertex(*(strengths[level, y, x + d] for d in (-1, 0, 1)))
    dy = _vertex(*(strengths[level, y + d, x] for d in (-1, 0, 1)))
    between = _vertex(*(across[level + d, y, x] for d in (-1, 0, 1)))
    # filters of one octave are equally spaced, Gaussian scales geometrically: between neighbours the two are nearly the same
    scale = np.exp(np.interp(level + between, np.arange(len(sigmas)), np.log(sigmas)))
    points = np.column_stack((x + dx, y + dy))
    none = np.full(len(points), np.nan)
    return Keypoints(points, 2.0 * scale, none, response.astype(float), level.astype(np.int64))


def _vertex(left: Plane, at: Plane, right: Plane) -> Array:
    """Offset of the vertex of the parabola through three equally spaced values, from -0.5 to 0.5."""
    bend = (left - 2.0 * at + right).astype(float)
    slope = 0.5 * (right - left).astype(float)
    top = np.divide(-slope, bend, out=np.zeros_like(slope), where=bend < 0.0)
    return np.asarray(np.clip(top, -0.5, 0.5))


def _merged(parts: list[Keypoints], count: int) -> Keypoints:
    """The ``count`` strongest of several; points found twice by a filter in two octaves are merged."""
    columns = [np.concatenate([getattr(part, name) for part in parts]) for name in Keypoints.__dataclass_fields__]
    everything = Keypoints(*columns)
    order = np.argsort(-everything.responses, kind="stable")
    kept, keys = [], set()
    for i in order.tolist():
        key = (*np.rint(everything.points[i]).astype(int).tolist(), round(float(np.log(everything.sizes[i])) * 5))
        if key not in keys:
            keys.add(key)
            kept.append(i)
    return everything[np.array(kept[:count], dtype=np.int64)]


DETECTORS: dict[str, Callable[[object, int], Keypoints]] = {
    "harris_laplace": partial(maximal_laplacian, harris),
    "hessian_laplace": partial(maximal_laplacian, hessian),
    "fast_hessian": fast_hessian,
}
