"""Positions of landmarks that are sighted by range alone or by bearing alone.

No single sighting determines such a position. The sightings of a stretch of path do, up to ambiguities: after a straight path the
mirror image explains ranges equally well. Candidate positions start around the robot. They are refined with the error of the path
added to the noise, then with that error as an unknown, which is marginalised. A position is accepted once no other one explains
the sightings nearly as well. Several hypotheses for one range-only landmark: Blanco, Fernandez-Madrigal, Gonzalez, "Efficient
probabilistic range-only SLAM", IROS 2008.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from factorgraph_loc.sensors.motion import Motion
from factors import positive, se2
from factors.landmarks.kernels import linearize_each
from factors.landmarks.model import CONSTANTS, POINT, BearingRangeModel
from factors.least_squares import minima
from factors.motion import ChainState, propagate
from factors.robust import geman_mcclure_loss, geman_mcclure_weight
from factors.se2 import Array, Integers

MOST = 1000  # sightings of a landmark that wait
USED = 80  # largest number that a position is computed from, evenly spaced
DRIFT = 0.2  # rad; standard deviation of the rotation since the oldest of them
APART = 0.1  # m; a sighting from nearer to the one before it gives way to the next one
FEWEST, GROWTH = 8, 1.25  # number of sightings at the first attempt, and growth of that number until the next one
DIRECTIONS = 24  # start positions around the robot
RADII = (1.0, 3.0, 10.0, 30.0)  # m, if there is no range
ITERATIONS, REFINEMENTS = 20, 8
CONVERGED, LONGEST_STEP = 1e-3, 5.0  # m
FLAT = 1e-4 * np.eye(2)  # information of the flat prior [1/m^2]
NEAR, MOST_FUSED = 0.5, 8  # m; distance of different positions, and largest number of these
MARGIN = 12.0  # least excess loss of every other position; more if the median of squared residuals is above TYPICAL
TYPICAL = 0.455  # median of a squared residual
MISFIT = 2.0  # loss per sighting above which no position explains them
ACCURATE, SHARE = 0.3, 0.15  # standard deviation of an accurate position: m, or share of its distance


class PartialSighting(NamedTuple):
    """A range or a bearing, NaN if not measured, at ``odometry``."""

    odometry: ChainState
    range: float
    bearing: float


class LocatedPoint(NamedTuple):
    """A position (2,) in the frame of the robot, its covariance (2, 2), the loss of the sightings there, and the median of their
    squared residuals."""

    point: Array
    covariance: Array
    loss: float
    squared: float


@dataclass(frozen=True)
class Candidate:
    """Waiting sightings of one landmark, in order of time, and the number of them at the next attempt to locate it.

    Immutable, because filters go back to an earlier state when a measurement is late. ``sources``: of each sighting, what becomes a
    factor once the landmark is located."""

    sightings: tuple[PartialSighting, ...] = ()
    sources: tuple[object, ...] = ()
    due: float = FEWEST

    def plus(self, sighting: PartialSighting, source: object) -> Candidate:
        """The candidate with one more sighting."""
        end = len(self.sightings)
        if end > 1:
            previous, last = (np.array(s.odometry[1:3]) for s in self.sightings[-2:])
            end -= int(np.hypot(*(last - previous)) < APART)
        kept = slice(max(0, end + 1 - MOST), end)
        return replace(self, sightings=(*self.sightings[kept], sighting), sources=(*self.sources[kept], source))

    @property
    def is_due(self) -> bool:
        """Whether the next attempt is due."""
        return len(self.sightings) >= self.due

    def tried(self) -> Candidate:
        """The candidate after an attempt."""
        return replace(self, due=min(GROWTH * len(self.sightings), MOST))

    def position(
        self, model: BearingRangeModel, motion: Motion, constants: Array, uncertainty: Array
    ) -> LocatedPoint | None:
        """The only position that explains the sightings, in the frame of the robot at the last one; None if there is none, or if
        there are several. ``constants`` (P,) of the odometry with covariance ``uncertainty`` (P, P)."""
        stretch = _Stretch(model, self.sightings, motion, constants, uncertainty)
        if stretch.count < FEWEST:
            return None
        best, *alternatives = stretch.positions()
        allowed = best.loss + MARGIN * max(1.0, best.squared / TYPICAL)
        accuracy = max(ACCURATE, SHARE * float(np.hypot(*best.point)))
        if any(p.loss < allowed and np.hypot(*(p.point - best.point)) > accuracy for p in alternatives):
            return None
        explains = best.loss < MISFIT * stretch.count
        return best if explains and positive.worst_sigma(best.covariance) <= accuracy else None


class _Stretch:
    """K sightings of one landmark along a path, which is known from odometry. All positions are in the frame of the robot at the
    last sighting."""

    def __init__(
        self,
        model: BearingRangeModel,
        rows: Sequence[PartialSighting],
        motion: Motion,
        constants: Array,
        uncertainty: Array,
    ) -> None:
        forth, covariances, by_constants = [np.zeros(3)], [np.zeros((3, 3))], [np.zeros((3, len(constants)))]
        for start, end in zip(rows[-2::-1], rows[:0:-1], strict=True):
            step, rest = motion.relative(start.odometry, end.odometry), forth[-1]
            delta, change = motion.changed(step, constants)
            by_constants.append(by_constants[-1] + se2.adjoint(se2.inverse(rest)) @ change)
            covariances.append(propagate(step.covariance, replace(step, delta=rest, covariance=covariances[-1])))
            forth.append(se2.compose(se2.exp(delta), rest))
            turned = by_constants[-1][2]
            if covariances[-1][2, 2] + turned @ uncertainty @ turned > DRIFT**2:
                break
        back = np.unique(np.linspace(0, len(forth) - 1, USED).astype(int))  # newest first
        self.count = len(back)
        used = [rows[-1 - i] for i in back.tolist()]
        self._model = model
        self._ranges, self._bearings = np.array([row.range for row in used]), np.array([row.bearing for row in used])
        self._is_measured = ~np.isnan(np.column_stack((self._ranges, self._bearings)))
        self._back = se2.inverse(np.array(forth)[back])  # poses at the sightings
        self._carried = se2.adjoint(
            np.array(forth)[back]
        )  # from an error of the path to one of the pose at the sighting
        # errors of two poses have those of the path since the later one in common
        self._common = np.array(covariances)[np.minimum(back[:, None], back)]
        turns = np.array(by_constants)[back]
        self._common += np.einsum("iap,pq,jbq->ijab", turns, uncertainty, turns)

    def positions(self) -> list[LocatedPoint]:
        """The distinct positions that explain the sightings best, best first."""
        starts = self._starts()
        points = self._refined(starts)
        points = points[np.argsort(self._losses(points))]
        distinct = _distinct(points)[:MOST_FUSED]
        return sorted((self._fused(point) for point in (*distinct, self._mirrored(points[0]))), key=_loss)

    def _starts(self) -> Array:
        """Positions (N, 2) around the robot, at the last range if there is one."""
        known = self._ranges[self._is_measured[:, 0]] / self._model.range_scale
        angles = np.arange(DIRECTIONS) * 2.0 * np.pi / DIRECTIONS
        circle = np.column_stack((np.cos(angles), np.sin(angles)))
        radii = known[:1] if len(known) else RADII
        return np.concatenate([radius * circle for radius in radii])

    def _mirrored(self, point: Array) -> Array:
        """The mirror image (2,) of a position at the line that is nearest to the path."""
        middle = self._back[:, :2].mean(axis=0)
        ahead = np.linalg.svd(self._back[:, :2] - middle)[2][0]
        away = point - middle
        return np.asarray(middle + 2.0 * (away @ ahead) * ahead - away)

    def _linearized(self, points: Array, path: Array | None = None) -> tuple[Array, Array]:
        """Whitened residuals (N, K, 2) of positions (N, 2), and their Jacobians (N, K, 2, WIDTH). ``path`` (K, 3): poses at the
        sightings, by default those of the odometry."""
        count, size = self.count, len(points)
        sightings = np.repeat(points, count, axis=0), np.tile(self._ranges, size), np.tile(self._bearings, size)
        poses = np.tile(self._back if path is None else path, (size, 1))
        error, jacobian = linearize_each(self._model.packed, poses, *sightings)
        return error.reshape(size, count, 2), jacobian.reshape(size, count, 2, -1)

    def _widened(self, points: Array) -> tuple[Array, Array]:
        """Residuals (N, K, 2) and Jacobians (N, K, 2, 2) by the position, in standard deviations of sensor and path."""
        error, jacobian = self._linearized(points)
        by_path = jacobian[..., :POINT] @ self._carried
        numbers = np.arange(self.count)
        variance = 1.0 + np.einsum("nkia,kab,nkib->nki", by_path, self._common[numbers, numbers], by_path)
        root = np.sqrt(variance)
        return error / root, jacobian[..., POINT:CONSTANTS] / root[..., None]

    def _losses(self, points: Array) -> Array:
        squared = np.sum(self._widened(points)[0] ** 2, axis=-1)
        return np.asarray(geman_mcclure_loss(squared, self._model.robust).sum(axis=1))

    def _refined(self, starts: Array) -> Array:
        """Positions (N, 2) after Levenberg-Marquardt, with the errors of the path as independent noise."""

        def at(points: Array, _: Integers) -> tuple[Array, Array, Array]:
            error, jacobian = self._widened(points)
            squared = np.sum(error**2, axis=-1)
            weighted = geman_mcclure_weight(squared, self._model.robust)[..., None, None] * jacobian
            gradient = np.einsum("nkia,nki->na", weighted, error)
            curvature = np.einsum("nkia,nkib->nab", weighted, jacobian) + FLAT
            return geman_mcclure_loss(squared, self._model.robust).sum(axis=1), gradient, curvature

        return minima(at, starts, ITERATIONS, CONVERGED, largest=LONGEST_STEP).states

    def _fused(self, point: Array) -> LocatedPoint:
        """A position with the path marginalised. Whitened residuals e have the covariance R = 1 + J C J'. C is the covariance of
        the path, and J is the Jacobian by it. On the most likely path the residuals are R^-1 e, and the path has changed by
        -C J' R^-1 e. Residuals are linearised there."""
        measured, weight, change = self._is_measured, np.ones(self.count), np.zeros((self.count, 3))
        row_of = np.nonzero(measured)[0]
        common, robust = self._common[row_of[:, None], row_of], self._model.robust
        for _ in range(REFINEMENTS):
            path = se2.compose(self._back, se2.exp((self._carried @ change[..., None])[..., 0]))
            error, jacobian = (part[0] for part in self._linearized(point[None], path))
            root = np.sqrt(np.maximum(weight, 1e-6))[row_of]
            by_path = root[:, None] * (jacobian[..., :POINT] @ self._carried)[measured]
            by_point = root[:, None] * jacobian[..., POINT:CONSTANTS][measured]
            drift = np.einsum("ia,ijab,jb->ij", by_path, common, by_path, optimize=True)
            whitened = root * error[measured] - np.einsum("ia,ia->i", by_path, change[row_of])
            solved = np.linalg.solve(np.eye(len(row_of)) + drift, np.column_stack((by_point, whitened)))
            covariance = np.linalg.inv(by_point.T @ solved[:, :2] + FLAT)
            step = -covariance @ (by_point.T @ solved[:, 2])
            step *= min(1.0, LONGEST_STEP / max(float(np.hypot(*step)), 1e-9))
            point = point + step
            on_path = solved[:, 2] + solved[:, :2] @ step
            change = -np.einsum("ijab,jb,j->ia", self._common[:, row_of], by_path, on_path, optimize=True)
            squared = np.asarray(np.bincount(row_of, (on_path / root) ** 2, self.count), dtype=float)
            weight = geman_mcclure_weight(squared, robust)
            if np.hypot(*step) < CONVERGED:
                break
        loss = float(geman_mcclure_loss(squared, robust).sum() + 0.5 * on_path @ drift @ on_path)
        return LocatedPoint(point, covariance, loss, float(np.median(squared)))


def _loss(position: LocatedPoint) -> float:
    return position.loss


def _distinct(points: Array) -> list[Array]:
    """Those of positions (N, 2) that are not near an earlier one."""
    kept: list[Array] = []
    for point in points:
        if all(np.hypot(*(point - earlier)) > NEAR for earlier in kept):
            kept.append(point)
    return kept
