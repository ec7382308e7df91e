"""Learns the weights of the 35 values from images of flat scenes with known homographies."""

from __future__ import annotations

import itertools
from collections.abc import Sequence as Several

import numpy as np

from factorgraph_loc.evaluation.features.repeatability import OVERLAP_ERROR, SCALE_RATIO, common, overlaps
from factorgraph_loc.evaluation.features.sequences import Sequence
from factorgraph_loc.vision.colour import Float
from factorgraph_loc.vision.colour_features import ColourExtractor
from factorgraph_loc.vision.descriptor import values
from factorgraph_loc.vision.weights import Weights, learn

COUNT = 1000  # points of an image


def learn_weights(sequences: Several[Sequence]) -> Weights:
    """Weights from all pairs of images of each sequence: from points that lie, by the homographies, at the same place
    and scale."""
    pairs = [pair for sequence in sequences for pair in matched_values(sequence)]
    return learn(np.vstack([first for first, _ in pairs]), np.vstack([second for _, second in pairs]))


def matched_values(sequence: Sequence) -> list[tuple[Float, Float]]:
    """Of each pair of images the values (N, 35) of the N points that both show."""
    features = ColourExtractor(COUNT)
    described = []
    for image in (sequence.first, *sequence.others):
        keypoints, found = features.record(image, features.detect(image))
        described.append((keypoints, values(found), image.shape))
    to = [np.eye(3), *sequence.homographies]
    matched = []
    for i, j in itertools.combinations(range(len(to)), 2):
        (first, first_values, shape), (second, second_values, other_shape) = described[i], described[j]
        homography = to[j] @ np.linalg.inv(to[i])
        both = common(first, second, homography, (shape, other_shape))
        rows, columns = (np.flatnonzero(one) for one in both)
        pairs = overlaps(first[rows], second[columns], homography, magnified=False)
        alike = np.maximum(pairs.ratio, 1.0 / pairs.ratio) < SCALE_RATIO
        same = pairs.best((pairs.error < OVERLAP_ERROR) & alike)
        matched.append((first_values[rows[same.first]], second_values[columns[same.second]]))
    return matched
