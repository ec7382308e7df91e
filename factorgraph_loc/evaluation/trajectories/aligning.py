"""Alignment of an estimate with its reference.

Least squares in space: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", IEEE
Transactions on Pattern Analysis and Machine Intelligence, 1991, equations 38 to 43. In the plane:
:func:`~factorgraph_loc.evaluation.alignment.align_points`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.alignment import align_points
from factorgraph_loc.model.scoring import Alignment
from factorgraph_loc.model.trajectory3 import PosePath, upright
from factors.se2 import Array

FEWEST = 3  # pairs that define an alignment by least squares
_DEGENERATE = 1e-12  # of a spread, relative to the largest one


@dataclass(frozen=True)
class Similarity:
    """The map of points ``scale * rotation @ p + translation``: ``rotation`` (3, 3), ``translation`` (3,) [m]."""

    rotation: Array
    translation: Array
    scale: float = 1.0

    def of(self, path: PosePath) -> PosePath:
        """The path in the frame that the similarity maps to."""
        positions = self.scale * path.positions @ self.rotation.T + self.translation
        return replace(path, positions=positions, rotations=self.rotation @ path.rotations)


IDENTITY = Similarity(np.eye(3), np.zeros(3))


def alignment(estimate: PosePath, reference: PosePath, how: Alignment) -> Similarity:
    """The similarity that moves the ``estimate`` onto the ``reference``, poses of equal number N.

    ``none``: the identity. ``origin``: of the first pose onto the first. ``se2``, ``se3`` and ``sim3``: least squares of the
    positions, by a planar motion, a motion in space, and one with a scale. InputError if the poses do not determine it.
    """
    if how == "none":
        return IDENTITY
    if how == "origin":
        if without := next((path for path in (estimate, reference) if not path.has_rotations), None):
            raise InputError(
                f"{without.name}: has no headings, which --align origin needs: expected none, se2, se3 or sim3"
            )
        rotation = reference.rotations[0] @ estimate.rotations[0].T
        return Similarity(rotation, reference.positions[0] - rotation @ estimate.positions[0])
    if len(estimate) < FEWEST:
        raise InputError(
            f"{estimate.name}: {len(estimate)} poses are paired with {reference.name}, expected at least {FEWEST} for --align {how}"
        )
    if how == "se2":
        return _planar(estimate, reference)
    return _umeyama(estimate, reference, with_scale=how == "sim3")


def _planar(estimate: PosePath, reference: PosePath) -> Similarity:
    points, targets = estimate.positions[:, :2], reference.positions[:, :2]
    for path, places in ((estimate, points), (reference, targets)):
        if np.abs(places - places[0]).max() <= _DEGENERATE * max(1.0, float(np.abs(places).max())):
            raise InputError(
                f"{path.name}: all positions are one, which --align se2 cannot turn, expected a robot that moves"
            )
    x, y, angle = align_points(points, targets)
    return Similarity(upright(np.array([angle]))[0], np.array((x, y, 0.0)))


def _umeyama(estimate: PosePath, reference: PosePath, *, with_scale: bool) -> Similarity:
    centre, target = estimate.positions.mean(axis=0), reference.positions.mean(axis=0)
    a, b = estimate.positions - centre, reference.positions - target
    left, spread, right = np.linalg.svd(b.T @ a / len(a))
    for path, places in ((estimate, a), (reference, b)):
        of_path = np.linalg.svd(places, compute_uv=False)
        if not of_path[1] ** 2 > _DEGENERATE * of_path[0] ** 2:
            raise InputError(
                f"{path.name}: its positions lie on a line, which --align {'sim3' if with_scale else 'se3'} cannot turn, "
                "expected a path with a bend: use se2 or origin"
            )
    signs = np.array((1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))))
    rotation = (left * signs) @ right
    scale = float(spread @ signs / np.mean(np.sum(a**2, axis=1))) if with_scale else 1.0
    return Similarity(rotation, target - scale * rotation @ centre, scale)
