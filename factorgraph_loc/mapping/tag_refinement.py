"""Refinement of tag positions to the nearest local optimum, by Fisher scoring on the likelihood of all antenna observations."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factors.rfid.counts import TagReadCounts
from factors.rfid.detection import RfidLikelihood, TagArray
from factors.rfid.model import RfidModel, probability
from factors.se2 import Array

LEAST = 0.05  # probability of a read that defines the reach of an antenna
ITERATIONS = 30
CONVERGED = 1e-3  # m
MAX_DAMPING = 1e6
LARGEST_STEP = 0.5  # m
STEP = 0.02  # m, of the numerical curvature
CHUNK = 256  # candidates refined at once, to bound the memory


@dataclass(frozen=True, eq=False)
class TagCandidates:
    """C candidate positions (C, 2) of the tags ``tag`` (C,), with facings (C,)."""

    tag: NDArray[np.int64]
    places: Array
    facing: Array

    def __getitem__(self, which: NDArray[np.int64] | NDArray[np.bool_]) -> TagCandidates:
        return TagCandidates(self.tag[which], self.places[which], self.facing[which])


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
        mine = TagReadCounts(looks.offsets, looks.antennas, looks.rounds, np.ascontiguousarray(looks.hits[:, tag]))
        problem = _Refinement(model, mine, heights[tag], facing)
        places[part], nll[part], information = problem.solve(places[part])
        covariances[part] = np.linalg.inv(information + prior)
    return TagCandidates(candidates.tag, places, candidates.facing), nll, covariances


@dataclass(frozen=True, eq=False)
class _Refinement:
    """C positions at once, each with its own column of hits."""

    model: RfidModel
    looks: TagReadCounts
    heights: Array
    facing: Array

    def at(self, places: Array) -> tuple[Array, Array, Array]:
        tags = TagArray(np.column_stack((places, self.heights)), self.facing)
        return RfidLikelihood(self.model, tags).by_tag(np.zeros(3), self.looks)

    def solve(self, places: Array) -> tuple[Array, Array, Array]:
        """Positions (C, 2) at the optimum, negative log-likelihood (C,) and information (C, 2, 2): the observed curvature where
        it is positive definite, else the Fisher information.
        """
        nll, gradient, information = self.at(places)
        places, damping = places.copy(), np.full(len(places), 1e-3)
        moving = np.arange(len(places))
        for _ in range(ITERATIONS):
            scale = damping * (np.trace(information[moving], axis1=1, axis2=2) + 1e-6)
            damped = information[moving] + scale[:, None, None] * np.eye(2)
            step = -np.linalg.solve(damped, gradient[moving, :, None])[..., 0]
            step *= np.minimum(1.0, LARGEST_STEP / np.maximum(np.hypot(*step.T), 1e-12))[:, None]
            tried = self._only(moving).at(places[moving] + step)
            better = tried[0] <= nll[moving]
            taken = moving[better]
            places[taken] += step[better]
            nll[taken], gradient[taken], information[taken] = (part[better] for part in tried)
            damping = np.where(better, damping / 10.0, damping * 10.0)
            on = (np.hypot(*step.T) > CONVERGED) & (damping < MAX_DAMPING)
            moving, damping = moving[on], damping[on]
            if not len(moving):
                break
        return places, nll, self._curvature(places, information)

    def _only(self, which: NDArray[np.int64]) -> _Refinement:
        looks = self.looks
        hits = np.ascontiguousarray(looks.hits[:, which])
        mine = TagReadCounts(looks.offsets, looks.antennas, looks.rounds, hits)
        return _Refinement(self.model, mine, self.heights[which], self.facing[which])

    def _curvature(self, places: Array, information: Array) -> Array:
        columns = [(self.at(places + STEP * e)[1] - self.at(places - STEP * e)[1]) / (2.0 * STEP) for e in np.eye(2)]
        curvature = np.stack(columns, axis=2)
        curvature = (curvature + curvature.transpose(0, 2, 1)) / 2.0
        good = np.linalg.eigvalsh(curvature)[:, 0] > 0.1 * np.linalg.eigvalsh(information)[:, 0]
        return np.where(good[:, None, None], curvature, information)
