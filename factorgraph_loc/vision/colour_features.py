"""The paper's colour features behind the interface that all features share."""

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.vision import descriptor, detector, weights
from factorgraph_loc.vision.colour import Float, colour_channels
from factorgraph_loc.vision.images import as_image, as_mask, is_blank
from factorgraph_loc.vision.keypoints import Descriptors, Keypoints
from factorgraph_loc.vision.scale_space import ScaleSpace


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
        return kept, weights.shipped()(descriptor.values(found))

    def detectAndCompute(self, image: object, mask: object = None) -> tuple[Keypoints, Descriptors]:  # noqa: N802 (as OpenCV)
        space, keypoints = self._found(image, mask)
        return keypoints, weights.shipped()(descriptor.values(self._records(space, keypoints)))

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
