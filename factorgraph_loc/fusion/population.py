"""The particles of a global search: poses anywhere in the map, weighed by the observations of all sensors.

The first particles are uniform over the bounds of the map, over its free space, or over all headings at a known position. Each
observation is applied by progressive correction (:func:`~factorgraph_loc.fusion.cloud.corrected`), so that few particles can find
narrow modes. Resampling draws new particles from kernels around old ones. In a large map the first kernels are as wide as the
distances between the particles. The number of particles follows from the size of the posterior (KLD sampling: Fox, IJRR 22(12),
2003, eq. 7). Each resampling also draws some particles anywhere, and some near existing particles, with little weight. These
recover a pose that was lost because of missed or misplaced tags.

Observations wait in a queue and are processed in slices of fixed cost, so that results do not depend on the machine.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np

from factorgraph_loc.fusion import kld
from factorgraph_loc.fusion.cloud import Cloud, Steps, around, corrected, effective_size, systematic
from factorgraph_loc.maps.free_space import FreeSpace
from factorgraph_loc.model.belief import Mode, PosePrior
from factorgraph_loc.sensors.known_position import KnownPosition
from factorgraph_loc.sensors.motion import Motion
from factors import positive, se2
from factors.motion import ChainState
from factors.se2 import Array

DENSITY = 25.0  # initial number of particles per m^2 and rad
# numbers of particles: the minimum at the start of a search, the maximum, and the minimum after a resampling
FEWEST_AT_FIRST, MOST, FEWEST = 10_000, 40_000, 4000
GROWTH = 4  # largest ratio of the numbers of particles after and before one resampling
# Effective fractions of the particles: resampling starts below the first, and a step of a correction keeps at least the second.
RESAMPLE_BELOW, ENOUGH = 0.5, 0.2
FRESH, ELSEWHERE = 2000, 1e-3  # number of additional particles at each resampling, and their total weight
# how many of the FRESH particles are drawn near existing particles, and their standard deviations from these: m, m, rad
ASTRAY, BESIDE = 500, np.array((0.7, 0.7, 0.3))
NOISE = 2.0  # factor on the covariance of odometry, because these particles do not estimate its constants
OUTSIDE = -1.0  # change of the log-weight, at each motion, of a particle outside of free space

# A pose found by a sensor is rejected if particles within REACH standard deviations weigh less than NEGLIGIBLE together.
# WIDENED (standard deviations in m, m, rad) is first added to the covariance of the pose.
NEGLIGIBLE, WIDENED = 1e-4, np.diag((0.1, 0.1, 0.05)) ** 2
REACH = 5.0

# A pose is clear if the robot is within these distances [m, rad] of the pose with enough probability for long enough:
# CLEAR has pairs of a probability and a time [s].
NEAR_POSITION, NEAR_HEADING = 0.5, math.radians(15.0)
CLEAR = ((0.95, 1.0), (0.85, 3.0))
# A clear pose needs at least this many observations with detections, and this many different tags or landmarks.
CLEAR_OBSERVATIONS, CLEAR_THINGS = 3, 2

# Computing costs. The unit is the computing time of one tag for one particle, which is some nanoseconds.
CHUNK = 500_000  # largest cost of one step of a computation
PARTICLE = 25  # cost of weighing one particle, in addition to the cost of the observation
RESAMPLED = 60  # cost per particle of each half of a resampling
BEGUN = 80  # cost of drawing one initial particle, including the preparation of the sensors for the search


class Evidence(Protocol):
    """The part of the interface of an :class:`~factorgraph_loc.sensors.base.Observation` that particles need."""

    @property
    def found(self) -> int: ...
    @property
    def work(self) -> int: ...
    @property
    def things(self) -> frozenset[Hashable]: ...
    def log_likelihood(self, poses: Array, values: Mapping[str, Array]) -> Array: ...


class WeighedObservation(NamedTuple):
    """An observation for particles. ``odometry``: the integrated odometry at its time. ``evidence``: the
    log-probability of the observation if the estimator's present pose is right, zero if the estimator has no pose."""

    odometry: ChainState
    observation: Evidence
    evidence: float


class Population:
    """The particles of a global search for the robot's pose. See the module docstring.

    ``motion``: the odometry. ``bounds`` (2, 2) [m]: the lower and upper corner of the area that contains the robot.
    ``start``: a known start position, or None. ``space``: the free space that contains the robot, or None. ``fewest``:
    the minimum number of particles, at least :data:`ASTRAY`.

    Attributes: ``log_evidence``: the log-probability of all observations if the robot's start pose is unknown.
    ``rival_evidence``: the log-probability of the same observations if the estimator's pose is right. ``newest``: the
    integrated odometry at the last processed observation.
    """

    at_once = False

    def __init__(
        self,
        motion: Motion,
        bounds: Array,
        rng: np.random.Generator,
        start: KnownPosition | None = None,
        space: FreeSpace | None = None,
        fewest: int = FEWEST,
    ) -> None:
        self._motion, self._bounds, self._rng, self._start = motion, bounds, rng, start
        self._space, self._fewest = space, max(fewest, ASTRAY)
        self._cloud: Cloud | None = None
        self._room = np.empty(0)  # the volume per particle, in cells, when each particle was drawn
        self._begun: ChainState | None = None  # the odometry at the last observation that left the queue
        self._hypotheses: tuple[Mode, ...] | None = ()
        self._informative = 0  # number of observations with detections
        self._things: set[Hashable] = set()  # the detected tags and landmarks
        self._since = [math.inf for _ in CLEAR]  # s; the time since which the best mode exceeds each limit of CLEAR
        self._waiting: deque[WeighedObservation] = deque()
        self._running: Steps[None] | None = None
        self.newest: ChainState | None = None  # the odometry at the last observation that was processed
        self.log_evidence = 0.0  # log-probability of all observations if the start pose is unknown
        self.rival_evidence = 0.0

    @property
    def waits(self) -> bool:
        """True if an observation in the queue is not yet processed completely."""
        return self._running is not None or bool(self._waiting)

    @property
    def hypotheses(self) -> Sequence[Mode]:
        """The modes of the particles at the time of the last processed observation, most likely first."""
        if self._hypotheses is None:
            self._hypotheses = self._cloud.modes() if self._cloud is not None else ()
        return self._hypotheses

    @property
    def best(self) -> PosePrior | None:
        """The robot's pose at the time of the last processed observation. None unless the weight of the best mode
        exceeded a limit in :data:`CLEAR` for long enough."""
        at = self.newest
        if at is None or all(at.t < since + lasts for since, (_, lasts) in zip(self._since, CLEAR, strict=True)):
            return None
        mode = self.hypotheses[0]
        return PosePrior(at.t, mode.pose, mode.covariance)

    @property
    def particles(self) -> tuple[Array, Array]:
        """Poses (N, 3) and weights (N,) of the particles at the last processed observation. Both are empty (N = 0)
        before the first one."""
        return (self._cloud.poses, self._cloud.weights) if self._cloud is not None else (np.empty((0, 3)), np.empty(0))

    def add(self, odometry: ChainState, observation: Evidence, evidence: float = 0.0) -> bool:
        """Queue an observation. ``odometry``: the integrated odometry at its time. ``evidence``: the log-probability of
        the observation if the estimator's pose is right. Returns False if the observation is ignored, because it is
        older than the last one in the queue."""
        newest = self._waiting[-1].odometry if self._waiting else self._begun
        if newest is not None and odometry.t < newest.t:
            return False
        self._waiting.append(WeighedObservation(odometry, observation, evidence))
        return True

    def advance(self, work: float = math.inf) -> bool:
        """Process queued observations until their computing cost exceeds ``work``, in units of a few nanoseconds.
        Returns True if at least one observation was processed completely."""
        done = False
        while work > 0.0 and (self._running is not None or self._waiting):
            if self._running is None:
                first = self._waiting.popleft()
                self._begun, self._running = first.odometry, self._processed(first)
            cost = next(self._running, None)
            if cost is None:
                self._running, done = None, True
            else:
                work -= cost
        return done

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Return ``count`` random poses (N, 3) at the time of the last processed observation. They are drawn from the
        particles near :attr:`best` or, if it is None, from all particles. The array is empty before the first
        observation."""
        if self._cloud is None:
            return np.empty((0, 3))
        best, weights = self.best, self._cloud.weights
        rows = systematic(weights if best is None else weights * around(self._cloud.poses, best.pose), rng, count)
        return kld.jittered(self._cloud.poses, rows, rng)

    def denies(self, place: PosePrior) -> bool:
        """Return True if almost no particles are near the pose ``place``. Returns False if there are too few
        observations, or if the time of ``place`` is not that of the last observation."""
        if self._informative < CLEAR_OBSERVATIONS or self.newest is None or place.t != self.newest.t:
            return False
        assert self._cloud is not None
        error = self._cloud.poses - place.pose
        error[:, 2] = se2.wrap(error[:, 2])
        covariance = place.covariance + WIDENED
        near = np.sum(error * positive.solve(covariance, error.T).T, axis=1) < REACH**2
        return float(self._cloud.weights[near].sum()) < NEGLIGIBLE

    def _processed(self, new: WeighedObservation) -> Steps[None]:
        """Return a generator that predicts the particles to the time of the observation ``new`` and weighs them by it.
        It yields the computing cost of each part."""
        odometry, observation = new.odometry, new.observation
        if self._cloud is None or self.newest is None:
            count = int(np.clip(DENSITY * self._volume, FEWEST_AT_FIRST, MOST))
            self._room = self._room_of(count)
            cloud = _cloud(self._draw_anywhere(count, odometry), np.full(count, -math.log(count)))
            yield float(BEGUN * count)
        else:
            cloud = self._cloud
            if odometry.t > self.newest.t:
                cloud = self._predicted(cloud, self.newest, odometry)
        self._cloud, evidence, _ = yield from corrected(
            cloud,
            partial(_likelihood, observation),
            partial(self._resampled, odometry),
            lambda cloud: ENOUGH * effective_size(cloud.log_weights),
            odometry.t,
            below=RESAMPLE_BELOW,
        )
        self.newest, self._hypotheses = odometry, None
        self.log_evidence += evidence
        self.rival_evidence += new.evidence
        self._informative += observation.found > 0
        self._things.update(observation.things)
        near = self._weight_of_best()
        self._since = [
            min(since, odometry.t) if near >= enough else math.inf
            for since, (enough, _) in zip(self._since, CLEAR, strict=True)
        ]

    def _weight_of_best(self) -> float:
        """Return the probability that the robot is near the most likely mode. Returns 0 if there are too few
        observations."""
        if self._informative < CLEAR_OBSERVATIONS or len(self._things) < CLEAR_THINGS or self._cloud is None:
            return 0.0
        error = self._cloud.poses - self.hypotheses[0].pose
        near = (np.hypot(error[:, 0], error[:, 1]) < NEAR_POSITION) & (np.abs(se2.wrap(error[:, 2])) < NEAR_HEADING)
        return float(self._cloud.weights[near].sum())

    def _predicted(self, cloud: Cloud, start: ChainState, end: ChainState) -> Cloud:
        increment = self._motion.relative(start, end)
        root = positive.root(NOISE * increment.covariance)
        noise = self._rng.standard_normal(cloud.poses.shape) @ root.T
        cloud = replace(cloud, poses=se2.compose(se2.compose(cloud.poses, increment.delta), se2.exp(noise)))
        if self._space is None:
            return cloud
        return cloud.weighed(np.where(self._space.cells(cloud.poses[:, :2]) >= 0, 0.0, OUTSIDE), 1.0)[0]

    def _resampled(self, now: ChainState, cloud: Cloud) -> Steps[Cloud]:
        rows = systematic(cloud.weights, self._rng, min(MOST, GROWTH * len(cloud.poses)))
        rows = rows[kld.prefix(cloud.poses[rows], self._rng, self._fewest)]
        yield RESAMPLED * len(cloud.poses)
        room = self._room[rows]
        drawn = kld.jittered(cloud.poses, rows, self._rng, room)
        beside = se2.compose(drawn[:ASTRAY], se2.exp(BESIDE * self._rng.standard_normal((ASTRAY, 3))))
        poses = np.concatenate((drawn, beside, self._draw_anywhere(FRESH - ASTRAY, now)))
        self._room = np.concatenate((room / np.bincount(rows)[rows], np.zeros(ASTRAY), self._room_of(FRESH - ASTRAY)))
        log_weights = np.full(len(poses), math.log((1.0 - ELSEWHERE) / len(rows)))
        log_weights[len(rows) :] = math.log(ELSEWHERE / FRESH)
        yield RESAMPLED * len(poses)
        return _cloud(poses, log_weights)

    @property
    def _volume(self) -> float:
        """The volume of the space of poses [m^2 rad]."""
        area = np.prod(self._bounds[1] - self._bounds[0]) if self._space is None else self._space.area
        return float(area) * 2.0 * math.pi

    def _room_of(self, count: int) -> Array:
        """Return the volume (N,) per particle, in grid cells, if ``count`` particles are drawn from all possible poses.
        It is zero if the start position is known."""
        return np.full(count, self._volume / float(np.prod(kld.CELL)) / count if self._start is None else 0.0)

    def _draw_anywhere(self, count: int, now: ChainState) -> Array:
        """Return ``count`` random poses (count, 3) that do not depend on observations.

        If the start position is known, they are drawn around it and moved by odometry to ``now``. Otherwise they are
        uniform over the free space or, if that is unknown, over the bounds (as a Latin hypercube).
        """
        if self._start is not None:
            return self._start.drawn(self._rng, count, now)
        if self._space is not None:
            return self._space.drawn(self._rng, count)
        layers = np.column_stack([self._rng.permutation(count) for _ in range(3)])
        even = (layers + self._rng.random((count, 3))) / count
        low, high = np.append(self._bounds[0], -math.pi), np.append(self._bounds[1], math.pi)
        return np.asarray(low + even * (high - low))


def _cloud(poses: Array, log_weights: Array) -> Cloud:
    """Return particles with poses (N, 3) and log-weights (N,), without constants, and with possibly several modes."""
    return Cloud(poses, np.zeros((len(poses), 0)), log_weights, localized=False)


def _likelihood(observation: Evidence, cloud: Cloud) -> Steps[Array]:
    """Return a generator that computes the log-likelihood (N,) of an observation at the particles of ``cloud``. It
    yields the computing cost of each part, about the same for all parts."""
    each = PARTICLE + observation.work
    count = max(1, CHUNK // each)
    parts = []
    for first in range(0, len(cloud.poses), count):
        part = cloud.poses[first : first + count]
        parts.append(observation.log_likelihood(part, {}))
        yield float(each * len(part))
    return np.concatenate(parts)
