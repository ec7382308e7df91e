"""Evaluation of features on image sequences with known homographies: repeatability and matching.

Matching score and precision: Mikolajczyk, Schmid, "A Performance Evaluation of Local Descriptors", PAMI 27, 2005,
section 3; a match is correct if the regions of its points overlap (:mod:`~factorgraph_loc.evaluation.features.repeatability`).
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.features.competitors import DETECTORS
from factorgraph_loc.evaluation.features.repeatability import (
    OVERLAP_ERROR,
    Repeatability,
    Shapes,
    common,
    pair_errors,
    repeatability,
)
from factorgraph_loc.evaluation.features.sequences import Sequence
from factorgraph_loc.files.models import nearest
from factorgraph_loc.text import quoted
from factorgraph_loc.vision.features import EXTRACTORS, Descriptors, Integers, Keypoints, extractor
from factorgraph_loc.vision.images import Image
from factorgraph_loc.vision.matching import RATIO, distance_matrix, nearest_neighbours
from factors.se2 import Array

Matched = tuple[Integers, Integers, Array]  # indices in the first and the second image, ratio of distances


@dataclass(frozen=True)
class Feature:
    """A feature under evaluation: ``find`` returns the points of an image, and their descriptors if it has any."""

    name: str
    find: Callable[[Image], tuple[Keypoints, Descriptors | None]]


@dataclass(frozen=True)
class MatchScores:
    """Matching scores of a pair of images; NaN for detectors without descriptors.

    ``matching_score``: correct mutual matches over the smaller number of features in the common part; ``matches``: mutual ones
    with a ratio below :data:`~factorgraph_loc.vision.matching.RATIO`, ``precision``: fraction of correct ones. Without matches
    the scores are 0.
    """

    matches: int = 0
    matching_score: float = np.nan
    precision: float = np.nan


@dataclass(frozen=True)
class PairScores:
    """The scores of one feature on the first image of a sequence and its image number ``image``.

    ``change`` and ``amount`` are those of the sequence; ``features`` were detected and described in ``milliseconds``.
    """

    feature: str
    sequence: str
    change: str
    image: int
    amount: float
    features: int
    milliseconds: float
    repeatability: Repeatability
    matching: MatchScores

    def row(self) -> dict[str, Any]:
        """The scores by name, as a row of a table."""
        content = asdict(self)
        scores = {**content.pop("repeatability"), **content.pop("matching")}
        return {**content, **scores}


def feature(name: str, count: int) -> Feature:
    """The feature or detector ``name``, with at most ``count`` points per image. Raises InputError if it is unknown."""
    if name not in EXTRACTORS and name not in DETECTORS:
        raise InputError(f"feature {quoted(name)} is not known{nearest(name, [*EXTRACTORS, *DETECTORS])}")
    if name in EXTRACTORS:
        return Feature(name, extractor(name, count).detectAndCompute)
    if count < 1:
        raise InputError(f"feature {name}: count is {count}, expected at least 1")
    return Feature(name, lambda image: (DETECTORS[name](image, count), None))


def evaluate(sequence: Sequence, what: Feature, progress: Callable[[], None] = lambda: None) -> Iterator[PairScores]:
    """Scores of a feature on each pair of a sequence. Each image is processed on one thread; ``progress`` is called after it."""
    with _one_thread():
        what.find(sequence.first)  # exclude compilation and allocation at first use from the time
        (keypoints, descriptors), _ = _timed(what, sequence.first)
        progress()
        for k, (image, homography) in enumerate(zip(sequence.others, sequence.homographies, strict=True)):
            (second, second_descriptors), milliseconds = _timed(what, image)
            shapes = (sequence.first.shape, image.shape)
            again = repeatability(keypoints, second, homography, shapes)
            matched = MatchScores()
            if descriptors is not None and second_descriptors is not None:
                matches = mutual_matches(descriptors, second_descriptors)
                matched = match_scores(keypoints, second, matches, homography, shapes)
            about = (what.name, sequence.name, sequence.change, k + 2, sequence.amounts[k])
            yield PairScores(*about, len(second), milliseconds, again, matched)
            progress()


def mutual_matches(first: Descriptors, second: Descriptors) -> Matched:
    """Mutual nearest neighbours of two sets of descriptors, bits (``uint8``) or vectors.

    Their indices (M,), (M,), and the ratio (M,) of the distances to the nearest and the second nearest of ``second``, 0 if there
    is no second, 1 for ties. For r up to 1, those with a ratio below r are the result of
    :func:`~factorgraph_loc.vision.matching.match` for r.
    """
    none = np.empty(0, dtype=np.int64)
    if len(first) == 0 or len(second) == 0:
        return none, none, np.empty(0)
    distances = distance_matrix(first, second, binary=first.dtype == np.uint8)
    forward = nearest_neighbours(distances)
    back = nearest_neighbours(distances.T)
    i = np.flatnonzero(back.index[forward.index] == np.arange(len(first)))
    j = forward.index[i]
    best, runner_up = forward.best[i], forward.second[i]
    return i, j, np.divide(best, runner_up, out=np.ones(len(i)), where=forward.is_unique[i] & back.is_unique[j])


def match_scores(
    first: Keypoints, second: Keypoints, matches: Matched, homography: Array, shapes: Shapes
) -> MatchScores:
    """The scores of matches; one is correct if both points lie in the common part of the images, and their regions overlap."""
    i, j, ratio = matches
    in_first, in_second = common(first, second, homography, shapes)
    right = in_first[i] & in_second[j] & (pair_errors(first[i], second[j], homography) < OVERLAP_ERROR)
    features = min(int(np.count_nonzero(in_first)), int(np.count_nonzero(in_second)))
    clear = right[ratio < RATIO]
    correct, clear_and_correct = int(np.count_nonzero(right)), int(np.count_nonzero(clear))
    return MatchScores(len(clear), correct / max(features, 1), clear_and_correct / max(len(clear), 1))


def _timed(what: Feature, image: Image) -> tuple[tuple[Keypoints, Descriptors | None], float]:
    """The features of an image, and the time [ms]."""
    started = time.perf_counter()
    result = what.find(image)
    return result, 1e3 * (time.perf_counter() - started)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Run OpenCV on one thread, for comparable times."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)
