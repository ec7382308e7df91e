"""Estimates the position of a new landmark whose sightings have a range alone or a bearing alone.

No single sighting determines such a position. The sightings along a driven path do, up to ambiguities: after a straight
path the mirror image explains ranges equally well. Candidate positions start around the robot. They are first refined
with the odometry error as additional noise, then with the odometry error as an unknown that is marginalised. A position
is accepted when no other position explains the sightings nearly as well. Source of several hypotheses for one
range-only landmark: Blanco, Fernandez-Madrigal, Gonzalez, "Efficient probabilistic range-only SLAM", IROS 2008.
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

MOST = 1000  # maximum number of stored sightings of a landmark
USED = 80  # maximum number of sightings for the computation of a position, evenly selected
DRIFT = 0.2  # rad; sightings are too old if the standard deviation of the rotation since then exceeds this
APART = 0.1  # m; minimum motion of the robot between stored sightings
FEWEST, GROWTH = 8, 1.25  # number of sightings for the first attempt; growth of this number after each attempt
DIRECTIONS = 24  # number of initial positions on a circle around the robot
RADII = (1.0, 3.0, 10.0, 30.0)  # m; radii of the initial positions if there is no range
ITERATIONS, REFINEMENTS = 20, 8  # maximum number of iterations with independent, and with correlated odometry errors
CONVERGED, LONGEST_STEP = 1e-3, 5.0  # m; a step below CONVERGED is the last one; longer steps are shortened
FLAT = 1e-4 * np.eye(2)  # information of the nearly flat prior [1/m^2]
NEAR, MOST_FUSED = 0.5, 8  # minimum distance [m] and maximum number of positions to refine with correlated errors
# minimum difference of the losses of the best and the next position (more if residuals are larger than predicted)
MARGIN = 12.0
TYPICAL = 0.455  # median of the square of a standard normal variable
MISFIT = 2.0  # the best position is rejected if the mean loss per sighting exceeds this
ACCURATE, SHARE = 0.3, 0.15  # maximum standard deviation: the larger of ACCURATE [m] and SHARE times the distance


class PartialSighting(NamedTuple):
    """A sighting of a landmark with either ``range`` [m] or ``bearing`` [rad]. The other value is NaN. ``odometry``:
    the odometry state at the time of the sighting."""

    odometry: ChainState
    range: float
    bearing: float


class LocatedPoint(NamedTuple):
    """An estimated position of a landmark.

    ``point`` (2,) [m] with ``covariance`` (2, 2): the position in the robot frame at the last sighting. ``loss``: the
    negative log-likelihood of the sightings. ``squared``: the median of the squared residuals of the sightings.
    """

    point: Array
    covariance: Array
    loss: float
    squared: float


@dataclass(frozen=True)
class Candidate:
    """The sightings of one landmark with an unknown position. Immutable.

    ``sightings``: the sightings in order of time. ``sources``: the object that the caller passed with each sighting.
    ``due``: the number of sightings that the next attempt to locate the landmark requires.
    """

    sightings: tuple[PartialSighting, ...] = ()
    sources: tuple[object, ...] = ()
    due: float = FEWEST

    def plus(self, sighting: PartialSighting, source: object) -> Candidate:
        """Return a copy with the additional ``sighting``. ``source``: any object, stored with the sighting. The last
        stored sighting is replaced if the robot had moved less than APART [m] between the last two stored ones."""
        end = len(self.sightings)
        if end > 1:
            previous, last = (np.array(s.odometry[1:3]) for s in self.sightings[-2:])
            end -= int(np.hypot(*(last - previous)) < APART)
        kept = slice(max(0, end + 1 - MOST), end)
        return replace(self, sightings=(*self.sightings[kept], sighting), sources=(*self.sources[kept], source))

    @property
    def is_due(self) -> bool:
        """True if the number of sightings is sufficient for an attempt to locate the landmark."""
        return len(self.sightings) >= self.due

    def tried(self) -> Candidate:
        """Return a copy that requires more sightings for the next attempt to locate the landmark."""
        return replace(self, due=min(GROWTH * len(self.sightings), MOST))

    def position(
        self, model: BearingRangeModel, motion: Motion, constants: Array, uncertainty: Array
    ) -> LocatedPoint | None:
        """Return the estimated position of the landmark, or None if no position or several positions fit the sightings.

        ``model``: the model of the sensor. ``motion``: the odometry. ``constants`` (P,) with covariance ``uncertainty``
        (P, P): estimated calibration constants of the odometry, P = 0 if none is estimated.
        """
        path = _PathSightings(model, self.sightings, motion, constants, uncertainty)
        if path.count < FEWEST:
            return None
        best, *alternatives = path.positions()
        allowed = best.loss + MARGIN * max(1.0, best.squared / TYPICAL)
        accuracy = max(ACCURATE, SHARE * float(np.hypot(*best.point)))
        if any(p.loss < allowed and np.hypot(*(p.point - best.point)) > accuracy for p in alternatives):
            return None
        explains = best.loss < MISFIT * path.count
        return best if explains and positive.worst_sigma(best.covariance) <= accuracy else None


class _PathSightings:
    """Locates one landmark from K sightings along a path, which the odometry measures. All positions and poses are in
    the robot frame at the last sighting."""

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
        back = np.unique(np.linspace(0, len(forth) - 1, USED).astype(int))  # used sightings, newest first
        self.count = len(back)
        used = [rows[-1 - i] for i in back.tolist()]
        self._model = model
        self._ranges, self._bearings = np.array([row.range for row in used]), np.array([row.bearing for row in used])
        self._is_measured = ~np.isnan(np.column_stack((self._ranges, self._bearings)))
        self._back = se2.inverse(np.array(forth)[back])  # poses of the robot at the sightings
        # matrices (K, 3, 3) from an error of the motion since a sighting to an error of the pose at the sighting
        self._carried = se2.adjoint(np.array(forth)[back])
        # covariance (K, K, 3, 3) of the motion errors: those of two sightings share the error since the later sighting
        self._common = np.array(covariances)[np.minimum(back[:, None], back)]
        turns = np.array(by_constants)[back]
        self._common += np.einsum("iap,pq,jbq->ijab", turns, uncertainty, turns)

    def positions(self) -> list[LocatedPoint]:
        """Return possible positions of the landmark, sorted by loss. They are the local optima, and the optimum that is
        reached from the mirror image of the best one at the path."""
        starts = self._starts()
        points = self._refined(starts)
        points = points[np.argsort(self._losses(points))]
        distinct = _distinct(points)[:MOST_FUSED]
        return sorted((self._fused(point) for point in (*distinct, self._mirrored(points[0]))), key=_loss)

    def _starts(self) -> Array:
        """Return initial positions (N, 2) on a circle around the robot. The radius is the last range. Without ranges,
        the positions are on circles with the radii RADII."""
        known = self._ranges[self._is_measured[:, 0]] / self._model.range_scale
        angles = np.arange(DIRECTIONS) * 2.0 * np.pi / DIRECTIONS
        circle = np.column_stack((np.cos(angles), np.sin(angles)))
        radii = known[:1] if len(known) else RADII
        return np.concatenate([radius * circle for radius in radii])

    def _mirrored(self, point: Array) -> Array:
        """Return the mirror image (2,) of the position ``point`` (2,) at the straight line that fits the path best."""
        middle = self._back[:, :2].mean(axis=0)
        ahead = np.linalg.svd(self._back[:, :2] - middle)[2][0]
        away = point - middle
        return np.asarray(middle + 2.0 * (away @ ahead) * ahead - away)

    def _linearized(self, points: Array, path: Array | None = None) -> tuple[Array, Array]:
        """Return residuals (N, K, 2) of range and bearing, whitened by the sensor noise, and their Jacobians (N, K, 2,
        11). The first columns of a Jacobian are by the pose (3), the next by the position of the landmark. ``points``
        (N, 2): positions of the landmark. ``path`` (K, 3): the robot's poses at the sightings, by default from
        odometry."""
        count, size = self.count, len(points)
        sightings = np.repeat(points, count, axis=0), np.tile(self._ranges, size), np.tile(self._bearings, size)
        poses = np.tile(self._back if path is None else path, (size, 1))
        error, jacobian = linearize_each(self._model.packed, poses, *sightings)
        return error.reshape(size, count, 2), jacobian.reshape(size, count, 2, -1)

    def _widened(self, points: Array) -> tuple[Array, Array]:
        """Return residuals (N, K, 2) at landmark positions ``points`` (N, 2), and their Jacobians (N, K, 2, 2) by the
        position. Both are divided by the standard deviation of sensor noise and odometry error."""
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
        """Return local optima (N, 2) of the landmark position, by Levenberg-Marquardt from ``starts`` (N, 2). The
        odometry errors of different sightings are treated as independent."""

        def at(points: Array, _: Integers) -> tuple[Array, Array, Array]:
            error, jacobian = self._widened(points)
            squared = np.sum(error**2, axis=-1)
            weighted = geman_mcclure_weight(squared, self._model.robust)[..., None, None] * jacobian
            gradient = np.einsum("nkia,nki->na", weighted, error)
            curvature = np.einsum("nkia,nkib->nab", weighted, jacobian) + FLAT
            return geman_mcclure_loss(squared, self._model.robust).sum(axis=1), gradient, curvature

        return minima(at, starts, ITERATIONS, CONVERGED, largest=LONGEST_STEP).states

    def _fused(self, point: Array) -> LocatedPoint:
        """Return a position refined from ``point`` (2,) with correlated odometry errors. The path is marginalised.

        Let e be the residuals, whitened by the sensor noise, J their Jacobian by the path, and C the covariance of the
        path. The covariance of e is R = I + J C J'. The most likely path differs from the odometry by -C J' R^-1 e. The
        residuals are linearised on that path.
        """
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
    """Return the rows of ``points`` (N, 2) that are more than NEAR [m] away from all previously returned rows."""
    kept: list[Array] = []
    for point in points:
        if all(np.hypot(*(point - earlier)) > NEAR for earlier in kept):
            kept.append(point)
    return kept
