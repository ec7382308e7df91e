"""The final trajectory of a particle filter, by backward simulation.

A cloud is the set of weighted particles at one time. Trajectories are drawn backwards through the stored clouds
(Godsill, Doucet, West, JASA 99(465), 2004): for each state of a trajectory, an ancestor is drawn among the particles of
the previous cloud. A resting robot and constants have almost no noise between two clouds. Each state would then have
one possible ancestor, and the trajectories would soon coalesce. Therefore each particle stands for a Gaussian kernel
(Musso, Oudjane, Le Gland, in "Sequential Monte Carlo Methods in Practice", 2001, section 12.2). The state is drawn from
the kernel of the ancestor, given the later state, by one step of Rauch, Tung and Striebel.

The ancestors are drawn in compiled code, because NumPy takes ten times as long.

If no particle explains a later state, the filter jumped to another pose in between. If the earlier cloud was wrong, the
later pose is moved back by odometry. Otherwise the trajectory continues with a particle of the earlier cloud.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from factorgraph_loc.fusion.cloud import Cloud, pose_moments, systematic
from factorgraph_loc.fusion.tracking import Change
from factors import positive, se2
from factors.compiled import compiled
from factors.motion import ChainState, Increment
from factors.se2 import Array, Integers

BREAK = 100.0  # squared Mahalanobis distance of a particle from a possible ancestor, above which it is not the ancestor


@dataclass(frozen=True)
class Record:
    """The state of a particle filter at time ``t`` [s].

    ``odometry``: the integrated odometry. ``mean`` (3,), ``covariance`` (3, 3): the estimate at that time, in the world
    frame. ``cloud``: the particles if they are stored for smoothing, otherwise None.
    """

    t: float
    odometry: ChainState
    mean: Array
    covariance: Array
    cloud: Cloud | None

    def lost(self) -> Record:
        """Return the record with ``cloud.localized`` set to False, for particles at a wrong pose."""
        return self if self.cloud is None else replace(self, cloud=replace(self.cloud, localized=False))


class BackwardSimulation:
    """Trajectories drawn backwards through the stored particles of a particle filter, for smoothing.

    ``kept``: records with particles, in order of time. ``count``: the number of trajectories. ``increment(start,
    end)``: returns the odometry between two records. ``moved(cloud, increment)``: moves particles without noise. It
    returns their poses (N, 3), and the transition matrix (3, 3+P) from body-frame perturbation and constants.
    ``changes``: the intervals (start, end) [s] when the robot was carried to another place.
    """

    def __init__(
        self,
        kept: Sequence[Record],
        increment: Callable[[Record, Record], Increment],
        moved: Callable[[Cloud, Increment], tuple[Array, Array]],
        rng: np.random.Generator,
        count: int,
        changes: Sequence[Change] = (),
    ) -> None:
        self._kept, self._increment, self._moved, self._rng = kept, increment, moved, rng
        self._changes = changes
        self._t = np.array([r.t for r in kept])
        clouds = [r.cloud for r in kept if r.cloud is not None]
        cloud, kernel = clouds[-1].density()
        self._drawn = [cloud.drawn(systematic(cloud.weights, rng, count), kernel, rng)]
        # for each pair of consecutive clouds, the difference between each trajectory's motion and the odometry
        self._missed: list[Array] = []
        for k in range(len(clouds) - 2, -1, -1):
            drawn, missed = self._step(clouds[k], increment(kept[k], kept[k + 1]), self._drawn[0])
            self._drawn.insert(0, drawn)
            self._missed.insert(0, missed)

    def at(self, record: Record) -> tuple[Array, Array]:
        """Return the mean (3,) and covariance (3, 3) of the trajectories at the time of any record, in the world frame.
        Between stored particles the trajectories are interpolated along the odometry."""
        k = int(np.searchsorted(self._t, record.t, side="right")) - 1
        if any(self._t[k] < end <= record.t for _, end in self._changes):
            # the robot was carried since the earlier cloud: move the later cloud back by odometry
            later, step = self._drawn[k + 1], self._increment(record, self._kept[k + 1])
            return _moments(se2.compose(later.poses, se2.inverse(step.delta)), step.covariance)
        since = self._increment(self._kept[k], record)
        poses, _ = self._moved(self._drawn[k], since)
        extra = np.zeros((3, 3))
        if k + 1 < len(self._kept) and since.duration > 0.0:
            whole = self._increment(self._kept[k], self._kept[k + 1])
            share = since.duration / whole.duration
            poses = se2.compose(poses, se2.exp(share * self._missed[k]))
            extra = share * (1.0 - share) * whole.covariance
        return _moments(poses, extra)

    def _step(self, cloud: Cloud, increment: Increment, later: Cloud) -> tuple[Cloud, Array]:
        """Return one particle for each of the M later particles ``later``: its previous state, drawn at
        random from ``cloud``. Also return the differences (M, 3) between the motions in between and the odometry.
        ``increment``: the odometry from ``cloud`` to ``later``."""
        smooth, kernel = cloud.density()
        # without constants that were added later
        later = replace(later, constants=later.constants[:, : cloud.constants.shape[1]])
        predicted, by_state = self._moved(smooth, increment)
        transition = np.eye(len(kernel))
        transition[:3] = by_state
        carried = transition @ kernel
        covariance = carried @ transition.T
        covariance[:3, :3] += increment.covariance
        rows = draw_ancestors(
            predicted,
            smooth.constants,
            smooth.log_weights,
            later.poses,
            later.constants,
            covariance,
            self._rng.random(len(later.poses)),
        )
        error = np.concatenate(
            (se2.log(se2.between(predicted[rows], later.poses)), later.constants - smooth.constants[rows]), axis=1
        )
        gain = positive.solve(covariance, carried).T
        step = error @ gain.T + positive.draws(kernel - gain @ carried, len(rows), self._rng)
        constants = smooth.constants[rows] + step[:, 3:]
        poses = se2.compose(smooth.poses[rows], se2.exp(step[:, :3]))
        jumped = np.sum(error[:, :3] * positive.solve(covariance[:3, :3], error[:, :3].T).T, axis=1) > BREAK
        if jumped.any() and cloud.localized:
            poses[jumped] = cloud.poses[systematic(cloud.weights, self._rng, int(jumped.sum()))]
        elif jumped.any():
            noise = positive.draws(increment.covariance, int(jumped.sum()), self._rng)
            poses[jumped] = se2.compose(later.poses[jumped], se2.inverse(se2.compose(increment.delta, se2.exp(noise))))
        drawn = replace(later, poses=poses, constants=constants)
        missed = se2.log(se2.between(self._moved(drawn, increment)[0], later.poses))
        if cloud.localized:
            missed[jumped] = 0.0
        return drawn, missed


def _moments(poses: Array, extra: Array) -> tuple[Array, Array]:
    """Return the mean (3,) and covariance (3, 3), in the world frame, of poses (N, 3). ``extra`` (3, 3): a body-frame
    covariance of each pose, which is added."""
    mean, covariance = pose_moments(poses, np.full(len(poses), 1.0 / len(poses)))
    return mean, covariance + se2.body_to_world(mean, extra)


def draw_ancestors(
    predicted: Array,
    constants: Array,
    log_weights: Array,
    later: Array,
    later_constants: Array,
    covariance: Array,
    uniform: Array,
) -> Integers:
    """Return the index (M,) of a random ancestor among N particles for each of M later states. Its probability is
    proportional to its weight times the transition density to the later state (Godsill et al., 2004, eq. 7).

    ``predicted`` (N, 3): the particles' poses after the motion, without noise. ``constants`` (N, P): the particles'
    sensor constants. ``log_weights`` (N,): their log-weights. ``later`` (M, 3), ``later_constants`` (M, P): poses and
    constants of the later states. ``covariance`` (3+P, 3+P): the covariance of the transition, of the body-frame pose
    error and of the constants. ``uniform`` (M,): random numbers from [0, 1).
    """
    size = constants.shape[1]
    # constants first, so that their part of the whitened states can be computed before the loop over all pairs
    order = [*range(3, 3 + size), 0, 1, 2]
    whitener = np.linalg.inv(positive.root(covariance[np.ix_(order, order)]))
    by_constants = np.ascontiguousarray(whitener[:, :size].T)
    return np.asarray(
        _draw(
            predicted,
            np.ascontiguousarray((constants @ by_constants).T),
            log_weights,
            later,
            np.ascontiguousarray((later_constants @ by_constants).T),
            np.ascontiguousarray(whitener[size:, size:]),
            uniform,
        )
    )


@compiled
def _draw(
    predicted: Array,
    whitened: Array,
    log_weights: Array,
    later: Array,
    whitened_later: Array,
    whitener: Array,
    uniform: Array,
) -> Integers:
    """Return the result of :func:`draw_ancestors`, by a compiled loop. ``whitened`` (P+3, N), ``whitened_later`` (P+3,
    M): the part of the whitened states, of particles and later states, that depends on the constants. ``whitener``
    (3, 3): whitens the pose's error given the constants."""
    count = len(predicted)
    size = len(whitened) - 3
    cosine, sine = np.empty(count), np.empty(count)
    for i in range(count):
        cosine[i], sine[i] = math.cos(predicted[i, 2]), math.sin(predicted[i, 2])
    density = np.empty(count)
    rows = np.empty(len(later), np.int64)
    for j in range(len(later)):
        # separate loops for each term, so that the compiler can vectorise them
        for i in range(count):
            dx, dy = later[j, 0] - predicted[i, 0], later[j, 1] - predicted[i, 1]
            along, lateral = cosine[i] * dx + sine[i] * dy, cosine[i] * dy - sine[i] * dx
            turn = later[j, 2] - predicted[i, 2]
            turn -= 2.0 * np.pi * np.floor((turn + np.pi) * (0.5 / np.pi))
            e0 = whitener[0, 0] * along + (whitened_later[size, j] - whitened[size, i])
            e1 = (
                whitener[1, 0] * along
                + whitener[1, 1] * lateral
                + (whitened_later[size + 1, j] - whitened[size + 1, i])
            )
            e2 = whitener[2, 0] * along + whitener[2, 1] * lateral + whitener[2, 2] * turn
            e2 += whitened_later[size + 2, j] - whitened[size + 2, i]
            density[i] = log_weights[i] - 0.5 * (e0 * e0 + e1 * e1 + e2 * e2)
        for p in range(size):
            for i in range(count):
                e0 = whitened_later[p, j] - whitened[p, i]
                density[i] -= 0.5 * e0 * e0
        highest = -np.inf
        for i in range(count):
            highest = max(highest, density[i])
        if not highest > -np.inf:  # the transition density is zero for all particles: use the weights alone
            for i in range(count):
                density[i] = log_weights[i]
                highest = max(highest, density[i])
        total = 0.0
        for i in range(count):
            # a density far below the highest is practically never drawn, and exp takes most of the time
            density[i] = np.exp(density[i] - highest) if density[i] > highest - 20.0 else 0.0
            total += density[i]
        threshold = uniform[j] * total
        reached = 0.0
        rows[j] = count - 1
        for i in range(count):
            reached += density[i]
            if reached > threshold:
                rows[j] = i
                break
    return rows
