"""How level a floor is, learnt from what all points of an image have in common: a Bayesian filter over the scale of the tilt.

In most images the tilt of a robot is that of the floor; in some, as on a sill, it may have any scale.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from factors.compiled import compiled
from factors.se2 import Array

SCALES = 0.0005 * 2.0 ** (0.5 * np.arange(15))  # rad: of half a millimetre in a metre, up to 0.064
VAGUE = math.log(3.0)  # standard deviation of the logarithm of the first guess
MEMORY = 60.0  # images that the scale is learnt from
SILLS = 0.05  # share of images with another scale


@dataclass(frozen=True)
class TiltScale:
    """``sigma``: the standard deviation [rad] of roll and pitch. ``guess``, ``told``: logarithms of what is guessed of each of the
    :data:`SCALES`, and of what images told."""

    sigma: float
    guess: Array
    told: Array

    @staticmethod
    def guessed(sigma: float) -> TiltScale:
        """A guess, which is rough."""
        return TiltScale(sigma, -0.5 * (np.log(SCALES / sigma) / VAGUE) ** 2, np.zeros(len(SCALES)))

    def learnt(self, tilt: Array, covariance: Array, prior: float) -> tuple[TiltScale, float]:
        """What is known after the ``tilt`` (2,) of an image with its ``covariance`` (2, 2), found with the standard deviation
        ``prior``; and the standard deviation to be expected in this image."""
        told = self.told.copy()
        sigma, here = _learnt(tilt, covariance, prior, self.guess, told)
        return TiltScale(sigma, self.guess, told), here


@compiled(error_model="numpy")
def _learnt(tilt: Array, covariance: Array, prior: float, prior_log: Array, told: Array) -> tuple[float, float]:
    """See :meth:`TiltScale.learnt`: what is to be expected later, and in this image; ``told`` in place."""
    determinant = covariance[0, 0] * covariance[1, 1] - covariance[0, 1] ** 2
    a, b, d = covariance[1, 1] / determinant, -covariance[0, 1] / determinant, covariance[0, 0] / determinant
    x, y = a * tilt[0] + b * tilt[1], b * tilt[0] + d * tilt[1]
    image = np.empty(len(SCALES))
    for i, scale in enumerate(SCALES):
        # what the image tells without its prior, and a tilt of this scale
        more = 1.0 / scale**2 - 1.0 / prior**2
        determinant = (a + more) * (d + more) - b * b
        fit = ((d + more) * x * x - 2.0 * b * x * y + (a + more) * y * y) / determinant
        image[i] = 0.5 * (fit - math.log(determinant)) - 2.0 * math.log(scale)
    image, before, any_scale = _normalised(image), _normalised(prior_log + told), SILLS / len(SCALES)
    here = image * ((1.0 - SILLS) * before + any_scale)
    for i in range(len(SCALES)):
        told[i] = (1.0 - 1.0 / MEMORY) * told[i] + math.log((1.0 - SILLS) * image[i] + any_scale)
    return _scale(_normalised(prior_log + told)), _scale(here / here.sum())


@compiled(error_model="numpy")
def _normalised(log: Array) -> Array:
    weights: Array = np.exp(log - log.max())
    weights /= weights.sum()
    return weights


@compiled(error_model="numpy")
def _scale(weights: Array) -> float:
    """The mean of its logarithm, as a few large scales would dominate any other."""
    total = 0.0
    for i, scale in enumerate(SCALES):
        total += weights[i] * math.log(scale)
    return math.exp(total)
