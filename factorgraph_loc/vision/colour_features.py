"""Extractor of the colour features of the paper (Raoui, Bouyakhf, Devy, ICINCO 2011).

Images are converted to the Gaussian colour model: intensity and two opponent colours, each a linear combination of red,
green and blue. For RGB cameras this approximates the response of a Gaussian receptive field to a spectrum and its first
two derivatives (Geusebroek, van den Boomgaard, Smeulders, Geerts, "Color invariance", IEEE TPAMI 23(12), 2001, eq. 5).
"""

from dataclasses import dataclass
from functools import cache
from importlib import resources

import cv2
import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.vision import descriptor, detector
from factorgraph_loc.vision.images import Image, as_image, is_blank
from factorgraph_loc.vision.keypoints import Descriptors, Float, Keypoints
from factorgraph_loc.vision.scale_space import ScaleSpace

# rows: E, E_lambda (yellow against blue), E_lambda_lambda (red against green); columns: R, G, B
GAUSSIAN_COLOUR = np.array([[0.06, 0.63, 0.27], [0.30, 0.04, -0.35], [0.34, -0.60, 0.17]])
_FROM_BGR = GAUSSIAN_COLOUR[:, ::-1].astype(np.float32).copy()


@dataclass(frozen=True, eq=False)
class Weights:
    """A linear map from the 35 values of a colour feature to its descriptor, learnt from points observed in two images.

    ``map`` (35, 35) multiplies the values minus their ``mean`` (35,). After the map, the difference between two views
    of a point has unit covariance. This is within-class whitening (Fukunaga, "Introduction to Statistical Pattern
    Recognition", 1990, section 10.2).
    """

    mean: Float
    map: Float

    def __call__(self, values: Float) -> Float:
        """Return descriptors (N, 35) of unit length. ``values`` (N, 35): dimensionless values of N features, from
        :func:`~factorgraph_loc.vision.descriptor.values`."""
        mapped = (values - self.mean) @ self.map
        length = np.linalg.norm(mapped, axis=1, keepdims=True)
        return np.asarray(mapped / np.maximum(length, np.finfo(np.float32).tiny), dtype=np.float32)


@cache
def shipped_weights() -> Weights:
    """Return the weights that are part of the package. ``scripts/learn_feature_weights`` learnt them from the image
    sequences bark and graf of Mikolajczyk et al., IJCV 65, 2005."""
    with (
        resources.files("factorgraph_loc.vision").joinpath("weights.npz").open("rb") as file,
        np.load(file, allow_pickle=False) as stored,
    ):
        return Weights(stored["mean"], stored["map"])


class ColourExtractor:
    """Extractor of colour features (see :class:`~factorgraph_loc.vision.keypoints.Extractor`).

    The descriptors (N, 35) are ``float32`` and of unit length. ``count``: the largest number of features per image.
    ``everywhere``: True to choose features in all parts of an image, False to choose the strongest. ``paper_literal``:
    compute descriptors exactly as Raoui et al. 2011, for comparison (see
    :func:`~factorgraph_loc.vision.descriptor.records`). An extractor is not thread-safe, because it reuses the memory
    of the previous image.
    """

    def __init__(self, count: int, *, everywhere: bool = False, paper_literal: bool = False) -> None:
        self._count = count
        self._everywhere = everywhere
        self._paper_literal = paper_literal
        self._space: ScaleSpace | None = None

    def detect(self, image: object) -> Keypoints:
        return self._detect(image)[1]

    def detectAndCompute(self, image: object) -> tuple[Keypoints, Descriptors]:  # noqa: N802 (as OpenCV)
        keypoints, described = self.record(image)
        return keypoints, shipped_weights()(descriptor.values(described))

    def record(self, image: object) -> tuple[Keypoints, NDArray[np.void]]:
        """Return the N features of ``image``, and their values before the multiplication by :class:`Weights`. The
        values are a structured array (N,) of the type :data:`~factorgraph_loc.vision.descriptor.RECORD`."""
        space, keypoints = self._detect(image)
        if space is None:
            return keypoints, np.empty(0, dtype=descriptor.RECORD)
        return keypoints, descriptor.records(space, keypoints, paper_literal=self._paper_literal)

    def _detect(self, image: object) -> tuple[ScaleSpace | None, Keypoints]:
        pixels = as_image(image)
        if is_blank(pixels):
            return None, Keypoints.empty()
        channels = colour_channels(pixels)
        space = self._filled(channels)
        return space, detector.detect(space, channels[1:], self._count, everywhere=self._everywhere)

    def _filled(self, channels: list[Float]) -> ScaleSpace:
        shape, colours = channels[0].shape, len(channels) - 1
        if self._space is None or (self._space.shape, self._space.colours) != (shape, colours):
            self._space = ScaleSpace(shape, colours)
        self._space.fill(channels[0])
        return self._space


def colour_channels(image: Image) -> list[Float]:
    """Return the channels (H, W) of a BGR image (H, W, 3): E (intensity), E_lambda (yellow-blue), E_lambda_lambda
    (red-green). A grey image (H, W) has the channel E only."""
    if image.ndim == 2:
        return [image.astype(np.float32)]
    channels = cv2.split(cv2.transform(image.astype(np.float32), _FROM_BGR))
    return [np.asarray(channel, dtype=np.float32) for channel in channels]
