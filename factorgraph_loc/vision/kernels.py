"""Compiled loops of the colour features. Unlike numpy expressions they need no temporary images.

Images are ``float32``, to halve memory traffic. Several threads can run the loops in parallel, because the loops do not
use Python objects.
"""

import math

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.vision.keypoints import Float
from factors.compiled import compiled
from factors.se2 import Array

Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]
Truths = NDArray[np.bool_]

HALF = np.float32(0.5)
TINY = np.float32(1e-6)  # keeps a quotient finite where an image is flat
MAX_SHIFT = 0.7  # px: bound of the distance between a refined peak and its largest pixel
FAST = {"contract", "reassoc"}


@compiled(nogil=True, fastmath=FAST)
def structure_tensor(intensity: Float, colours: Float, products: Float) -> None:
    """Write the products of first derivatives of an image, summed over its channels, to ``products``.

    ``intensity`` (H, W), ``colours`` (C, H, W): the channels. ``products`` (3, H, W): the sums of dx dx, dx dy and dy
    dy. Derivatives are central differences, halved in the first and last row, and 0 in the first and last column.
    """
    height, width = intensity.shape
    xx, xy, yy = products[0], products[1], products[2]
    for y in range(height):
        up, down = max(y - 1, 0), min(y + 1, height - 1)
        row, above, below = intensity[y], intensity[up], intensity[down]
        xx[y, 0] = xy[y, 0] = xx[y, width - 1] = xy[y, width - 1] = 0.0
        yy[y, 0] = yy[y, width - 1] = 0.0
        for x in range(1, width - 1):
            dx, dy = HALF * (row[x + 1] - row[x - 1]), HALF * (below[x] - above[x])
            xx[y, x], xy[y, x], yy[y, x] = dx * dx, dx * dy, dy * dy
        for c in range(len(colours)):
            row, above, below = colours[c, y], colours[c, up], colours[c, down]
            for x in range(1, width - 1):
                dx, dy = HALF * (row[x + 1] - row[x - 1]), HALF * (below[x] - above[x])
                xx[y, x] += dx * dx
                xy[y, x] += dx * dy
                yy[y, x] += dy * dy


@compiled(nogil=True, fastmath=FAST)
def corner_strength(products: Float, scale: np.float32, strength: Float) -> None:
    """Write the Harris corner measure of each pixel to ``strength``.

    The measure is the determinant over the trace of the second moment matrix, multiplied by ``scale``. ``products`` (3,
    H, W): the elements xx, xy, yy of the matrix at each pixel. With a ``scale`` of 1, the measure is half the harmonic
    mean of the eigenvalues. ``strength`` (H, W): receives the result.
    """
    xx, xy, yy = products[0], products[1], products[2]
    height, width = strength.shape
    for y in range(height):
        for x in range(width):
            a, b, c = xx[y, x], xy[y, x], yy[y, x]
            strength[y, x] = scale * (a * c - b * b) / (a + c + TINY)


@compiled(nogil=True)
def _laplacian_near(plane: Float, y: int, x: int, weight: float) -> float:
    """Return the largest absolute Laplacian of ``plane`` at the pixel (x, y) and its neighbours, times ``weight``."""
    largest = 0.0
    for v in range(y - 1, y + 2):
        for u in range(x - 1, x + 2):
            value = plane[v, u - 1] + plane[v, u + 1] + plane[v - 1, u] + plane[v + 1, u] - 4.0 * plane[v, u]
            largest = max(largest, abs(value))
    return largest * weight


@compiled(nogil=True)
def refined_peaks(
    strength: Float, threshold: float, planes: Float, variances: Array, pixels: Int32, peaks: Array
) -> int:
    """Write the corners of an image to the first rows of ``peaks``, and return their number.

    ``strength`` (H, W): the corner strength. ``pixels`` (N, 2): x and y of its local maxima. ``planes`` (3, H, W): the
    intensity at three consecutive scales with ``variances`` (3,) [px^2]. A maximum is a corner if its strength is above
    ``threshold``. In addition, the normalised Laplacian near it must be largest in the middle plane.

    ``peaks`` (N, 5): the columns are x and y [px], refined by a paraboloid through 3x3 strengths; the refined scale, in
    planes from the middle plane; the strength; the absolute Laplacian.
    """
    count = 0
    for n in range(len(pixels)):
        x, y = pixels[n]
        value = strength[y, x]
        if value <= threshold:
            continue
        middle = _laplacian_near(planes[1], y, x, variances[1])
        below = _laplacian_near(planes[0], y, x, variances[0])
        if below > middle:
            continue
        above = _laplacian_near(planes[2], y, x, variances[2])
        if above > middle:
            continue
        dx, dy = 0.5 * (strength[y, x + 1] - strength[y, x - 1]), 0.5 * (strength[y + 1, x] - strength[y - 1, x])
        dxx = strength[y, x + 1] + strength[y, x - 1] - 2.0 * value
        dyy = strength[y + 1, x] + strength[y - 1, x] - 2.0 * value
        dxy = 0.25 * (strength[y + 1, x + 1] + strength[y - 1, x - 1] - strength[y + 1, x - 1] - strength[y - 1, x + 1])
        determinant = dxx * dyy - dxy * dxy
        shift_x = shift_y = 0.0
        if determinant > 0.0:
            shift_x = (dxy * dy - dyy * dx) / determinant
            shift_y = (dxy * dx - dxx * dy) / determinant
        bend = below - 2.0 * middle + above
        peaks[count, 0] = x + min(max(shift_x, -MAX_SHIFT), MAX_SHIFT)
        peaks[count, 1] = y + min(max(shift_y, -MAX_SHIFT), MAX_SHIFT)
        peaks[count, 2] = 0.5 * (below - above) / bend if bend < 0.0 else 0.0
        peaks[count, 3], peaks[count, 4] = value, middle
        count += 1
    return count


@compiled(nogil=True)
def locally_strongest(points: Float, scales: Float, reach: float, alike: float, most: int) -> Truths:
    """Return a mask (N,) of the points that have no stronger point nearby. Only the first ``most`` of them are True.

    ``points`` (N, 2) [px]: sorted by descending strength. ``scales`` (N,) [px]: their scales. Another point is nearby
    if its distance is less than ``reach`` times the point's scale, and the ratio of both scales is at most ``alike``.
    """
    alone, count = np.zeros(len(points), np.bool_), 0
    for n in range(len(points)):
        if count == most:
            break
        radius = (reach * scales[n]) ** 2
        alone[n] = True
        for m in range(n):
            ratio = scales[m] / scales[n]
            if ratio <= alike and ratio * alike >= 1.0:
                dx, dy = points[m, 0] - points[n, 0], points[m, 1] - points[n, 1]
                if dx * dx + dy * dy < radius:
                    alone[n] = False
                    break
        count += alone[n]
    return alone


@compiled(nogil=True, fastmath=FAST)
def sample_patches(planes: Float, starts: Int64, shapes: Int64, frames: Float, offsets: Float, patches: Float) -> None:
    """Write samples of rotated and scaled patches around N points to ``patches`` (N, M), by bilinear interpolation.

    Each point is in its own plane of a pyramid. ``planes`` (T,): the pixels of all planes, row by row. ``starts`` (N,):
    index of the first pixel of each point's plane. ``shapes`` (N, 2): height and width of the plane. ``frames`` (N, 4)
    [px]: x and y of the point in its plane, and the x axis (a, b) of the patch's frame. The length of this axis is the
    unit of ``offsets`` (M, 2), the sampled places in this frame. Outside the plane the nearest pixel is used.
    """
    for n in range(len(frames)):
        start, height, width = starts[n], shapes[n, 0], shapes[n, 1]
        px, py, a, b = frames[n, 0], frames[n, 1], frames[n, 2], frames[n, 3]
        right, bottom = np.float32(width - 1), np.float32(height - 1)
        for m in range(len(offsets)):
            u, v = offsets[m, 0], offsets[m, 1]
            x = min(max(px + a * u - b * v, np.float32(0.0)), right)
            y = min(max(py + b * u + a * v, np.float32(0.0)), bottom)
            column, row = min(int(x), width - 2), min(int(y), height - 2)
            fx, fy = x - np.float32(column), y - np.float32(row)
            at = start + row * width + column
            top = planes[at] + fx * (planes[at + 1] - planes[at])
            low = planes[at + width] + fx * (planes[at + width + 1] - planes[at + width])
            patches[n, m] = top + fy * (low - top)


@compiled(nogil=True)
def orientation_histograms(patches: Float, side: int, weights: Float, histograms: Float) -> None:
    """Add histograms of the gradient directions in N patches to ``histograms`` (N, bins).

    ``patches`` (N, side * side): the samples of each patch, row by row. ``weights`` (side - 2, side - 2): weights of
    the gradients, in addition to their magnitude. Bin 0 is centred at direction 0. Each gradient is distributed over
    the two nearest bins.
    """
    bins = histograms.shape[1]
    per_radian = np.float32(bins / (2.0 * math.pi))
    for n in range(len(patches)):
        for y in range(1, side - 1):
            for x in range(1, side - 1):
                at = y * side + x
                dx = patches[n, at + 1] - patches[n, at - 1]
                dy = patches[n, at + side] - patches[n, at - side]
                length = math.sqrt(dx * dx + dy * dy) * weights[y - 1, x - 1]
                place = (math.atan2(dy, dx) * per_radian + bins) % bins
                low = int(place)
                share = (place - low) * length
                histograms[n, low % bins] += length - share
                histograms[n, (low + 1) % bins] += share
