"""Refinement of tag positions to the nearest local optimum, by Fisher scoring on the likelihood of all antenna observations."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factors.least_squares import minima
from factors.rfid.detection import RfidLikelihood, TagArray, TagReadCounts
from factors.rfid.model import RfidModel, probability
from factors.se2 import Array, Integers

LEAST = 0.05  # probability of a read that defines the reach of an antenna
ITERATIONS = 30
CONVERGED = 1e-3  # m
LARGEST_STEP = 0.5  # m
STEP = 0.02  # m, of the numerical curvature
CHUNK = 256  # candidates refined at once, to bound the memory


@dataclass(frozen=True, eq=False)
class TagCandidates:
    """C candidate positions (C, 2) of the tags ``tag`` (C,), with facings (C,)."""

    tag: Integers
    places: Array
    facing: Array

    def __getitem__(self, which: Integers | NDArray[np.bool_]) -> TagCandidates:
        return TagCandidates(self.tag[which], self.places[which], self.facing[which])


def of_tags(looks: TagReadCounts, tags: Integers) -> TagReadCounts:
    """The read counts of some ``tags`` (C,)."""
    return TagReadCounts(looks.offsets, looks.antennas, looks.rounds, np.ascontiguousarray(looks.hits[:, tags]))


def reach(model: RfidModel) -> float:
    """The distance [m] from the robot within which its antennas read."""
    out = 0.0
    bearings = np.linspace(-math.pi, math.pi, 24, endpoint=False)
    for antenna in model.antennas:
        detection = model.models[antenna.model]
        distances = np.arange(0.1, detection.reach, 0.1)
        r, b = np.meshgrid(distances, bearings, indexing="ij")
        points = np.stack((r * np.cos(b), r * np.sin(b), np.zeros_like(r)), axis=-1).reshape(-1, 3)
        p = np.maximum(*(probability(detection, points, c) for c in (0.0, 1.0))).reshape(r.shape).max(axis=1)
        read = np.flatnonzero(p > LEAST)
        out = max(out, math.hypot(antenna.x, antenna.y) + (float(distances[read[-1]]) if len(read) else 0.0))
    return out


def refine(
    model: RfidModel, looks: TagReadCounts, heights: Array, candidates: TagCandidates
) -> tuple[TagCandidates, Array, Array]:
    """TagCandidates at the nearest local optimum, with negative log-likelihood (C,) and covariance (C, 2, 2)."""
    places, nll = candidates.places.copy(), np.empty(len(candidates.tag))
    covariances = np.empty((len(nll), 2, 2))
    prior = np.eye(2) / reach(model) ** 2
    for first in range(0, len(nll), CHUNK):
        part = slice(first, first + CHUNK)
        tag, facing = candidates.tag[part], candidates.facing[part]
        mine = of_tags(looks, tag)
        places[part], nll[part], information = _refined(model, mine, heights[tag], facing, places[part])
        covariances[part] = np.linalg.inv(information + prior)
    return TagCandidates(candidates.tag, places, candidates.facing), nll, covariances


def _refined(
    model: RfidModel, looks: TagReadCounts, heights: Array, facing: Array, places: Array
) -> tuple[Array, Array, Array]:
    """Positions (C, 2) at the optimum, negative log-likelihood (C,) and information (C, 2, 2), of C tags at once, each with its own
    column of hits. The information is the observed curvature where it is positive definite, else the Fisher information."""

    def at(places: Array, which: Integers) -> tuple[Array, Array, Array]:
        tags = TagArray(np.column_stack((places, heights[which])), facing[which])
        return RfidLikelihood(model, tags).by_tag(np.zeros(3), of_tags(looks, which))

    found, every = minima(at, places, ITERATIONS, CONVERGED, largest=LARGEST_STEP), np.arange(len(places))
    states, information = found.states, found.curvatures
    columns = [(at(states + STEP * e, every)[1] - at(states - STEP * e, every)[1]) / (2.0 * STEP) for e in np.eye(2)]
    curvature = np.stack(columns, axis=2)
    curvature = (curvature + curvature.transpose(0, 2, 1)) / 2.0
    good = np.linalg.eigvalsh(curvature)[:, 0] > 0.1 * np.linalg.eigvalsh(information)[:, 0]
    return states, found.costs, np.where(good[:, None, None], curvature, information)
