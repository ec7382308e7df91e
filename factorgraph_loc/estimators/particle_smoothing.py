"""The final trajectory of a particle filter, by backward simulation.

Trajectories are drawn backwards through the clouds that were kept (Godsill, Doucet, West, JASA 99(465), 2004). Where no particle
explains a later pose the filter was set elsewhere in between: if it was lost, the later pose is carried back by odometry,
else the trajectory goes on from the filter's own cloud.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_loc.estimators.ancestors import draw_ancestors
from factorgraph_loc.estimators.cloud import Cloud, pose_moments, systematic
from factors import se2
from factors.odometry import ChainState, Increment
from factors.se2 import Array

BREAK = 100.0  # squared Mahalanobis distance from a pose to its ancestor: ten standard deviations


@dataclass(frozen=True)
class Record:
    """A stamp of the run: the odometry there, the causal estimate, and the cloud where it is kept for smoothing."""

    t: float
    odometry: ChainState
    mean: Array
    covariance: Array
    cloud: Cloud | None


class BackwardSimulation:
    """``count`` trajectories through the clouds at the records ``kept``.

    ``increment(start, end)``: the motion between two records; ``moved(cloud, increment)``: poses (N, 3) after it, without noise.
    """

    def __init__(
        self,
        kept: Sequence[Record],
        increment: Callable[[Record, Record], Increment],
        moved: Callable[[Cloud, Increment], Array],
        rng: np.random.Generator,
        count: int,
    ) -> None:
        self._kept, self._increment, self._moved = kept, increment, moved
        self._t = np.array([r.t for r in kept])
        self._drawn = self._draw(rng, count)

    def at(self, record: Record) -> tuple[Array, Array]:
        """Mean (3,) and covariance (3, 3) in the world's frame of the trajectories at a record between two kept ones."""
        k = int(np.searchsorted(self._t, record.t, side="right")) - 1
        since = self._increment(self._kept[k], record)
        poses = se2.compose(self._drawn[k], since.delta)
        extra = np.zeros((3, 3))
        if k + 1 < len(self._kept) and since.duration > 0.0:
            whole = self._increment(self._kept[k], self._kept[k + 1])
            share = since.duration / whole.duration
            missed = se2.log(se2.between(se2.compose(self._drawn[k], whole.delta), self._drawn[k + 1]))
            missed[_squared(missed, whole) > BREAK] = 0.0
            poses = se2.compose(poses, se2.exp(share * missed))
            extra = share * (1.0 - share) * whole.covariance
        mean, covariance = pose_moments(poses, np.full(len(poses), 1.0 / len(poses)))
        return mean, covariance + se2.body_to_world(mean, extra)

    def _draw(self, rng: np.random.Generator, count: int) -> Array:
        """Trajectories (K, M, 3), drawn from the last cloud to the first."""
        clouds = [r.cloud for r in self._kept if r.cloud is not None]
        out = np.empty((len(clouds), count, 3))
        out[-1] = clouds[-1].poses[systematic(clouds[-1].weights, rng, count)]
        for k in range(len(clouds) - 2, -1, -1):
            increment = self._increment(self._kept[k], self._kept[k + 1])
            predicted = self._moved(clouds[k], increment)
            rows = draw_ancestors(predicted, clouds[k].log_weights, out[k + 1], increment.covariance, rng.random(count))
            out[k] = clouds[k].poses[rows]
            jumped = _squared(se2.log(se2.between(predicted[rows], out[k + 1])), increment) > BREAK
            if jumped.any() and clouds[k].localized:
                out[k, jumped] = clouds[k].poses[systematic(clouds[k].weights, rng, int(jumped.sum()))]
            elif jumped.any():
                out[k, jumped] = se2.compose(out[k + 1, jumped], se2.inverse(increment.delta))
        return out


def _squared(error: Array, increment: Increment) -> Array:
    """Squared Mahalanobis distances (M,) of body-frame errors (M, 3) after an increment."""
    return np.asarray(np.sum(error * np.linalg.solve(increment.covariance, error.T).T, axis=1))
