"""A cloud of weighted particles: its moments, its modes, its density, resampling, and the correction by a likelihood."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import RunFailedError
from factorgraph_loc.model.belief import Mode
from factors import positive, se2
from factors.motion import ChainState
from factors.se2 import Array

# of a cloud that has collapsed to one point: its covariance must still be one
MINIMUM_VARIANCE = 1e-10
LEAST_VARIANCE = 1e-30  # of constants, in their units: particles that all descend from one must not make them exact
NOWHERE = np.zeros(3)
NO_ODOMETRY = ChainState(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
MODES = 5  # at most
REACH = np.array((1.0, 1.0, 0.6))  # m, m, rad: from the middle of a mode to its ends
BISECTIONS, SMALLEST = 8, 0.01  # steps to find the share of the remaining likelihood; least share of it
LEAST = 1e-3  # least share of the whole likelihood: the steps end even if no particle explains it
CELL = np.array((0.5, 0.5, 0.3))  # m, m, rad: size of the cells among which the heaviest is sought

T = TypeVar("T")
Steps = Generator[float, None, T]  # a computation in steps: it yields the work of each step and returns the result


@dataclass(frozen=True)
class Cloud:
    """``poses`` (N, 3), ``constants`` (N, P) of odometry and sensor, and normalised ``log_weights`` (N,).

    ``parts``: the columns of each block in them. ``localized``: the place is known. ``odometry``: that of when the particles were
    there.
    """

    poses: Array
    constants: Array
    log_weights: Array
    localized: bool = True
    parts: Mapping[str, slice] = field(default_factory=dict)
    odometry: ChainState = NO_ODOMETRY

    @property
    def weights(self) -> Array:
        return np.asarray(np.exp(self.log_weights))

    @cached_property
    def moments(self) -> tuple[Array, Array]:
        """Mean (3,) and covariance (3, 3) in the world's frame."""
        return pose_moments(self.poses, self.weights)

    @cached_property
    def joint(self) -> tuple[Array, Array]:
        """Mean (P,) of the constants, and covariance (3+P, 3+P) of the pose's body-frame perturbation and of them."""
        _, mean, covariance = self._errors()
        return mean[3:], covariance

    def _errors(self) -> tuple[Array, Array, Array]:
        """Of each particle the pose's body-frame perturbation from the mean pose, and the constants: (N, 3+P), with moments."""
        errors = np.concatenate((se2.twists_to(self.moments[0], self.poses), self.constants), axis=1)
        return errors, *vector_moments(errors, self.weights)

    def with_block(self, name: str, mean: Array, covariance: Array, rng: np.random.Generator) -> Cloud:
        """With one more block, drawn from a Gaussian with ``mean`` (d,) and ``covariance`` (d, d)."""
        first = self.constants.shape[1]
        drawn = mean + positive.draws(covariance, len(self.poses), rng)
        parts = {**self.parts, name: slice(first, first + len(mean))}
        return replace(self, constants=np.concatenate((self.constants, drawn), axis=1), parts=parts)

    def weighed(self, likelihood: Array, share: float) -> tuple[Cloud, float]:
        """The particles after a share of a log-likelihood (N,), and the log of its mean."""
        weighed = self.log_weights + share * likelihood
        log_weights = normalised(weighed)
        heaviest = int(np.argmax(weighed))
        return replace(self, log_weights=log_weights), float(weighed[heaviest] - log_weights[heaviest])

    def thinned(self, count: int) -> Cloud:
        """About so many of the particles, as far apart in their order as there is room."""
        some = slice(None, None, max(1, len(self.poses) // count))
        weights = normalised(self.log_weights[some])
        return replace(self, poses=self.poses[some], constants=self.constants[some], log_weights=weights)

    def density(self) -> tuple[Cloud, Array]:
        """A kernel density with the moments of the sampled density: poses shrunk towards their mean, each with a Gaussian kernel
        (Liu, West, in "Sequential Monte Carlo Methods in Practice", 2001, eq. 10.3.8). The kernel's width depends on the number
        of particles (:func:`silverman`). Given the pose the constants are Gaussian. As particles few distinct constants would
        survive, long before landmarks determine them.

        Returns the shrunk cloud and the kernel's covariance (3+P, 3+P), of the pose's body-frame perturbation and of the
        constants. With several modes the kernel does not change the poses.
        """
        weights = self.weights
        middle, _ = self.moments
        errors, mean, covariance = self._errors()
        # The covariance of a weighted sample is too small by the factor 1 - sum(w^2), and smaller still if many particles have few
        # ancestors. Without a correction the constants would lose this share with each resampling.
        lost = float(weights @ weights)
        diagonal = range(3, len(covariance))
        covariance[diagonal, diagonal] += LEAST_VARIANCE
        if not self.localized:
            covariance[:3] = covariance[:, :3] = 0.0
            constants = np.broadcast_to(mean[3:], self.constants.shape)
            return replace(self, constants=constants), _inflated(covariance, lost)
        covariance[range(3), range(3)] += MINIMUM_VARIANCE
        renewed = silverman(*errors.shape) ** 2
        # regression (3, 3+P) of pose and constants on the pose, and the covariance that it explains
        by_pose = positive.solve(covariance[:3, :3], covariance[:3])
        explained = covariance[:, :3] @ by_pose
        shrunk = mean + np.sqrt(1.0 - renewed) * (errors[:, :3] - mean[:3]) @ by_pose
        cloud = replace(
            self,
            poses=se2.all_moved(np.tile(middle, (len(shrunk), 1)), NOWHERE, shrunk),
            constants=shrunk[:, 3:],
        )
        kernel = _inflated(explained, lost / renewed) - (1.0 - renewed) * explained
        return cloud, kernel + _inflated(covariance - explained, lost)

    def drawn(self, rows: NDArray[np.int64], kernel: Array, rng: np.random.Generator) -> Cloud:
        """Particles of equal weight: those of ``rows`` (M,), each with a draw from a ``kernel`` (3+P, 3+P)."""
        noise = positive.draws(kernel, len(rows), rng)
        return replace(
            self,
            poses=se2.all_moved(self.poses[rows], NOWHERE, noise),
            constants=self.constants[rows] + noise[:, 3:],
            log_weights=np.full(len(rows), -np.log(len(rows))),
        )

    def modes(self) -> tuple[Mode, ...]:
        """The modes, heaviest first, each with the moments of the particles around it."""
        weights = self.weights
        modes: list[Mode] = []
        _, which = np.unique(cell_numbers(self.poses, CELL), return_inverse=True)
        free = np.ones(len(weights), dtype=bool)
        while len(modes) < MODES and weights[free].sum() > 0.01:
            heaviest = free & (which == np.argmax(np.bincount(which, weights * free)))
            middle, _ = _normalised_moments(self.poses[heaviest], weights[heaviest])
            for _ in range(2):
                near = free & around(self.poses, middle)
                middle, covariance = _normalised_moments(self.poses[near], weights[near])
            modes.append(Mode(float(weights[near].sum()), middle, covariance))
            free &= ~near
        return tuple(sorted(modes, key=lambda m: -m.weight))


class Corrected(NamedTuple):
    """Particles after a share of a likelihood, the log of its mean over them, and the share that is ``left``."""

    cloud: Cloud
    evidence: float
    left: float


def corrected(
    cloud: Cloud,
    likelihood: Callable[[Cloud], Steps[Array]],
    resampled: Callable[[Cloud], Steps[Cloud]],
    enough: Callable[[Cloud], float],
    t: float,
    *,
    below: float = 0.0,
    left: float = 1.0,
    to_end: bool = True,
) -> Steps[Corrected]:
    """Progressive correction (Musso, Oudjane, Le Gland, in "Sequential Monte Carlo Methods in Practice", 2001, section 12.4).

    The log-likelihood (N,) of a measurement at ``t`` is applied in shares. Each is the largest that keeps ``enough`` effective
    particles. They are resampled after each share, after the last one only if fewer than ``below`` times N are effective.
    ``left``: the part of the log-likelihood to apply. Without ``to_end`` the last share is not applied. RunFailedError if no
    particle is possible.
    """
    evidence = 0.0
    while left > 0.0:
        values = weighable((yield from likelihood(cloud)), cloud.log_weights, t)
        share = largest_share(cloud.log_weights, values, left, enough(cloud))
        if share >= left and not to_end:
            break
        cloud, mean = cloud.weighed(values, share)
        evidence, left = evidence + mean, left - share
        if left > 0.0 or effective_size(cloud.log_weights) < below * len(cloud.poses):
            cloud = yield from resampled(cloud)
    return Corrected(cloud, evidence, left)


def in_one_step(function: Callable[[Cloud], T]) -> Callable[[Cloud], Steps[T]]:
    """A function of particles as a computation of one step, whose work is not counted."""

    def steps(cloud: Cloud) -> Steps[T]:
        yield 0.0
        return function(cloud)

    return steps


def finished(steps: Steps[T]) -> T:
    """The result of a computation in steps."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            result: T = end.value
            return result


def systematic(weights: Array, rng: np.random.Generator, count: int | None = None) -> NDArray[np.int64]:
    """Indices of ``count`` draws (as many as weights by default) by systematic resampling (Kitagawa, 1996)."""
    count = len(weights) if count is None else count
    positions = (rng.random() + np.arange(count)) / count
    cumulative = np.cumsum(weights)
    return np.asarray(np.minimum(np.searchsorted(cumulative / cumulative[-1], positions), len(weights) - 1))


def around(poses: Array, middle: Array) -> NDArray[np.bool_]:
    """Which of the poses (N, 3) belong to a mode with this ``middle`` (3,)."""
    difference = np.abs(poses - middle)
    difference[:, 2] = np.abs(se2.wrap(difference[:, 2]))
    return np.asarray(np.all(difference < REACH, axis=1))


def cell_numbers(poses: Array, cell: Array) -> NDArray[np.int64]:
    """Numbers (N,) of the cells that contain poses (N, 3). ``cell`` (3,): the size of a cell [m, m, rad]."""
    places = np.floor(poses / cell).astype(np.int64)
    places -= places.min(axis=0)
    size = places.max(axis=0) + 1
    return np.asarray((places[:, 0] * size[1] + places[:, 1]) * size[2] + places[:, 2])


def largest_share(log_weights: Array, likelihood: Array, left: float, enough: float) -> float:
    """The largest share of the log-likelihood (N,), at most ``left``, that keeps ``enough`` effective particles.
    It is at least :data:`LEAST`, so that a likelihood is applied in a few hundred shares at most."""

    def effective(share: float) -> float:
        weighed = log_weights + share * likelihood
        weights = np.exp(weighed - weighed.max())
        return float(weights.sum() ** 2 / (weights @ weights))

    if effective(left) >= enough:
        return left
    low, high = 0.0, left
    for _ in range(BISECTIONS):
        middle = (low + high) / 2.0
        low, high = (middle, high) if effective(middle) >= enough else (low, middle)
    return max(low, SMALLEST * left, min(left, LEAST))


def weighable(likelihood: Array, log_weights: Array, t: float) -> Array:
    """A log-likelihood (N,) at time ``t`` [s] with -inf in place of NaN, for particles with ``log_weights`` (N,).

    Such particles are impossible. RunFailedError if all particles are.
    """
    possible = np.isfinite(likelihood)
    if possible.all():
        return likelihood
    if not np.isfinite(log_weights[possible]).any():
        raise RunFailedError(
            f"at {t:.3f} s the likelihood of a measurement is a finite number for none of the particles"
        )
    return np.where(possible, likelihood, -np.inf)


def effective_size(log_weights: Array) -> float:
    """Of normalised log-weights (N,) (Kong, Liu, Wong, 1994)."""
    return float(1.0 / np.sum(np.exp(2.0 * log_weights)))


def normalised(log_weights: Array) -> Array:
    """Log-weights (N,) whose weights sum to one."""
    log_weights = log_weights - log_weights.max()
    return np.asarray(log_weights - np.log(np.sum(np.exp(log_weights))))


def silverman(count: int, size: int) -> float:
    """Bandwidth, as a share of the standard deviation, of Gaussian kernels on ``count`` points in ``size`` dimensions
    (Silverman, "Density Estimation for Statistics and Data Analysis", 1986, eq. 4.14)."""
    return float((4.0 / ((size + 2) * count)) ** (1.0 / (size + 4)))


def pose_moments(poses: Array, weights: Array) -> tuple[Array, Array]:
    """Weighted mean (3,), circular in heading, and covariance (3, 3) of poses (N, 3) in the world's frame."""
    mean, covariance = se2.moments(poses, weights)
    return mean, covariance + np.diag(np.full(3, MINIMUM_VARIANCE))


def vector_moments(values: Array, weights: Array) -> tuple[Array, Array]:
    """Weighted mean (P,) and covariance (P, P) of vectors (N, P)."""
    mean = weights @ values
    error = values - mean
    return mean, (weights[:, None] * error).T @ error


def _inflated(covariance: Array, lost: float) -> Array:
    """A covariance that has lost this share."""
    return covariance / max(1.0 - lost, 0.5)


def _normalised_moments(poses: Array, weights: Array) -> tuple[Array, Array]:
    return pose_moments(poses, weights / weights.sum())
