"""Gaussian scale space: a pyramid of octaves. An octave has an image at six scales; four are characteristic scales.

The size of a feature is one of the characteristic scales. A :class:`ScaleSpace` can be used for all images of one size, to reuse
its memory. Scale-normalised derivatives: Lindeberg, "Feature detection with automatic scale selection", IJCV 30, 1998."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from factorgraph_loc.vision.images import MIN_SIDE
from factorgraph_loc.vision.kernels import sample_patches
from factorgraph_loc.vision.keypoints import Float, Integers
from factors.se2 import Array

SCALES = 4  # characteristic scales of an octave
STEP = 2.0 ** (1.0 / SCALES)  # ratio of two consecutive scales
FINEST = 1.3  # px: standard deviation of the first characteristic scale

# standard deviations of an octave's scales, in pixels of the octave: the characteristic scales, one below and one above
SIGMAS: Array = FINEST * STEP ** np.arange(-1.0, SCALES + 1.0)


@dataclass(frozen=True, eq=False)
class Octave:
    """The arrays of one octave of a scale space.

    ``planes`` (6, H, W): the intensity of the image, blurred to each scale of :data:`SIGMAS`. ``colours`` (C, H, W):
    the colour channels at one scale. ``products`` (3, H, W), ``strength`` (H, W), ``largest`` (H, W): work arrays of
    the detector. ``step`` [px]: the size of a pixel of the octave, in pixels of the image.
    """

    planes: Float
    colours: Float
    products: Float
    strength: Float
    largest: Float
    step: float

    @classmethod
    def of(cls, planes: Float, colours: int, step: float) -> Octave:
        size = planes.shape[1:]
        new = [np.empty((count, *size), dtype=np.float32) for count in (colours, 3, 2)]
        return cls(planes, new[0], new[1], new[2][0], new[2][1], step)


class ScaleSpace:
    """The scale space of an image. Each octave has half the size of the previous one, down to a side of 16 px.

    ``shape``: height and width of the images. ``colours``: the number of colour channels in addition to the intensity.
    """

    def __init__(self, shape: tuple[int, ...], colours: int) -> None:
        self.shape, self.colours = shape, colours
        sizes = [shape]
        while min(sizes[-1]) >= 2 * MIN_SIDE:
            sizes.append(tuple((side + 1) // 2 for side in sizes[-1]))
        areas = [int(np.prod(size)) for size in sizes]
        starts = np.concatenate([[0], np.cumsum(areas) * len(SIGMAS)]).tolist()
        self._pixels: Float = np.empty(starts[-1], dtype=np.float32)
        self.octaves = [
            Octave.of(self._pixels[starts[o] : starts[o + 1]].reshape(-1, *size), colours, 2.0**o)
            for o, size in enumerate(sizes)
        ]
        levels = [(o, i) for o in range(len(sizes)) for i in range(1, SCALES + 1)]
        self._starts: Integers = np.array([starts[o] + i * areas[o] for o, i in levels])
        self._sizes: Integers = np.array([sizes[o] for o, _ in levels])
        self._steps: Array = np.array([2.0**o for o, _ in levels])

    def fill(self, intensity: Float) -> None:
        """Blur the ``intensity`` (H, W) of an image to all scales, and write the results to the planes of the
        octaves."""
        blur(intensity, self.octaves[0].planes[0], SIGMAS[0])
        for o, octave in enumerate(self.octaves):
            if o > 0:
                octave.planes[0] = self.octaves[o - 1].planes[SCALES, ::2, ::2]
            for i in range(1, len(SIGMAS)):
                blur(octave.planes[i - 1], octave.planes[i], more_blur(SIGMAS[i - 1], SIGMAS[i]))

    def levels(self, sigmas: Array) -> Integers:
        """Return the indices (N,) of the blurs of the scale space that are nearest to ``sigmas`` (N,) [px]. The indices
        begin at the smallest blur, and continue over all octaves."""
        nearest = np.rint(SCALES * np.log2(sigmas / FINEST))
        return np.asarray(np.clip(nearest, 0, len(self._steps) - 1), dtype=np.int64)

    def patches(self, points: Array, sigmas: Array, angles: Array, offsets: Float) -> Float:
        """Return samples (N, M) of the intensity at M places around each of N points.

        ``points`` (N, 2) [px]. ``sigmas`` (N,) [px]: the scales of the points. ``offsets`` (M, 2): the sampled places
        around each point, in units of its scale and along axes rotated by ``angles`` (N,) [rad]. Outside the image the
        nearest pixel is used.
        """
        levels = self.levels(sigmas)
        steps = self._steps[levels]
        axis = (sigmas / steps)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        frames = np.hstack([points / steps[:, None], axis]).astype(np.float32)
        patches = np.empty((len(points), len(offsets)), dtype=np.float32)
        sample_patches(self._pixels, self._starts[levels], self._sizes[levels], frames, offsets, patches)
        return patches


def blur(source: Float, target: Float, sigma: float) -> None:
    """Blur ``source`` (H, W) by a Gaussian with standard deviation ``sigma`` [px] and mirrored borders. The result is
    written to ``target``, which may be ``source``."""
    side = 2 * int(np.ceil(3.0 * sigma)) + 1
    cv2.GaussianBlur(source, (side, side), sigma, dst=target, borderType=cv2.BORDER_REFLECT_101)


def more_blur(have: float, want: float) -> float:
    """Return the standard deviation [px] of the Gaussian that increases a blur of ``have`` [px] to ``want`` [px]."""
    return float(np.sqrt(want**2 - have**2))
