"""Evaluation of features on image sequences with known homographies: repeatability and matching.

Matching score and precision: Mikolajczyk, Schmid, "A Performance Evaluation of Local Descriptors", PAMI 27, 2005,
section 3; a match is correct if the regions of its points overlap (:mod:`~factorgraph_loc.evaluation.features.repeatability`).
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np

from factorgraph_loc.evaluation.features.repeatability import (
    OVERLAP_ERROR,
    Shapes,
    common,
    pair_errors,
    repeatability,
)
from factorgraph_loc.evaluation.features.sequences import Sequence
from factorgraph_loc.vision.images import Image
from factorgraph_loc.vision.keypoints import Descriptors, Keypoints
from factorgraph_loc.vision.matching import RATIO, Matches, match
from factors.se2 import Array


@dataclass(frozen=True)
class Feature:
    """A kind of point feature. ``name``: its name in the results. ``find``: a function that returns the keypoints of an
    image and their descriptors. The descriptors are None for a detector without descriptors."""

    name: str
    find: Callable[[Image], tuple[Keypoints, Descriptors | None]]


class MatchScores(NamedTuple):
    """Matching scores of a pair of images. A match is correct if both points show the same place and their regions
    overlap.

    ``matching_score``: number of correct mutual matches divided by the smaller number of features in the common part of
    the images. In a mutual match, both features are the nearest neighbour of each other. ``matches``: number of mutual
    matches with a distance ratio below :data:`~factorgraph_loc.vision.matching.RATIO`. ``precision``: fraction of these
    ``matches`` that is correct. Without descriptors, ``matches`` is 0 and the other scores are NaN.
    """

    matches: int = 0
    matching_score: float = np.nan
    precision: float = np.nan


def evaluate(
    sequence: Sequence, what: Feature, progress: Callable[[], None] = lambda: None
) -> Iterator[dict[str, Any]]:
    """Yield a dictionary of scores of the feature ``what`` for each pair of the first and a later image of a sequence.

    Its keys are:

    - ``feature``, ``sequence``: their names. ``image``: number of the later image. ``change``: kind of change between
      both images, such as "rotation". ``amount``: size of this change.
    - ``features``: number of features in the later image. ``milliseconds``: time to compute them on one thread.
    - ``regions``, ``repeatability``, ``strict``: see
      :class:`~factorgraph_loc.evaluation.features.repeatability.Repeatability`.
    - ``matches``, ``matching_score``, ``precision``: see :class:`MatchScores`.

    ``progress`` is called after each image.
    """
    with _one_thread():
        what.find(sequence.first)  # the first call takes longer, and is not measured
        keypoints, descriptors = what.find(sequence.first)
        progress()
        for k, (image, homography) in enumerate(zip(sequence.others, sequence.homographies, strict=True)):
            started = time.perf_counter()
            image_keypoints, image_descriptors = what.find(image)
            milliseconds = 1e3 * (time.perf_counter() - started)
            shapes = (sequence.first.shape, image.shape)
            matched = MatchScores()
            if descriptors is not None and image_descriptors is not None:
                mutual, clear = (match(descriptors, image_descriptors, ratio=ratio) for ratio in (1.0, RATIO))
                matched = match_scores(keypoints, image_keypoints, mutual, clear, homography, shapes)
            yield {
                "feature": what.name,
                "sequence": sequence.name,
                "change": sequence.change,
                "image": k + 2,
                "amount": sequence.amounts[k],
                "features": len(image_keypoints),
                "milliseconds": milliseconds,
                **repeatability(keypoints, image_keypoints, homography, shapes)._asdict(),
                **matched._asdict(),
            }
            progress()


def match_scores(
    first: Keypoints, second: Keypoints, mutual: Matches, clear: Matches, homography: Array, shapes: Shapes
) -> MatchScores:
    """Return the scores of the matches between two images. A match is correct if both points lie in the common part of
    the images and their regions overlap.

    ``first``, ``second``: all points of the two images. ``mutual``: matches of mutual nearest neighbours. ``clear``:
    the matches of ``mutual`` with a small distance ratio. ``homography`` (3, 3): maps pixels of the first image to the
    second. ``shapes``: (height, width, ...) of both images.
    """
    in_first, in_second = common(first, second, homography, shapes)
    features = min(int(np.count_nonzero(in_first)), int(np.count_nonzero(in_second)))

    def correct(matches: Matches) -> int:
        i, j = matches.indices.T
        overlap = pair_errors(first[i], second[j], homography) < OVERLAP_ERROR
        return int(np.count_nonzero(in_first[i] & in_second[j] & overlap))

    return MatchScores(len(clear), correct(mutual) / max(features, 1), correct(clear) / max(len(clear), 1))


@contextmanager
def _one_thread() -> Iterator[None]:
    """Run OpenCV on one thread in this block, so that times are comparable."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)
