"""Motion increments, the propagation of covariances, and poses between those of a row."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled
from factors.gaussian import put
from factors.odometry.kernels import carried
from factors.se2 import Array, Integers, between_scalars, compose_scalars, exp_scalars, log_scalars


@dataclass(frozen=True, slots=True)
class Increment:
    """Relative motion between two times.

    ``delta`` (3,): pose of the end in the frame of the start. ``covariance`` (3, 3): of the body-frame perturbation at the end.
    ``duration`` [s], and ``still`` [s], the part of it at rest.
    """

    delta: Array
    covariance: Array
    duration: float
    still: float = 0.0

    @property
    def moving(self) -> float:
        """Time [s] in motion."""
        return self.duration - self.still


class ChainState(NamedTuple):
    """State of the integrated odometry: pose in its own frame, path length [m], accumulated rotation [rad], time without odometry
    [s], time at rest [s]."""

    t: float
    x: float
    y: float
    heading: float
    path: float
    turn: float
    unknown: float
    still: float = 0.0


def propagate(covariance: Array, increment: Increment) -> Array:
    """A body-frame covariance (3, 3) propagated along an increment."""
    return np.asarray(carried(covariance, increment.delta, increment.covariance))


@compiled
def poses_between(
    previous: Integers,
    deltas: Array,
    noises: Array,
    durations: Array,
    steps: Array,
    step_noises: Array,
    step_durations: Array,
    elsewhere: NDArray[np.bool_],
    poses: Array,
    covariances: Array,
) -> tuple[Array, Array]:
    """T poses (T, 3) and body-frame covariances (T, 3, 3), each after the pose number ``previous`` (T,) of M ``poses``
    (M, 3) with ``covariances`` (M, 3, 3).

    ``deltas`` (T, 3), ``noises`` (T, 3, 3) and ``durations`` (T,) [s]: of the motion from there; ``steps`` (M-1, 3) and so on: of
    that from each pose to the next. The misclosure of the odometry at the next pose is distributed in proportion to time. The
    covariance is interpolated linearly, plus that of a bridge pinned at both ends. ``elsewhere`` (M-1,): whether the robot was
    carried to the next pose, which then does not inform the poses in between.
    """
    count = len(previous)
    at, out = np.empty((count, 3)), np.empty((count, 3, 3))
    for i in range(count):
        k = previous[i]
        x, y, heading = compose_scalars(poses[k, 0], poses[k, 1], poses[k, 2], deltas[i, 0], deltas[i, 1], deltas[i, 2])
        if k < len(steps) and not elsewhere[k]:
            share = durations[i] / step_durations[k]
            a, b, c = compose_scalars(poses[k, 0], poses[k, 1], poses[k, 2], steps[k, 0], steps[k, 1], steps[k, 2])
            a, b, c = between_scalars(a, b, c, poses[k + 1, 0], poses[k + 1, 1], poses[k + 1, 2])
            a, b, c = log_scalars(a, b, c)
            a, b, c = exp_scalars(share * a, share * b, share * c)
            x, y, heading = compose_scalars(x, y, heading, a, b, c)
            for m in range(3):
                for n in range(3):
                    ends = (1.0 - share) * covariances[k, m, n] + share * covariances[k + 1, m, n]
                    out[i, m, n] = ends + share * (1.0 - share) * step_noises[k, m, n]
        else:
            put(carried(covariances[k], deltas[i], noises[i]), out[i])
        at[i, 0], at[i, 1], at[i, 2] = x, y, heading
    return at, out
