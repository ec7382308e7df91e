"""Descriptions of the whole keyframes of a map, to compare an image only with the few most similar ones.

A keyframe is described by the differences between its descriptors and the words of a small vocabulary (VLAD: Jegou, Douze, Schmid,
Perez, CVPR 2010). Each word is normalised separately (Arandjelovic, Zisserman, CVPR 2013).
"""

from __future__ import annotations

import warnings

import numpy as np
from scipy.cluster.vq import kmeans2, vq

from factorgraph_loc.vision.keypoints import Descriptors, Integers
from factors.se2 import Array

WORDS = 64  # of the vocabulary
SAMPLE, ROUNDS = 4000, 6  # descriptors that it is learnt from, and rounds of Lloyd's algorithm
NEAREST = 20  # keyframes that an image is compared with


class KeyframeLooks:
    """Keyframes that saw ``descriptors`` (M, D) from the positions ``seen_from`` (M, 3), one for each position."""

    def __init__(self, descriptors: Descriptors, seen_from: Array) -> None:
        _, self._of = np.unique(seen_from, axis=0, return_inverse=True)
        self._of = self._of.ravel()
        values = _values(descriptors)
        sample = values[np.linspace(0, len(values) - 1, min(SAMPLE, len(values))).astype(np.int64)]
        begin = sample[np.linspace(0, len(sample) - 1, min(WORDS, len(sample))).astype(np.int64)]
        with warnings.catch_warnings(action="ignore"):  # of words that nothing is nearest to, which stay where they are
            self._words, _ = kmeans2(sample, begin, ROUNDS, minit="matrix")
        self._looks = self._described(values, self._of)

    def __len__(self) -> int:
        return len(self._looks)

    def views(self, descriptors: Descriptors) -> Integers:
        """The rows of the map's descriptors that the keyframes see that are most like an image with ``descriptors`` (N, D)."""
        (description,) = self._described(_values(descriptors), np.zeros(len(descriptors), dtype=np.int64))
        alike = np.zeros(len(self), dtype=bool)
        alike[np.argsort(-(self._looks @ description), kind="stable")[:NEAREST]] = True
        return np.flatnonzero(alike[self._of])

    def _described(self, values: Array, of: Integers) -> Array:
        """The descriptions (K, WORDS * D) of K images, from the values (M, D) in image ``of`` (M,)."""
        (nearest, _), count = vq(values, self._words), len(self._words)
        descriptions = np.zeros((int(of.max()) + 1, count, values.shape[1]))
        np.add.at(descriptions, (of, nearest), values - self._words[nearest])
        descriptions /= np.maximum(np.linalg.norm(descriptions, axis=2), 1e-9)[..., None]
        flat = descriptions.reshape(len(descriptions), -1)
        return np.asarray(flat / np.maximum(np.linalg.norm(flat, axis=1), 1e-9)[:, None])


def _values(descriptors: Descriptors) -> Array:
    """Descriptors as real numbers, with a number for each bit of binary ones."""
    if descriptors.dtype == np.uint8:
        descriptors = np.unpackbits(descriptors, axis=1)
    return np.asarray(descriptors, dtype=float)
