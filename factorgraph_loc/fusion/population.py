"""Where the robot may be, from what all sensors see, as particles that begin anywhere.

A particle filter over pose: evenly over the map's bounds at first, or with any heading where the start's position
is known. Each observation is weighed a share at a time, with resampling from a kernel density in between (progressive correction:
Musso, Oudjane, Le Gland, in "Sequential Monte Carlo Methods in Practice", 2001, section 12.4), so that few particles find
narrow places; in a large map the kernels are as wide as the first particles are far apart. Their number follows the size of the
places that are left (KLD sampling: Fox, IJRR 22(12), 2003, eq. 7). At each resampling some are drawn anywhere once more, and some
beside others, with hardly any weight: they bring back a place that was given up for tags that were silent or misplaced.

All this is done in slices, whose size is counted in work and not in seconds: what was seen waits until it is its turn, and
until then the population stands where it was. So a search over a large hall goes on beside whatever else is to be done.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Hashable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from factorgraph_loc.fusion import kld
from factorgraph_loc.fusion.cloud import Cloud, Steps, corrected, effective_size, systematic
from factorgraph_loc.model.belief import Mode, PosePrior
from factorgraph_loc.sensors.base import Observation
from factorgraph_loc.sensors.known_position import KnownPosition
from factorgraph_loc.sensors.motion import Motion
from factors import positive, se2
from factors.motion import ChainState
from factors.se2 import Array

DENSITY = 25.0  # particles per m^2 and rad at first
FEWEST_AT_FIRST, MOST, FEWEST = 10_000, 40_000, 4000
GROWTH = 4  # times as many particles, at most, after a resampling
RESAMPLE_BELOW, ENOUGH = 0.5, 0.2  # effective size, as a share: when to resample; what a share of a likelihood leaves
FRESH, ELSEWHERE = 2000, 1e-3  # particles that are drawn anew at a resampling, and their weight together
ASTRAY, BESIDE = 500, np.array((0.7, 0.7, 0.3))  # of those, how many beside others, and how far: m, m, rad
# Variance of the odometry, times this: the constants of the odometry, which are not estimated here, err as well.
NOISE = 2.0

NEGLIGIBLE, WIDENED = 1e-4, np.diag((0.1, 0.1, 0.05)) ** 2  # weight of a place that is denied; m, m, rad

# A place is clear once the robot has been within so much of it, m and rad, with one of these probabilities for its time, s.
NEAR_POSITION, NEAR_HEADING = 0.5, math.radians(15.0)
CLEAR = ((0.95, 1.0), (0.85, 3.0))
CLEAR_OBSERVATIONS, CLEAR_THINGS = 3, 2  # of something, and of different things
REACH = 5.0  # standard deviations, within which weight counts for a place that is denied

# Work: of one tag that one particle looks at it is 1, some nanoseconds.
CHUNK = 500_000  # of what is done at once
PARTICLE = 25  # of a particle that is weighed, besides what it looks at
RESAMPLED = 60  # of a particle in each half of a resampling
BEGUN = 80  # of a particle at first, with what the sensors make for the search


class _Waiting(NamedTuple):
    """An observation that waits, and the log of its probability under a track that the population competes with."""

    odometry: ChainState
    observation: Observation
    rival: float


class Population:
    """Places where the robot may be; see the module. ``bounds`` (2, 2): lower and upper corner [m] of where it may be, unless
    ``start`` tells that."""

    def __init__(
        self,
        motion: Motion,
        bounds: Array,
        rng: np.random.Generator,
        start: KnownPosition | None = None,
    ) -> None:
        self._motion, self._bounds, self._rng, self._start = motion, bounds, rng, start
        self._cloud: Cloud | None = None
        self._room = np.empty(0)  # of each particle for itself, in cells, when it was drawn
        self._odometry: ChainState | None = None
        self._begun: ChainState | None = None  # at the last observation whose turn has come
        self._hypotheses: tuple[Mode, ...] | None = ()
        self._log_evidence = 0.0
        self._telling = 0  # observations of things that were there
        self._things: set[Hashable] = set()
        self._since = [math.inf for _ in CLEAR]  # when the place had these probabilities first
        self._waiting: deque[_Waiting] = deque()
        self._running: Steps[None] | None = None
        self._rival = 0.0

    @property
    def odometry(self) -> ChainState | None:
        """The odometry at the last observation that was taken."""
        return self._odometry

    @property
    def waits(self) -> bool:
        """Whether something was added that has not been taken to its end."""
        return self._running is not None or bool(self._waiting)

    @property
    def rival_evidence(self) -> float:
        """Log-probability of all observations so far under the track that the population competes with."""
        return self._rival

    @property
    def hypotheses(self) -> tuple[Mode, ...]:
        """Those at the time of the last observation, the likeliest first."""
        if self._hypotheses is None:
            self._hypotheses = self._cloud.modes() if self._cloud is not None else ()
        return self._hypotheses

    @property
    def best(self) -> PosePrior | None:
        """The pose at the last observation if one hypothesis is clear, else None."""
        at = self._odometry
        if at is None or all(at.t < since + lasts for since, (_, lasts) in zip(self._since, CLEAR, strict=True)):
            return None
        mode = self.hypotheses[0]
        return PosePrior(at.t, mode.pose, mode.covariance)

    @property
    def log_evidence(self) -> float:
        """Log-probability of all observations so far for a robot that began anywhere."""
        return self._log_evidence

    def add(self, odometry: ChainState, observation: Observation, rival: float = 0.0) -> bool:
        """Have an observation wait that was made when the odometry was at ``odometry``; False if it is left out, as it is older
        than the last. ``rival``: the log of its probability under a track."""
        newest = self._waiting[-1].odometry if self._waiting else self._begun
        if newest is not None and odometry.t < newest.t:
            return False
        self._waiting.append(_Waiting(odometry, observation, rival))
        return True

    def advance(self, work: float = math.inf) -> bool:
        """Take what waits, until that was so much ``work``; whether one observation at least was taken to its end."""
        done = False
        while work > 0.0 and (self._running is not None or self._waiting):
            if self._running is None:
                first = self._waiting.popleft()
                self._begun, self._running = first.odometry, self._taken(first)
            cost = next(self._running, None)
            if cost is None:
                self._running, done = None, True
            else:
                work -= cost
        return done

    def _taken(self, new: _Waiting) -> Steps[None]:
        """Take an observation, telling the work of each part of it."""
        odometry, observation = new.odometry, new.observation
        if self._cloud is None or self._odometry is None:
            count = int(np.clip(DENSITY * self._everywhere, FEWEST_AT_FIRST, MOST))
            self._room = self._room_of(count)
            cloud = _cloud(self._anywhere(count, odometry), np.full(count, -math.log(count)))
            yield float(BEGUN * count)
        else:
            cloud = self._cloud
            if odometry.t > self._odometry.t:
                cloud = self._predicted(cloud, self._odometry, odometry)
        cloud, evidence, _ = yield from corrected(
            cloud,
            partial(_likelihood, observation),
            partial(self._resampled, odometry),
            lambda cloud: ENOUGH * effective_size(cloud.log_weights),
            odometry.t,
            below=RESAMPLE_BELOW,
        )
        self._cloud, self._odometry = cloud, odometry
        self._log_evidence += evidence
        self._rival += new.rival
        self._hypotheses = None
        self._telling += observation.found > 0
        self._things.update(observation.things)
        near = self._weight_of_best()
        self._since = [
            min(since, odometry.t) if near >= enough else math.inf
            for since, (enough, _) in zip(self._since, CLEAR, strict=True)
        ]

    @property
    def particles(self) -> tuple[Array, Array]:
        """Poses (N, 3) at the last observation and their weights (N,), of all hypotheses; none before the first observation."""
        return (self._cloud.poses, self._cloud.weights) if self._cloud is not None else (np.empty((0, 3)), np.empty(0))

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Poses (N, 3) at the last observation, drawn from all hypotheses, or the one that is clear; none before the first
        observation."""
        if self._cloud is None:
            return np.empty((0, 3))
        best, weights = self.best, self._cloud.weights
        rows = systematic(weights if best is None else weights * self._cloud.around(best.pose), rng, count)
        return kld.jittered(self._cloud.poses, rows, rng)

    def _weight_of_best(self) -> float:
        """The probability that the robot is near the likeliest hypothesis; 0 while too little was seen."""
        if self._telling < CLEAR_OBSERVATIONS or len(self._things) < CLEAR_THINGS or self._cloud is None:
            return 0.0
        error = self._cloud.poses - self.hypotheses[0].pose
        near = (np.hypot(error[:, 0], error[:, 1]) < NEAR_POSITION) & (np.abs(se2.wrap(error[:, 2])) < NEAR_HEADING)
        return float(self._cloud.weights[near].sum())

    def denies(self, place: PosePrior) -> bool:
        """Whether enough was seen to say that the robot is not at a place, at the time of the last observation."""
        if self._telling < CLEAR_OBSERVATIONS or self._odometry is None or place.t != self._odometry.t:
            return False
        return self._weight_near(place.pose, place.covariance + WIDENED) < NEGLIGIBLE

    def _weight_near(self, pose: Array, covariance: Array) -> float:
        assert self._cloud is not None
        error = self._cloud.poses - pose
        error[:, 2] = se2.wrap(error[:, 2])
        near = np.sum(error * positive.solve(covariance, error.T).T, axis=1) < REACH**2
        return float(self._cloud.weights[near].sum())

    def _predicted(self, cloud: Cloud, start: ChainState, end: ChainState) -> Cloud:
        increment = self._motion.relative(start, end)
        root = positive.root(NOISE * increment.covariance)
        noise = self._rng.standard_normal(cloud.poses.shape) @ root.T
        return replace(cloud, poses=se2.compose(se2.compose(cloud.poses, increment.delta), se2.exp(noise)))

    def _resampled(self, now: ChainState, cloud: Cloud) -> Steps[Cloud]:
        rows = systematic(cloud.weights, self._rng, min(MOST, GROWTH * len(cloud.poses)))
        rows = rows[kld.prefix(cloud.poses[rows], self._rng, FEWEST)]
        yield RESAMPLED * len(cloud.poses)
        room = self._room[rows]
        drawn = kld.jittered(cloud.poses, rows, self._rng, room)
        beside = se2.compose(drawn[:ASTRAY], se2.exp(BESIDE * self._rng.standard_normal((ASTRAY, 3))))
        poses = np.concatenate((drawn, beside, self._anywhere(FRESH - ASTRAY, now)))
        self._room = np.concatenate((room / np.bincount(rows)[rows], np.zeros(ASTRAY), self._room_of(FRESH - ASTRAY)))
        log_weights = np.full(len(poses), math.log((1.0 - ELSEWHERE) / len(rows)))
        log_weights[len(rows) :] = math.log(ELSEWHERE / FRESH)
        yield RESAMPLED * len(poses)
        return _cloud(poses, log_weights)

    @property
    def _everywhere(self) -> float:
        """How large the space of poses is [m^2 rad]."""
        return float(np.prod(self._bounds[1] - self._bounds[0])) * 2.0 * math.pi

    def _room_of(self, count: int) -> Array:
        """What room (N,) each of so many particles has that are drawn anywhere; none in the small place of a start."""
        return np.full(count, self._everywhere / float(np.prod(kld.CELL)) / count if self._start is None else 0.0)

    def _anywhere(self, count: int, now: ChainState) -> Array:
        """Poses (N, 3) where the robot may have come to by ``now``, as far as its start tells it: else evenly over the bounds and
        all headings, one in each layer of each axis (Latin hypercube)."""
        if self._start is not None:
            return self._start.drawn(self._rng, count, now)
        layers = np.column_stack([self._rng.permutation(count) for _ in range(3)])
        even = (layers + self._rng.random((count, 3))) / count
        low, high = np.append(self._bounds[0], -math.pi), np.append(self._bounds[1], math.pi)
        return np.asarray(low + even * (high - low))


def _cloud(poses: Array, log_weights: Array) -> Cloud:
    return Cloud(poses, np.zeros((len(poses), 0)), log_weights, localized=False)


def _likelihood(observation: Observation, cloud: Cloud) -> Steps[Array]:
    """The log-likelihood (N,) of the particles, some of them at a time."""
    each = PARTICLE + observation.work
    count = max(1, CHUNK // each)
    parts = []
    for first in range(0, len(cloud.poses), count):
        part = cloud.poses[first : first + count]
        parts.append(observation.log_likelihood(part, {}))
        yield float(each * len(part))
    return np.concatenate(parts)
