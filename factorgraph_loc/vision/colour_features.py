"""The paper's colour features behind the common interface of features.

Images have the Gaussian colour model: intensity and two opponent colours as linear combinations of red, green and blue. It is the
response, for RGB cameras, of a Gaussian receptive field to a spectrum and its first two derivatives (Geusebroek, van den Boomgaard,
Smeulders, Geerts, "Color invariance", IEEE TPAMI 23(12), 2001, eq. 5).
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
    """A linear map that weights the 35 values of a colour feature, learnt from points seen in two images.

    ``map`` (35, 35) multiplies the values minus their ``mean`` (35,). The results have unit covariance of the difference between
    two views of a point: their Euclidean distance is the Mahalanobis distance of the values (within-class whitening, Fukunaga,
    "Introduction to Statistical Pattern Recognition", 1990, section 10.2).
    """

    mean: Float
    map: Float

    def __call__(self, values: Float) -> Float:
        """Unit descriptors (N, 35) of ``values`` (N, 35)."""
        mapped = (values - self.mean) @ self.map
        length = np.linalg.norm(mapped, axis=1, keepdims=True)
        return np.asarray(mapped / np.maximum(length, np.finfo(np.float32).tiny), dtype=np.float32)


@cache
def shipped_weights() -> Weights:
    """The weights included in the package, learnt by ``scripts/learn_feature_weights`` on the sequences bark and graf of
    Mikolajczyk et al., IJCV 65, 2005."""
    with (
        resources.files("factorgraph_loc.vision").joinpath("weights.npz").open("rb") as file,
        np.load(file, allow_pickle=False) as stored,
    ):
        return Weights(stored["mean"], stored["map"])


class ColourExtractor:
    """Extractor of colour features (:class:`~factorgraph_loc.vision.keypoints.Extractor`), at most ``count`` per image, with
    ``float32`` unit descriptors (N, 35).

    ``everywhere``: of all parts of an image alike, not the strongest. ``paper_literal``: the neighbours of the paper
    (:func:`~factorgraph_loc.vision.descriptor.records`), for comparison. The memory of an image is reused for the next one of its
    size, so an extractor must be used by one thread only.
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
        """The points of ``image``, and their raw values :data:`~factorgraph_loc.vision.descriptor.RECORD` (N,)."""
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
    """E, E_lambda, E_lambda_lambda, each (H, W), of a BGR image; a grey image (H, W) gives E only."""
    if image.ndim == 2:
        return [image.astype(np.float32)]
    channels = cv2.split(cv2.transform(image.astype(np.float32), _FROM_BGR))
    return [np.asarray(channel, dtype=np.float32) for channel in channels]
