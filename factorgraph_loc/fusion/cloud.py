"""A cloud of weighted particles: moments, modes, kernel density, resampling, and the correction by a likelihood."""

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

# This value is added to the variances of poses, so that the covariance of identical particles is invertible.
MINIMUM_VARIANCE = 1e-10
LEAST_VARIANCE = 1e-30  # added to the variances of sensor constants, which identical particles would make zero
NOWHERE = np.zeros(3)  # a motion of zero
NO_ODOMETRY = ChainState(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
MODES = 5  # maximum number of modes
REACH = np.array((1.0, 1.0, 0.6))  # m, m, rad: largest distance of a particle from the centre of its mode
# of the exponent of a step of :func:`corrected`: the number of bisections to find it, and its minimum as a fraction of
# the remaining exponent
BISECTIONS, SMALLEST = 8, 0.01
LEAST = 1e-3  # absolute minimum of the exponent, so that a correction ends even if no particle explains the measurement
CELL = np.array((0.5, 0.5, 0.3))  # m, m, rad: size of grid cells. The heaviest cell is the first guess of a mode.

T = TypeVar("T")
Steps = Generator[float, None, T]  # a computation in steps. It yields the computing cost of each and returns the result


@dataclass(frozen=True)
class Cloud:
    """N weighted particles (poses and sensor constants) at one time.

    ``poses`` (N, 3): x, y [m], heading [rad]. ``constants`` (N, P): each particle's estimated constants of odometry and
    sensors. ``log_weights`` (N,): normalised. ``localized``: True if there is only one mode. ``parts``: for each sensor
    by name, the columns of its constants in ``constants``. ``odometry``: the integrated odometry at the time of the
    particles.
    """

    poses: Array
    constants: Array
    log_weights: Array
    localized: bool = True
    parts: Mapping[str, slice] = field(default_factory=dict)
    odometry: ChainState = NO_ODOMETRY

    @cached_property
    def weights(self) -> Array:
        return np.asarray(np.exp(self.log_weights))

    @cached_property
    def moments(self) -> tuple[Array, Array]:
        """The weighted mean (3,) and covariance (3, 3) of the poses (x, y, heading) in the world frame."""
        return pose_moments(self.poses, self.weights)

    @cached_property
    def joint(self) -> tuple[Array, Array]:
        """The mean (P,) of the constants, and the joint covariance (3+P, 3+P) of pose and constants. The pose's error
        is a perturbation in the body frame."""
        _, mean, covariance = self._errors()
        return mean[3:], covariance

    def _errors(self) -> tuple[Array, Array, Array]:
        """Return values (N, 3+P) of the particles: body-frame perturbations from the mean pose, and constants. Also
        returns their mean (3+P,) and covariance (3+P, 3+P)."""
        errors = np.concatenate((se2.twists_to(self.moments[0], self.poses), self.constants), axis=1)
        return errors, *vector_moments(errors, self.weights)

    def with_block(self, name: str, mean: Array, covariance: Array, rng: np.random.Generator) -> Cloud:
        """Return the particles with ``d`` additional constants of the sensor ``name``. Each particle's values are drawn
        from a Gaussian with ``mean`` (d,) and ``covariance`` (d, d)."""
        first = self.constants.shape[1]
        drawn = mean + positive.draws(covariance, len(self.poses), rng)
        parts = {**self.parts, name: slice(first, first + len(mean))}
        return replace(self, constants=np.concatenate((self.constants, drawn), axis=1), parts=parts)

    def weighed(self, likelihood: Array, share: float) -> tuple[Cloud, float]:
        """Return the particles with each weight multiplied by its likelihood to the power of ``share``. Also returns
        the logarithm of the weighted mean of these powers. ``likelihood`` (N,): the log-likelihood of each particle."""
        weighed = self.log_weights + share * likelihood
        log_weights = normalised(weighed)
        heaviest = int(np.argmax(weighed))
        return replace(self, log_weights=log_weights), float(weighed[heaviest] - log_weights[heaviest])

    def thinned(self, count: int) -> Cloud:
        """Return every k-th particle, with k chosen so that about ``count`` particles remain. Their weights are
        normalised."""
        some = slice(None, None, max(1, len(self.poses) // count))
        weights = normalised(self.log_weights[some])
        return replace(self, poses=self.poses[some], constants=self.constants[some], log_weights=weights)

    def density(self) -> tuple[Cloud, Array]:
        """Return a kernel density with the same moments as the particles. It consists of the kernel centres and the
        covariance of the kernel.

        The centres are the particles, moved towards their mean (Liu, West, in "Sequential Monte Carlo Methods in
        Practice", 2001, eq. 10.3.8). The covariance (3+P, 3+P) is that of the pose's body-frame perturbation and the
        constants. If there are several modes, the poses are not moved and their part of the covariance is zero.
        """
        weights = self.weights
        middle, _ = self.moments
        errors, mean, covariance = self._errors()
        # A sample's covariance is too small by the factor 1 - sum(w^2), and would shrink at each resampling
        lost = float(weights @ weights)
        diagonal = range(3, len(covariance))
        covariance[diagonal, diagonal] += LEAST_VARIANCE
        if not self.localized:
            covariance[:3] = covariance[:, :3] = 0.0
            constants = np.broadcast_to(mean[3:], self.constants.shape)
            return replace(self, constants=constants), _inflated(covariance, lost)
        covariance[range(3), range(3)] += MINIMUM_VARIANCE
        renewed = silverman(*errors.shape) ** 2
        # linear regression (3, 3+P) of pose and constants on the pose, and the part of the covariance that it explains
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
        """Return M particles of equal weight, drawn from a kernel density with the particles as centres. ``rows`` (M,):
        the index of the centre of each new particle. ``kernel`` (3+P, 3+P): the covariance of the Gaussian kernel."""
        noise = positive.draws(kernel, len(rows), rng)
        return replace(
            self,
            poses=se2.all_moved(self.poses[rows], NOWHERE, noise),
            constants=self.constants[rows] + noise[:, 3:],
            log_weights=np.full(len(rows), -np.log(len(rows))),
        )

    def modes(self) -> tuple[Mode, ...]:
        """Return the modes, in order of decreasing weight. Each has the weight, mean and covariance of the particles
        around its centre."""
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
    """Particles after a correction by a likelihood. ``evidence``: the logarithm of the likelihood's mean over the
    particles. ``left``: the sum of the likelihood's exponents that are not yet applied, 0 after a complete
    correction."""

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
    """Correct particles by a likelihood in several steps (Musso, Oudjane, Le Gland, in "Sequential Monte Carlo Methods
    in Practice", 2001, section 12.4).

    Each step multiplies the weights by a power of the likelihood, then resamples. The exponents of all steps have the
    sum ``left``. Each exponent is the largest that keeps enough effective particles.

    ``likelihood(cloud)``: computes the log-likelihood (N,) of the measurement. ``resampled(cloud)``: computes a
    resampled cloud. ``enough(cloud)``: returns the minimum effective number of particles after a step. ``t`` [s]: the
    time of the measurement, for errors. ``below``: after the last step, particles are resampled only if the effective
    number is below this fraction of N. ``to_end``: False to omit the last step.

    Returns a generator. It yields the computing cost of each part, and its return value is a :class:`Corrected`. Raises
    RunFailedError if no particle with a nonzero weight has a finite log-likelihood.
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
    """Convert a function of particles to a function that returns a generator. The generator yields the computing cost 0
    once, then returns the function's value."""

    def steps(cloud: Cloud) -> Steps[T]:
        yield 0.0
        return function(cloud)

    return steps


def finished(steps: Steps[T]) -> T:
    """Run the generator ``steps`` to its end. Returns the value of its ``return`` statement."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            result: T = end.value
            return result


def systematic(weights: Array, rng: np.random.Generator, count: int | None = None) -> NDArray[np.int64]:
    """Return ``count`` random indices with probabilities proportional to ``weights`` (N,), by systematic resampling
    (Kitagawa, 1996). The default of ``count`` is N."""
    count = len(weights) if count is None else count
    positions = (rng.random() + np.arange(count)) / count
    cumulative = np.cumsum(weights)
    return np.asarray(np.minimum(np.searchsorted(cumulative / cumulative[-1], positions), len(weights) - 1))


def around(poses: Array, middle: Array) -> NDArray[np.bool_]:
    """Return a mask (N,) of the poses (N, 3) that are near the pose ``middle`` (3,), the centre of a mode."""
    difference = np.abs(poses - middle)
    difference[:, 2] = np.abs(se2.wrap(difference[:, 2]))
    return np.asarray(np.all(difference < REACH, axis=1))


def cell_numbers(poses: Array, cell: Array) -> NDArray[np.int64]:
    """Return an integer (N,) for each of N poses (N, 3). Poses in the same grid cell have equal integers. ``cell``
    (3,): the size of a cell [m, m, rad]."""
    places = np.floor(poses / cell).astype(np.int64)
    places -= places.min(axis=0)
    size = places.max(axis=0) + 1
    return np.asarray((places[:, 0] * size[1] + places[:, 1]) * size[2] + places[:, 2])


def largest_share(log_weights: Array, likelihood: Array, left: float, enough: float) -> float:
    """Return the largest exponent of a likelihood, at most ``left``, that keeps an effective number of at least
    ``enough`` particles.

    ``log_weights`` (N,): the particles' log-weights. ``likelihood`` (N,): their log-likelihoods. The result is at least
    :data:`LEAST`, so that a correction has at most a few hundred steps.
    """

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
    """Return a ``likelihood`` (N,), the log-likelihoods of particles, with ``-inf`` instead of values that are not
    finite. These particles then get the weight 0.

    ``log_weights`` (N,): the particles' log-weights. ``t`` [s]: the time of the measurement, for errors. Raises
    RunFailedError if no particle with a nonzero weight has a finite log-likelihood.
    """
    possible = np.isfinite(likelihood)
    if possible.all():
        return likelihood
    if not np.isfinite(log_weights[possible]).any():
        raise RunFailedError(f"the likelihood of the measurement at {t:.3f} s is not finite for any of the particles")
    return np.where(possible, likelihood, -np.inf)


def effective_size(log_weights: Array) -> float:
    """Return the effective number of particles: one divided by the sum of squared weights (Kong, Liu, Wong, 1994).
    ``log_weights`` (N,): normalised, so that the weights have the sum 1."""
    return float(1.0 / np.sum(np.exp(2.0 * log_weights)))


def normalised(log_weights: Array) -> Array:
    """Return log-weights (N,) normalised, so that the weights have the sum 1."""
    log_weights = log_weights - log_weights.max()
    return np.asarray(log_weights - np.log(np.sum(np.exp(log_weights))))


def silverman(count: int, size: int) -> float:
    """Return the bandwidth of Gaussian kernels for ``count`` points in ``size`` dimensions, relative to the points'
    standard deviation. Source: Silverman, "Density Estimation for Statistics and Data Analysis", 1986, eq. 4.14."""
    return float((4.0 / ((size + 2) * count)) ** (1.0 / (size + 4)))


def pose_moments(poses: Array, weights: Array) -> tuple[Array, Array]:
    """Return the weighted mean (3,) of poses (N, 3), with a circular mean of the headings, and their covariance (3, 3)
    in the world frame. ``weights`` (N,): must have the sum 1."""
    mean, covariance = se2.moments(poses, weights)
    return mean, covariance + np.diag(np.full(3, MINIMUM_VARIANCE))


def vector_moments(values: Array, weights: Array) -> tuple[Array, Array]:
    """Return the weighted mean (P,) and covariance (P, P) of vectors (N, P). ``weights`` (N,): must have the sum 1."""
    mean = weights @ values
    error = values - mean
    return mean, (weights[:, None] * error).T @ error


def _inflated(covariance: Array, lost: float) -> Array:
    """Return a ``covariance`` divided by ``1 - lost``. ``lost``: a fraction from 0 to 0.5; larger values count as
    0.5."""
    return covariance / max(1.0 - lost, 0.5)


def _normalised_moments(poses: Array, weights: Array) -> tuple[Array, Array]:
    """Return the result of :func:`pose_moments` for weights of any sum."""
    return pose_moments(poses, weights / weights.sum())
