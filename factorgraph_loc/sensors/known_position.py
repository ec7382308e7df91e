"""A start with known position and unknown heading, as a prior for global localization.

The prior is Gaussian in the position and uniform in the heading. The odometry propagates the prior to the current time.
The propagated prior is a constraint on the current pose, and gives candidates for this pose.
"""

import math
from dataclasses import dataclass

import numpy as np

from factorgraph_loc.model.belief import Mode, PosePrior
from factorgraph_loc.sensors.motion import Motion
from factors import positive, se2
from factors.motion import ChainState
from factors.se2 import Array

HEADINGS = 72  # number of initial headings
START_KEPT = 300.0  # s; if the heading is found later, the final trajectory does not begin at the start


@dataclass
class KnownPosition:
    """A start at a known position with unknown heading. ``prior``: the start pose with its covariance. Its heading is
    ignored. ``motion``: the odometry of the run."""

    prior: PosePrior
    motion: Motion
    _odometry: ChainState | None = None

    @property
    def odometry(self) -> ChainState:
        """The odometry state at the time of the prior. Before :meth:`settle` is called, rows of odometry that are added
        later may change it."""
        return self.motion.state(self.t) if self._odometry is None else self._odometry

    def settle(self) -> None:
        """Store the odometry state at the time of the prior, so that it no longer changes. Call this at the first
        measurement."""
        self._odometry = self.odometry

    @property
    def t(self) -> float:
        return self.prior.t

    def facing(self, heading: float) -> PosePrior:
        """Return a Gaussian prior of the start pose, with mean ``heading`` [rad] and standard deviation pi of the
        heading."""
        covariance = self.prior.covariance.copy()
        covariance[2, 2] = math.pi**2
        return PosePrior(self.t, np.append(self.prior.pose[:2], heading), covariance)

    def mode(self, now: ChainState) -> Mode:
        """Return a Gaussian of the pose at the odometry state ``now``, computed from start position and odometry alone.
        Its ``weight`` is 1."""
        x, y, turned = self.motion.relative(self.odometry, now).delta
        covariance = self.prior.covariance.copy()
        covariance[:2, :2] += 0.5 * (x**2 + y**2) * np.eye(2)  # displacement in an unknown direction
        return Mode(1.0, np.append(self.prior.pose[:2], turned), covariance)

    def candidates(self, now: ChainState) -> Array:
        """Return possible poses (N, 3) at the odometry state ``now``, one for each of N evenly spaced headings of the
        start."""
        headings = np.arange(HEADINGS) * 2.0 * math.pi / HEADINGS
        starts = np.column_stack((np.tile(self.prior.pose[:2], (HEADINGS, 1)), headings))
        return se2.compose(starts, self.motion.relative(self.odometry, now).delta)

    def drawn(self, rng: np.random.Generator, count: int, now: ChainState) -> Array:
        """Return ``count`` = N random poses (N, 3) at the odometry state ``now``: random start poses, moved by the
        odometry with random errors. The start positions are drawn from the prior. The start headings are stratified
        over the full circle."""
        moved = self.motion.relative(self.odometry, now)
        positions = self.prior.pose[:2] + positive.draws(self.prior.covariance[:2, :2], count, rng)
        headings = (rng.permutation(count) + rng.random(count)) * 2.0 * math.pi / count - math.pi
        poses = se2.compose(np.column_stack((positions, headings)), moved.delta)
        return se2.compose(poses, se2.exp(positive.draws(moved.covariance, count, rng)))

    def loss(self, poses: Array, now: ChainState, noise: Array | None = None) -> Array:
        """Return half the squared Mahalanobis distances (N,) of N start positions from the known start position.

        The start positions are computed from ``poses`` (N, 3) at the odometry state ``now`` and from the odometry.
        ``noise`` (3, 3): an additional body-frame covariance of the poses.
        """
        error, _, covariance = self._linearized(poses, now, noise)
        return np.asarray(0.5 * np.einsum("ni,ni->n", error, positive.solve(covariance, error[..., None])[..., 0]))

    def log_density(self, poses: Array, now: ChainState) -> Array:
        """Return the log density (N,) of ``poses`` (N, 3) at the odometry state ``now``. The density is the prior of
        the start, propagated by the odometry."""
        _, _, covariance = self._linearized(poses, now, None)
        normaliser = 0.5 * np.linalg.slogdet(2.0 * math.pi * covariance)[1] + math.log(2.0 * math.pi)
        return np.asarray(-self.loss(poses, now) - normaliser)

    def normal_equations(self, poses: Array, now: ChainState, noise: Array | None = None) -> tuple[Array, Array]:
        """Return the Gauss-Newton Hessian (N, 3, 3) and the gradient (N, 3) of :meth:`loss`, by perturbations of
        ``poses`` (N, 3) in the body frame. ``now``: the odometry state at the poses. ``noise`` (3, 3): an additional
        covariance of the poses."""
        error, jacobian, covariance = self._linearized(poses, now, noise)
        weighted = positive.solve(covariance, jacobian).transpose(0, 2, 1)
        return weighted @ jacobian, (weighted @ error[..., None])[..., 0]

    def whitened(self, pose: Array, now: ChainState) -> tuple[Array, Array, Array]:
        """Return a whitened residual (2,), its Jacobian (2, 3), and the covariance (3, 3) of the odometry since the
        start.

        The residual is the error of the start position that follows from the odometry and from ``pose`` (3,) at the
        odometry state ``now``. It is whitened with the prior covariance. The Jacobian is by the body-frame perturbation
        of the pose.
        """
        error, jacobian, _ = self._linearized(pose[None], now, None)
        root = positive.root(self.prior.covariance[:2, :2])
        moved = self.motion.relative(self.odometry, now)
        return np.linalg.solve(root, error[0]), np.linalg.solve(root, jacobian[0]), moved.covariance

    def _linearized(self, poses: Array, now: ChainState, noise: Array | None) -> tuple[Array, Array, Array]:
        """Return errors (N, 2) [m] of start positions, their Jacobians (N, 2, 3) by the poses, and their covariances
        (N, 2, 2). The start positions are computed from ``poses`` (N, 3) at the odometry state ``now``. ``noise``: see
        :meth:`loss`."""
        moved = self.motion.relative(self.odometry, now)
        back = se2.inverse(moved.delta)
        error = se2.compose(poses, back)[:, :2] - self.prior.pose[:2]
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        turn: Array = np.array(((c, -s), (s, c))).transpose(2, 0, 1)
        jacobian = turn @ np.array(((1.0, 0.0, -back[1]), (0.0, 1.0, back[0])))
        drift = moved.covariance if noise is None else moved.covariance + noise
        return error, jacobian, self.prior.covariance[:2, :2] + jacobian @ drift @ jacobian.transpose(0, 2, 1)
