"""A start with known position and unknown heading, used by the search of the pose.

The prior is Gaussian in the position and uniform in the heading. Propagated along the odometry, it is one more constraint on the
current pose and generates hypotheses.
"""

import math
from dataclasses import dataclass

import numpy as np

from factorgraph_loc.model.belief import Mode, PosePrior
from factorgraph_loc.sensors.motion import Motion
from factors import positive, se2
from factors.motion import ChainState
from factors.se2 import Array

HEADINGS = 72  # initial hypotheses
START_KEPT = 300.0  # s to find the heading for the trajectory to include the start


@dataclass
class KnownPosition:
    """A start with known position; see the module."""

    prior: PosePrior
    motion: Motion
    _odometry: ChainState | None = None

    @property
    def odometry(self) -> ChainState:
        """The odometry state at the time of the prior, from all rows so far or until it was settled."""
        return self.motion.state(self.t) if self._odometry is None else self._odometry

    def settle(self) -> None:
        """Fix the odometry at the start; called at the first measurement."""
        self._odometry = self.odometry

    @property
    def t(self) -> float:
        return self.prior.t

    def facing(self, heading: float) -> PosePrior:
        """The start as a Gaussian with a given heading."""
        covariance = self.prior.covariance.copy()
        covariance[2, 2] = math.pi**2
        return PosePrior(self.t, np.append(self.prior.pose[:2], heading), covariance)

    def mode(self, now: ChainState) -> Mode:
        """Moments of the current pose before any measurement."""
        x, y, turned = self.motion.relative(self.odometry, now).delta
        covariance = self.prior.covariance.copy()
        covariance[:2, :2] += 0.5 * (x**2 + y**2) * np.eye(2)  # displacement in an unknown direction
        return Mode(1.0, np.append(self.prior.pose[:2], turned), covariance)

    def candidates(self, now: ChainState) -> Array:
        """Current poses (N, 3) from the mean position with evenly spaced headings."""
        headings = np.arange(HEADINGS) * 2.0 * math.pi / HEADINGS
        starts = np.column_stack((np.tile(self.prior.pose[:2], (HEADINGS, 1)), headings))
        return se2.compose(starts, self.motion.relative(self.odometry, now).delta)

    def drawn(self, rng: np.random.Generator, count: int, now: ChainState) -> Array:
        """Random current poses (N, 3), with stratified headings."""
        moved = self.motion.relative(self.odometry, now)
        positions = self.prior.pose[:2] + positive.draws(self.prior.covariance[:2, :2], count, rng)
        headings = (rng.permutation(count) + rng.random(count)) * 2.0 * math.pi / count - math.pi
        poses = se2.compose(np.column_stack((positions, headings)), moved.delta)
        return se2.compose(poses, se2.exp(positive.draws(moved.covariance, count, rng)))

    def loss(self, poses: Array, now: ChainState, noise: Array | None = None) -> Array:
        """Half the squared Mahalanobis distance (N,) of current poses (N, 3) from the start. ``noise`` (3, 3): body-frame
        covariance of the current poses."""
        error, _, covariance = self._linearized(poses, now, noise)
        return np.asarray(0.5 * np.einsum("ni,ni->n", error, positive.solve(covariance, error[..., None])[..., 0]))

    def log_density(self, poses: Array, now: ChainState) -> Array:
        """Log density (N,) of current poses (N, 3)."""
        _, _, covariance = self._linearized(poses, now, None)
        normaliser = 0.5 * np.linalg.slogdet(2.0 * math.pi * covariance)[1] + math.log(2.0 * math.pi)
        return np.asarray(-self.loss(poses, now) - normaliser)

    def normal_equations(self, poses: Array, now: ChainState, noise: Array | None = None) -> tuple[Array, Array]:
        """Information (N, 3, 3) and gradient (N, 3) of the loss by the body-frame perturbation of current poses (N, 3)."""
        error, jacobian, covariance = self._linearized(poses, now, noise)
        weighted = positive.solve(covariance, jacobian).transpose(0, 2, 1)
        return weighted @ jacobian, (weighted @ error[..., None])[..., 0]

    def whitened(self, pose: Array, now: ChainState) -> tuple[Array, Array, Array]:
        """Residual (2,) of a current pose (3,) in standard deviations of the position, its Jacobian (2, 3) by the body-frame
        perturbation, and the covariance (3, 3) of the odometry since the start, which they do not include."""
        error, jacobian, _ = self._linearized(pose[None], now, None)
        root = positive.root(self.prior.covariance[:2, :2])
        moved = self.motion.relative(self.odometry, now)
        return np.linalg.solve(root, error[0]), np.linalg.solve(root, jacobian[0]), moved.covariance

    def _linearized(self, poses: Array, now: ChainState, noise: Array | None) -> tuple[Array, Array, Array]:
        """Start positions of poses (N, 3) minus the mean (N, 2), their Jacobian (N, 2, 3), and covariance (N, 2, 2)."""
        moved = self.motion.relative(self.odometry, now)
        back = se2.inverse(moved.delta)
        error = se2.compose(poses, back)[:, :2] - self.prior.pose[:2]
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        turn: Array = np.array(((c, -s), (s, c))).transpose(2, 0, 1)
        jacobian = turn @ np.array(((1.0, 0.0, -back[1]), (0.0, 1.0, back[0])))
        drift = moved.covariance if noise is None else moved.covariance + noise
        return error, jacobian, self.prior.covariance[:2, :2] + jacobian @ drift @ jacobian.transpose(0, 2, 1)
