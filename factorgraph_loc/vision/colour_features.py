"""The paper's colour features behind the interface that all features share."""

from dataclasses import dataclass
from functools import cache
from importlib import resources

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.vision import descriptor, detector
from factorgraph_loc.vision.colour import Float, colour_channels
from factorgraph_loc.vision.images import as_image, as_mask, is_blank
from factorgraph_loc.vision.keypoints import Descriptors, Keypoints
from factorgraph_loc.vision.scale_space import ScaleSpace


@dataclass(frozen=True, eq=False)
class Weights:
    """How much each of the 35 values of a colour feature counts: a linear map, learnt where the same points are seen twice.

    ``map`` (35, 35) takes the values, less their ``mean`` (35,), to a space where those of one point, seen in two images, differ
    by as much in all directions: Euclidean distance there is Mahalanobis distance of the values (within-class whitening,
    Fukunaga, "Introduction to Statistical Pattern Recognition", 1990, section 10.2).
    """

    mean: Float
    map: Float

    def __call__(self, values: Float) -> Float:
        """Descriptors (N, 35), of length one, of ``values`` (N, 35)."""
        mapped = (values - self.mean) @ self.map
        length = np.linalg.norm(mapped, axis=1, keepdims=True)
        return np.asarray(mapped / np.maximum(length, np.finfo(np.float32).tiny), dtype=np.float32)


@cache
def shipped_weights() -> Weights:
    """The weights that come with the package, learnt by ``scripts/learn_feature_weights`` on the sequences bark and graf of
    Mikolajczyk et al., IJCV 65, 2005."""
    with (
        resources.files("factorgraph_loc.vision").joinpath("weights.npz").open("rb") as file,
        np.load(file, allow_pickle=False) as stored,
    ):
        return Weights(stored["mean"], stored["map"])


class ColourExtractor:
    """Colour features (:class:`~factorgraph_loc.vision.keypoints.Extractor`), of any image at most ``count``; descriptors
    are (N, 35) ``float32`` of length one.

    ``paper_literal``: for comparison, neighbours as the paper has them (:func:`~factorgraph_loc.vision.descriptor.records`).
    The memory for an image is kept and used for the next one of its size: an extractor serves one thread.
    """

    name = "colour"
    binary = False

    def __init__(self, count: int, *, paper_literal: bool = False) -> None:
        self._count = count
        self._paper_literal = paper_literal
        self._space: ScaleSpace | None = None

    def detect(self, image: object, mask: object = None) -> Keypoints:
        return self._found(image, mask)[1]

    def compute(self, image: object, keypoints: Keypoints) -> tuple[Keypoints, Descriptors]:
        """Those of ``keypoints`` that are in the image, and their descriptors; a point without direction gets one."""
        kept, found = self.record(image, keypoints)
        return kept, shipped_weights()(descriptor.values(found))

    def detectAndCompute(self, image: object, mask: object = None) -> tuple[Keypoints, Descriptors]:  # noqa: N802 (as OpenCV)
        space, keypoints = self._found(image, mask)
        return keypoints, shipped_weights()(descriptor.values(self._records(space, keypoints)))

    def record(self, image: object, keypoints: Keypoints) -> tuple[Keypoints, NDArray[np.void]]:
        """What :meth:`compute` describes, with the raw values, :data:`~factorgraph_loc.vision.descriptor.RECORD`
        (N,)."""
        pixels = as_image(image)
        if len(keypoints) == 0 or is_blank(pixels):
            return Keypoints.empty(), np.empty(0, dtype=descriptor.RECORD)
        space = self._filled(colour_channels(pixels))
        size = np.array(pixels.shape[1::-1])
        inside = np.all((keypoints.points >= 0.0) & (keypoints.points <= size - 1.0), axis=1) & (keypoints.sizes > 0.0)
        kept = keypoints[inside]
        angles = detector.orientations(space, kept.points, kept.sizes / 2.0)
        angles = np.where(np.isnan(kept.angles), angles, kept.angles)
        kept = Keypoints(kept.points, kept.sizes, angles, kept.responses, kept.levels)
        return kept, self._records(space, kept)

    def _found(self, image: object, mask: object) -> tuple[ScaleSpace | None, Keypoints]:
        pixels = as_image(image)
        where = as_mask(mask, pixels)
        if is_blank(pixels):
            return None, Keypoints.empty()
        channels = colour_channels(pixels)
        space = self._filled(channels)
        return space, detector.detect(space, channels[1:], where, self._count)

    def _filled(self, channels: list[Float]) -> ScaleSpace:
        shape, colours = channels[0].shape, len(channels) - 1
        if self._space is None or (self._space.shape, self._space.colours) != (shape, colours):
            self._space = ScaleSpace(shape, colours)
        self._space.fill(channels[0])
        return self._space

    def _records(self, space: ScaleSpace | None, keypoints: Keypoints) -> NDArray[np.void]:
        if space is None:
            return np.empty(0, dtype=descriptor.RECORD)
        return descriptor.records(space, keypoints, paper_literal=self._paper_literal)
