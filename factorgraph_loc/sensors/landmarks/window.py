"""Scores and refines candidates of the present pose by recent sightings of landmarks, vectorised over the candidates.

The odometry relates each sighting to the present pose, the pose at the last sighting.
"""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np

from factorgraph_loc.sensors.known_position import KnownPosition
from factorgraph_loc.sensors.motion import Motion
from factors import positive, se2
from factors.landmarks.kernels import linearize_each
from factors.landmarks.model import POINT, BearingRangeModel, located, residuals, sigmas
from factors.least_squares import minima
from factors.motion import ChainState
from factors.robust import geman_mcclure_loss, geman_mcclure_weight
from factors.se2 import Array, Integers

RECENT = 6  # maximum number of landmarks that give candidates
CIRCLE = 72  # number of candidate headings for the sighting of one landmark
HEADINGS = 24  # number of candidate bearings if the bearing is not measured
RADII = (0.7, 1.5, 3.0, 6.0)  # m; candidate ranges if the range is not measured
BASELINE = 0.3  # m; minimum distance of two landmarks that give a heading
CONVERGED = 1e-4  # m, rad; the refinement of a candidate ends if a step is smaller
FLAT = np.diag((1e-4, 1e-4, 1e-1))  # information of the nearly flat prior: 1/m^2, 1/m^2, 1/rad^2


class Sighting(NamedTuple):
    """One sighting of a mapped landmark.

    ``odometry``: the odometry state at the time of the sighting. ``point`` (2,): the position [m] of the landmark in
    the map. ``range`` [m], ``bearing`` [rad]: the measurement, NaN if not measured.
    """

    odometry: ChainState
    point: Array
    range: float
    bearing: float


class SightingWindow:
    """The likelihood of the robot's pose at the last of K sightings, and candidates for this pose.

    ``rows``: the sightings in order of time. ``start``: the start of the run if its position is known, otherwise None.
    ``now``: the odometry state at the last sighting. ``points`` (K, 2): positions of the landmarks in the map.
    """

    def __init__(
        self, model: BearingRangeModel, rows: list[Sighting], motion: Motion, start: KnownPosition | None = None
    ) -> None:
        self._model, self._motion, self._start = model, motion, start
        self.now = rows[-1].odometry
        self.points = np.array([r.point for r in rows])
        self._ranges, self._bearings = np.array([r.range for r in rows]), np.array([r.bearing for r in rows])
        since = [motion.relative(r.odometry, self.now) for r in rows]
        self._forth = np.array([i.delta for i in since])
        self._back = se2.inverse(self._forth)  # poses at the sightings, relative to the present pose
        # matrices (K, 3, 3) from perturbations of the present pose to perturbations of the poses at the sightings
        self._carried = se2.adjoint(self._forth)
        self._covariance = np.array([i.covariance for i in since])
        self._drift = self._carried @ self._covariance @ self._carried.transpose(0, 2, 1)
        self._missing = np.isnan(np.column_stack((self._ranges, self._bearings)))
        self._sigmas = sigmas(model, self._ranges)

    def starts(self) -> Array:
        """Return candidates (N, 3) of the pose at the last sighting, from the start position and the odometry. Returns
        (0, 3) if the start is unknown."""
        return np.empty((0, 3)) if self._start is None else self._start.candidates(self.now)

    def circles(self) -> Array:
        """Return candidates (N, 3) of the pose at the last sighting, on circles around the landmark of the last
        sighting."""
        k = len(self.points) - 1
        ranges = RADII if self._missing[k, 0] else (self._ranges[k],)
        bearings = np.arange(HEADINGS) * 2.0 * np.pi / HEADINGS if self._missing[k, 1] else (self._bearings[k],)
        grid = np.meshgrid(np.arange(CIRCLE) * 2.0 * np.pi / CIRCLE, np.array(ranges), np.array(bearings))
        return self._poses_from(k, *(g.ravel() for g in grid))

    def drawn(self, rng: np.random.Generator, count: int) -> Array:
        """Return ``count`` random poses (N, 3) at the last sighting. They are drawn from the known start position if
        there is one, otherwise from the likelihood of the last sighting."""
        if self._start is not None:
            return self._start.drawn(rng, count, self.now)
        k, noise = len(self.points) - 1, rng.standard_normal((2, count))
        headings = rng.uniform(-np.pi, np.pi, count)
        ranges = np.abs(self._ranges[k] + self._sigmas[k, 0] * noise[0])
        bearings = self._bearings[k] + self._sigmas[k, 1] * noise[1]
        if self._missing[k, 0]:
            ranges = rng.uniform(RADII[0], RADII[-1], count)
        if self._missing[k, 1]:
            bearings = rng.uniform(-np.pi, np.pi, count)
        return self._poses_from(k, headings, ranges, bearings)

    def _poses_from(self, k: int, headings: Array, ranges: Array, bearings: Array) -> Array:
        """Return poses (N, 3) at the last sighting, computed from the sighting with index ``k`` and the odometry.
        ``headings`` (N,): robot headings at sighting ``k``. ``ranges``, ``bearings`` (N,): range [m] and bearing [rad]
        of its landmark."""
        turned = np.column_stack((np.zeros((len(headings), 2)), headings))
        relative = se2.transform_from(turned, located(self._model, ranges, bearings))
        return se2.compose(np.column_stack((self.points[k] - relative, headings)), self._forth[k])

    def alignments(self) -> Array:
        """Return candidates (N, 3) of the pose at the last sighting, one for each pair of landmarks with range and
        bearing. At this pose the observed positions of the two landmarks are aligned with the map."""
        full = [k for k in self._recent() if not self._missing[k].any()]
        pairs = np.array(list(combinations(full, 2)), dtype=int).reshape(-1, 2)
        mapped, observed = self.points[pairs], self._from_present()[pairs]
        for_world, for_robot = mapped[:, 1] - mapped[:, 0], observed[:, 1] - observed[:, 0]
        wide = np.minimum(np.hypot(*for_world.T), np.hypot(*for_robot.T)) > BASELINE
        heading = np.arctan2(for_world[:, 1], for_world[:, 0]) - np.arctan2(for_robot[:, 1], for_robot[:, 0])
        turned = np.column_stack((np.zeros((len(pairs), 2)), heading))
        middle = se2.transform_from(turned, observed.mean(axis=1))
        poses = np.column_stack((mapped.mean(axis=1) - middle, se2.wrap(heading)))
        return np.asarray(poses[wide])

    def candidate_covariance(self) -> Array:
        """Return the approximate covariance (3, 3) of the errors of candidates that are not refined yet."""
        heading = 2.0 * np.pi / HEADINGS / 2.0 if self._missing[-1, 1] else 0.1
        distances = self._ranges[~self._missing[:, 0]]
        position = 0.1 + 0.05 * float(np.median(distances) if len(distances) else RADII[-1])
        return np.diag(np.square((position, position, heading)))

    def whitener(self, noise: Array | None = None) -> Array:
        """Return matrices (K, 2, 2) that whiten the residuals of the sightings by sensor noise and odometry error.
        ``noise`` (3, 3): an additional body-frame covariance of the pose at the last sighting."""
        error = self._drift
        if noise is not None:
            error = error + self._carried @ noise @ self._carried.transpose(0, 2, 1)
        sightings = np.zeros((len(self.points), 3)), self._from_robot(), self._ranges, self._bearings
        jacobian = linearize_each(self._model.packed, *sightings)[1][..., :POINT]
        covariance = np.eye(2) + jacobian @ error @ jacobian.transpose(0, 2, 1)
        # without a bearing the direction to the landmark is unknown: use the largest odometry error of all directions
        worst = np.linalg.eigvalsh(error[:, :2, :2])[:, -1] / self._sigmas[:, 0] ** 2
        covariance[:, 0, 0] = np.where(self._missing[:, 1], 1.0 + worst, covariance[:, 0, 0])
        return positive.whitener(covariance)

    def squared(self, poses: Array, whitener: Array) -> Array:
        """Return the squared norms (N, K) of the whitened residuals of K sightings, for N ``poses`` (N, 3) at the last
        sighting. ``whitener``: the result of :meth:`whitener`."""
        return np.asarray(np.sum((whitener @ self._residuals(poses)[..., None])[..., 0] ** 2, axis=-1))

    def losses(self, poses: Array, whitener: Array, noise: Array | None = None) -> Array:
        """Return the losses (N,) of ``poses`` (N, 3) at the last sighting: the sum of robust losses of the sightings,
        plus the loss of a known start. ``whitener``: the result of :meth:`whitener`. ``noise`` (3, 3): body-frame
        covariance of the poses. Only the loss of the start depends on ``noise``."""
        loss: Array = geman_mcclure_loss(self.squared(poses, whitener), self._model.robust).sum(axis=1)
        return loss if self._start is None else loss + self._start.loss(poses, self.now, noise)

    def refined(
        self, poses: Array, whitener: Array, iterations: int, noise: Array | None = None
    ) -> tuple[Array, Array]:
        """Return N poses (N, 3) that minimise :meth:`losses`, and their body-frame covariances (N, 3, 3). ``poses`` (N,
        3): the initial values. ``iterations``: the maximum number of steps of Levenberg-Marquardt. ``whitener``,
        ``noise``: see :meth:`losses`."""

        def at(poses: Array, _: Integers) -> tuple[Array, Array, Array]:
            information, gradient = self._normal_equations(poses, whitener, noise)
            return self.losses(poses, whitener, noise), gradient, information

        def moved(poses: Array, steps: Array) -> Array:
            return se2.compose(poses, se2.exp(steps))

        optima = minima(at, poses, iterations, CONVERGED, moved=moved, largest=1.0)
        return optima.states, np.asarray(np.linalg.inv(optima.curvatures))

    def fused(self, pose: Array, whitener: Array, iterations: int) -> tuple[Array, Array]:
        """Return a pose (3,) and its body-frame covariance (3, 3) at the last sighting, with correlated odometry
        errors.

        The method is ``iterations`` steps of Gauss-Newton from ``pose`` (3,). The path since the sightings is
        marginalised. Let e be the residuals, whitened by the sensor noise, J their Jacobian by the path, and C the
        covariance of the path. The covariance of e is R = I + J C J'. The residuals on the most likely path are R^-1 e.
        ``whitener``: the result of :meth:`whitener`. It determines the initial robust weights.
        """
        covariances = self._covariance
        if self._start is not None:  # the known start becomes the first row, without robust loss
            covariances = np.concatenate((self._start.whitened(pose, self.now)[2][None], covariances))
        rows = np.arange(len(covariances))
        common = covariances[np.maximum(rows[:, None], rows)]
        weight = np.ones(len(rows))
        first = len(rows) - len(self.points)
        weight[first:] = geman_mcclure_weight(self.squared(pose[None], whitener)[0], self._model.robust)
        for _ in range(iterations):
            root = np.sqrt(np.maximum(weight, 1e-6))
            error, jacobian = (part[0] for part in self._linearized(pose[None]))
            if self._start is not None:
                residual, by_pose, _ = self._start.whitened(pose, self.now)
                jacobian, error = np.concatenate((by_pose[None], jacobian)), np.concatenate((residual[None], error))
            jacobian, error = root[:, None, None] * jacobian, (root[:, None] * error).ravel()
            drift = np.einsum("iab,ijbc,jdc->iajd", jacobian, common, jacobian, optimize=True)
            jacobian = jacobian.reshape(-1, 3)
            solved = np.linalg.solve(np.eye(len(error)) + drift.reshape(len(error), -1), np.c_[jacobian, error])
            covariance = np.linalg.inv(jacobian.T @ solved[:, :3] + FLAT)
            step = -covariance @ (jacobian.T @ solved[:, 3])
            pose = se2.compose(pose, se2.exp(step))
            on_path = (solved[:, 3] + solved[:, :3] @ step).reshape(-1, 2) / root[:, None]
            weight[first:] = geman_mcclure_weight(np.sum(on_path[first:] ** 2, axis=1), self._model.robust)
        return pose, covariance

    def _recent(self) -> list[int]:
        """Return the index of the last sighting of each landmark, newest first, for at most RECENT landmarks."""
        last = {tuple(p): k for k, p in enumerate(self.points.tolist())}
        return sorted(last.values(), reverse=True)[:RECENT]

    def _from_robot(self) -> Array:
        """Return the observed positions (K, 2) of the landmarks in the robot frame at each sighting. Missing ranges are
        replaced by ``RADII[2]``, missing bearings by 0."""
        ranges = np.where(self._missing[:, 0], RADII[2], self._ranges)
        return located(self._model, ranges, np.where(self._missing[:, 1], 0.0, self._bearings))

    def _from_present(self) -> Array:
        """Return the observed positions (K, 2) of the landmarks in the robot frame at the last sighting."""
        return se2.transform_from(self._back, self._from_robot())

    def _residuals(self, poses: Array) -> Array:
        """Return residuals (N, K, 2), whitened by the sensor noise, for N ``poses`` (N, 3) at the last sighting."""
        at = se2.compose(poses[:, None], self._back)
        return residuals(self._model, at, self.points, self._ranges, self._bearings)

    def _linearized(self, poses: Array) -> tuple[Array, Array]:
        """Return residuals (N, K, 2), whitened by the sensor noise, for N ``poses`` (N, 3) at the last sighting. Also
        return their Jacobians (N, K, 2, 3) by the body-frame perturbation of the pose."""
        at, count = se2.compose(poses[:, None], self._back), len(poses)
        sightings = np.tile(self.points, (count, 1)), np.tile(self._ranges, count), np.tile(self._bearings, count)
        error, jacobian = linearize_each(self._model.packed, at.reshape(-1, 3), *sightings)
        jacobian = jacobian[..., :POINT].reshape(*at.shape[:2], 2, 3) @ self._carried
        return error.reshape(*at.shape[:2], 2), jacobian

    def _normal_equations(self, poses: Array, whitener: Array, noise: Array | None) -> tuple[Array, Array]:
        """Return the Gauss-Newton Hessian (N, 3, 3) and the gradient (N, 3) of :meth:`losses` at ``poses`` (N, 3). A
        small constant is added to the Hessian, so that it is invertible. For ``whitener`` and ``noise`` see
        :meth:`losses`."""
        error, jacobian = self._linearized(poses)
        error, jacobian = (whitener @ error[..., None])[..., 0], whitener @ jacobian
        weight = geman_mcclure_weight(np.sum(error**2, axis=-1), self._model.robust)
        weighted = np.swapaxes(weight[..., None, None] * jacobian, -1, -2)
        information, gradient = np.sum(weighted @ jacobian, axis=1) + FLAT, np.sum(weighted @ error[..., None], axis=1)
        if self._start is None:
            return information, gradient[..., 0]
        more, by_start = self._start.normal_equations(poses, self.now, noise)
        return information + more, gradient[..., 0] + by_start
