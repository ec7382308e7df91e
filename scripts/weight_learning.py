"""Learning of the weights of colour features from images of planar scenes with known homographies."""

from __future__ import annotations

import itertools
from collections.abc import Sequence as Several
from pathlib import Path

import numpy as np

from factorgraph_loc.evaluation.features.repeatability import alike_regions, common
from factorgraph_loc.evaluation.features.sequences import Sequence
from factorgraph_loc.files.models import replacing
from factorgraph_loc.vision.colour_features import ColourExtractor, Weights
from factorgraph_loc.vision.descriptor import OWN_SCALE, VALUES, values
from factorgraph_loc.vision.keypoints import Float
from factors.se2 import Array

COUNT = 1000  # points per image
SHARE = 0.04  # this fraction of the mean variance is added to each variance as a regularisation


def learn_weights(sequences: Several[Sequence]) -> Weights:
    """Learn weights from all pairs of images of each sequence. Used are the points that have equal position and scale in both
    images, according to the homography."""
    pairs = [pair for sequence in sequences for pair in matched_values(sequence)]
    return learn(np.vstack([first for first, _ in pairs]), np.vstack([second for _, second in pairs]))


def matched_values(sequence: Sequence) -> list[tuple[Float, Float]]:
    """Return for each pair of images of a sequence the values (N, 35) of N common points, in the first and in the second image."""
    features = ColourExtractor(COUNT)
    described = []
    for image in (sequence.first, *sequence.others):
        keypoints, found = features.record(image)
        described.append((keypoints, values(found), image.shape))
    to = [np.eye(3), *sequence.homographies]
    matched = []
    for i, j in itertools.combinations(range(len(to)), 2):
        (first, first_values, shape), (second, second_values, other_shape) = described[i], described[j]
        homography = to[j] @ np.linalg.inv(to[i])
        both = common(first, second, homography, (shape, other_shape))
        rows, columns = (np.flatnonzero(one) for one in both)
        same = alike_regions(first[rows], second[columns], homography)
        matched.append((first_values[rows[same.first]], second_values[columns[same.second]]))
    return matched


def learn(first: Float, second: Float) -> Weights:
    """Learn weights from the values (N, 35) of N points in a first image, and the values (N, 35) of the same points in a second
    image."""
    used = np.delete(np.arange(VALUES), OWN_SCALE)
    half = (first[:, used].astype(float) - second[:, used]) / np.sqrt(2.0)
    within = half.T @ half / len(half)
    within += SHARE * np.trace(within) / len(within) * np.eye(len(within))
    variances, directions = np.linalg.eigh(within)
    whitening: Array = np.zeros((VALUES, VALUES))
    whitening[np.ix_(used, used)] = (directions / np.sqrt(variances)) @ directions.T
    return Weights(np.vstack([first, second]).mean(axis=0).astype(np.float32), whitening.astype(np.float32))


def save(weights: Weights, path: Path) -> None:
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, mean=weights.mean, map=weights.map)
