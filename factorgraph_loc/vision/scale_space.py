"""Gaussian scale space: a pyramid whose octaves hold four characteristic scales and their neighbours.

One :class:`ScaleSpace` serves all images of a size, to reuse its memory. Derivatives are multiplied by powers of the scale:
Lindeberg, "Feature detection with automatic scale selection", IJCV 30, 1998."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from factorgraph_loc.vision.images import MIN_SIDE
from factorgraph_loc.vision.kernels import sample_patches
from factorgraph_loc.vision.keypoints import Float, Integers
from factors.se2 import Array

SCALES = 4  # characteristic scales of an octave
STEP = 2.0 ** (1.0 / SCALES)
FINEST = 1.3  # px: standard deviation of the first characteristic scale

# of each octave, in its own pixels: the four scales, one below and one above
SIGMAS: Array = FINEST * STEP ** np.arange(-1.0, SCALES + 1.0)


@dataclass(frozen=True, eq=False)
class Octave:
    """Memory for one octave: ``planes`` (6, H, W), E at each of :data:`SIGMAS`; ``colours`` (C, H, W), the other channels at one
    scale; ``products`` (3, H, W) and ``strength``, ``largest`` (H, W): work arrays of the detector. ``step`` [px]: size of a
    pixel of the octave in pixels of the image."""

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
    """Octaves for images of ``shape`` (H, W) with ``colours`` channels besides E, each half as large as the previous, down to 16
    px."""

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
        """Compute the planes of all octaves from E (H, W)."""
        blur(intensity, self.octaves[0].planes[0], SIGMAS[0])
        for o, octave in enumerate(self.octaves):
            if o > 0:
                octave.planes[0] = self.octaves[o - 1].planes[SCALES, ::2, ::2]
            for i in range(1, len(SIGMAS)):
                blur(octave.planes[i - 1], octave.planes[i], more_blur(SIGMAS[i - 1], SIGMAS[i]))

    def levels(self, sigmas: Array) -> Integers:
        """The index over all octaves of the characteristic scale nearest to each of ``sigmas`` (N,) [px]."""
        nearest = np.rint(SCALES * np.log2(sigmas / FINEST))
        return np.asarray(np.clip(nearest, 0, len(self._steps) - 1), dtype=np.int64)

    def patches(self, points: Array, sigmas: Array, angles: Array, offsets: Float) -> Float:
        """Samples (N, M) of E around ``points`` (N, 2) [px] at scales ``sigmas`` (N,) [px].

        ``offsets`` (M, 2): in units of the scale, along axes rotated by ``angles`` (N,) [rad]. Beyond the border the nearest pixel
        counts.
        """
        levels = self.levels(sigmas)
        steps = self._steps[levels]
        axis = (sigmas / steps)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        frames = np.hstack([points / steps[:, None], axis]).astype(np.float32)
        patches = np.empty((len(points), len(offsets)), dtype=np.float32)
        sample_patches(self._pixels, self._starts[levels], self._sizes[levels], frames, offsets, patches)
        return patches


def blur(source: Float, target: Float, sigma: float) -> None:
    """Gaussian blur of ``source`` (H, W) to ``target``, which may be the same, with mirrored borders; ``sigma`` [px]."""
    side = 2 * int(np.ceil(3.0 * sigma)) + 1
    cv2.GaussianBlur(source, (side, side), sigma, dst=target, borderType=cv2.BORDER_REFLECT_101)


def more_blur(have: float, want: float) -> float:
    """Standard deviation of the blur that takes an image of blur ``have`` to ``want``."""
    return float(np.sqrt(want**2 - have**2))
