"""How much each of the 35 values of a colour feature counts: a linear map, learnt where the same points are seen twice.

The map takes the values to a space where those of one point, seen in two images, differ by as much in all directions:
Euclidean distance there is Mahalanobis distance of the values (within-class whitening, Fukunaga, "Introduction to
Statistical Pattern Recognition", 1990, section 10.2). ``scripts/learn_feature_weights`` makes the file that is
shipped."""

from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path

import numpy as np

from factorgraph_loc.files.models import replacing
from factorgraph_loc.vision.colour import Float
from factorgraph_loc.vision.descriptor import VALUES
from factors.se2 import Array

SHARE = 0.04  # of the mean variance, that is added to all: what few pairs say of a direction is not certain
OWN_SCALE = 20  # which of the values is the point's own scale: it has no weight, as a zoom changes it


@dataclass(frozen=True, eq=False)
class Weights:
    """``mean`` (35,) of the values, and their ``map`` (35, 35)."""

    mean: Float
    map: Float

    def __call__(self, values: Float) -> Float:
        """Descriptors (N, 35), of length one, of ``values`` (N, 35)."""
        mapped = (values - self.mean) @ self.map
        length = np.linalg.norm(mapped, axis=1, keepdims=True)
        return np.asarray(mapped / np.maximum(length, np.finfo(np.float32).tiny), dtype=np.float32)


def learn(first: Float, second: Float) -> Weights:
    """Weights from the values (N, 35) of N points in one image and (N, 35) of the same points in another."""
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


@cache
def shipped() -> Weights:
    """The weights that come with the package, learnt on the sequences bark and graf of Mikolajczyk et al., IJCV 65,
    2005."""
    with (
        resources.files("factorgraph_loc.vision").joinpath("weights.npz").open("rb") as file,
        np.load(file, allow_pickle=False) as stored,
    ):
        return Weights(stored["mean"], stored["map"])
