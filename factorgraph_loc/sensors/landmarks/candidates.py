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

MOST = 1000  # stored sightings of a landmark
USED = 80  # largest number of sightings that a position is computed from, evenly spaced
DRIFT = 0.2  # rad; older sightings are not used if the standard deviation of the rotation since then exceeds this
APART = 0.1  # m; the last sighting is replaced by the next one if the robot had moved less than this before it
FEWEST, GROWTH = 8, 1.25  # number of sightings at the first attempt, and its factor from one attempt to the next
DIRECTIONS = 24  # number of initial positions on a circle around the robot
RADII = (1.0, 3.0, 10.0, 30.0)  # m; radii of the initial positions if there is no range
ITERATIONS, REFINEMENTS = 20, 8  # largest numbers of iterations, with independent and with correlated odometry errors
CONVERGED, LONGEST_STEP = 1e-3, 5.0  # m; iterations end if a step is shorter than CONVERGED; longest step
FLAT = 1e-4 * np.eye(2)  # information of the nearly flat prior [1/m^2]
NEAR, MOST_FUSED = 0.5, 8  # m; minimum distance between distinct positions; largest number of distinct positions
# the best position is unambiguous if the loss of each other position is larger by MARGIN, which is multiplied by the median squared
# residual over TYPICAL if that is above 1
MARGIN = 12.0
TYPICAL = 0.455  # median of the square of a standard normal residual
MISFIT = 2.0  # if the mean loss of a sighting is above this, the best position is rejected
ACCURATE, SHARE = 0.3, 0.15  # largest accepted standard deviation: m, or fraction of the distance if larger


class PartialSighting(NamedTuple):
    """A sighting with a range [m] or a bearing [rad]; the missing value is NaN. ``odometry``: the odometry state at its
    time."""

    odometry: ChainState
    range: float
    bearing: float


class LocatedPoint(NamedTuple):
    """An estimated position of a landmark.

    ``point`` (2,) [m] with ``covariance`` (2, 2): in the frame of the robot at the last sighting. ``loss``: the
    negative log-likelihood of the sightings at that point. ``squared``: the median of their squared residuals.
    """

    point: Array
    covariance: Array
    loss: float
    squared: float


@dataclass(frozen=True)
class Candidate:
    """The sightings of a landmark whose position is not known yet.

    Immutable, because filters go back to an earlier state when a measurement is late. ``sightings``: in order of time.
    ``sources``: for each sighting, an object that the caller makes a factor of, once the landmark is located.
    ``due``: the next attempt to locate the landmark is made after this number of sightings."""

    sightings: tuple[PartialSighting, ...] = ()
    sources: tuple[object, ...] = ()
    due: float = FEWEST

    def plus(self, sighting: PartialSighting, source: object) -> Candidate:
        """Return a candidate with a further sighting. It replaces the last one if the last two are closer than APART."""
        end = len(self.sightings)
        if end > 1:
            previous, last = (np.array(s.odometry[1:3]) for s in self.sightings[-2:])
            end -= int(np.hypot(*(last - previous)) < APART)
        kept = slice(max(0, end + 1 - MOST), end)
        return replace(self, sightings=(*self.sightings[kept], sighting), sources=(*self.sources[kept], source))

    @property
    def is_due(self) -> bool:
        """True if there are enough sightings for the next attempt to locate the landmark."""
        return len(self.sightings) >= self.due

    def tried(self) -> Candidate:
        """Return the candidate after a failed attempt. The next attempt requires more sightings."""
        return replace(self, due=min(GROWTH * len(self.sightings), MOST))

    def position(
        self, model: BearingRangeModel, motion: Motion, constants: Array, uncertainty: Array
    ) -> LocatedPoint | None:
        """Return the position that explains the sightings. Returns None if no position explains them, or if several do.

        ``model``: the model of the sensor. ``motion``: the odometry. ``constants`` (P,) with covariance ``uncertainty``
        (P, P): estimated calibration constants of the odometry.
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
    """K sightings of one landmark along a path that is known from odometry.

    All positions and poses are in the frame of the robot at the last sighting.
    """

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
        # matrices (K, 3, 3) from an error of the path to the error of the pose at a sighting
        self._carried = se2.adjoint(np.array(forth)[back])
        # covariance (K, K, 3, 3) of the path errors: the errors of two poses have the error since the later pose in common
        self._common = np.array(covariances)[np.minimum(back[:, None], back)]
        turns = np.array(by_constants)[back]
        self._common += np.einsum("iap,pq,jbq->ijab", turns, uncertainty, turns)

    def positions(self) -> list[LocatedPoint]:
        """Return possible positions of the landmark, sorted by loss: the distinct local optima, and a position that is
        refined from the mirror image of the best of them."""
        starts = self._starts()
        points = self._refined(starts)
        points = points[np.argsort(self._losses(points))]
        distinct = _distinct(points)[:MOST_FUSED]
        return sorted((self._fused(point) for point in (*distinct, self._mirrored(points[0]))), key=_loss)

    def _starts(self) -> Array:
        """Return initial positions (N, 2) on circles around the robot. Their radius is the last range, or RADII without
        ranges."""
        known = self._ranges[self._is_measured[:, 0]] / self._model.range_scale
        angles = np.arange(DIRECTIONS) * 2.0 * np.pi / DIRECTIONS
        circle = np.column_stack((np.cos(angles), np.sin(angles)))
        radii = known[:1] if len(known) else RADII
        return np.concatenate([radius * circle for radius in radii])

    def _mirrored(self, point: Array) -> Array:
        """Return the mirror image (2,) of a position at the line that is fitted to the path."""
        middle = self._back[:, :2].mean(axis=0)
        ahead = np.linalg.svd(self._back[:, :2] - middle)[2][0]
        away = point - middle
        return np.asarray(middle + 2.0 * (away @ ahead) * ahead - away)

    def _linearized(self, points: Array, path: Array | None = None) -> tuple[Array, Array]:
        """Return residuals (N, K, 2) at positions (N, 2), in standard deviations of the sensor, and their Jacobians (N,
        K, 2, 11). The columns are those of :func:`linearize_each`. ``path`` (K, 3): the poses at the sightings, by
        default from odometry."""
        count, size = self.count, len(points)
        sightings = np.repeat(points, count, axis=0), np.tile(self._ranges, size), np.tile(self._bearings, size)
        poses = np.tile(self._back if path is None else path, (size, 1))
        error, jacobian = linearize_each(self._model.packed, poses, *sightings)
        return error.reshape(size, count, 2), jacobian.reshape(size, count, 2, -1)

    def _widened(self, points: Array) -> tuple[Array, Array]:
        """Return residuals (N, K, 2) at positions (N, 2), and their Jacobians (N, K, 2, 2) by the position. Both are
        divided by the standard deviation that results from sensor noise and odometry error."""
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
        """Return positions (N, 2) refined by Levenberg-Marquardt. The odometry errors are treated as independent noise."""

        def at(points: Array, _: Integers) -> tuple[Array, Array, Array]:
            error, jacobian = self._widened(points)
            squared = np.sum(error**2, axis=-1)
            weighted = geman_mcclure_weight(squared, self._model.robust)[..., None, None] * jacobian
            gradient = np.einsum("nkia,nki->na", weighted, error)
            curvature = np.einsum("nkia,nkib->nab", weighted, jacobian) + FLAT
            return geman_mcclure_loss(squared, self._model.robust).sum(axis=1), gradient, curvature

        return minima(at, starts, ITERATIONS, CONVERGED, largest=LONGEST_STEP).states

    def _fused(self, point: Array) -> LocatedPoint:
        """Refine a position (2,) with the path as an unknown that is marginalised.

        Residuals e in standard deviations of the sensor have the covariance R = I + J C J'. C is the covariance of the
        path, and J is the Jacobian of e by the path. The most likely path has residuals R^-1 e, and differs from the
        odometry by -C J' R^-1 e. Residuals are linearised on that path.
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
    """Return the rows of ``points`` (N, 2) without those within NEAR of an earlier kept row."""
    kept: list[Array] = []
    for point in points:
        if all(np.hypot(*(point - earlier)) > NEAR for earlier in kept):
            kept.append(point)
    return kept
