"""Motion increments of the robot, the propagation of covariances along them, and the interpolation of poses along odometry."""

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
    """The relative motion of the robot between two times.

    ``delta`` (3,): the pose at the end in the frame of the pose at the start. ``covariance`` (3, 3): the covariance of
    ``delta`` in the frame of the end. ``duration`` [s]: end minus start. ``still`` [s]: the time at rest.
    """

    delta: Array
    covariance: Array
    duration: float
    still: float = 0.0

    @property
    def moving(self) -> float:
        """The part of the duration [s] during which the robot moved."""
        return self.duration - self.still


class ChainState(NamedTuple):
    """The state of the integrated odometry at time ``t`` [s].

    ``x``, ``y``, ``heading``: the pose in the odometry's own frame [m, m, rad].
    ``path``: the length of the path so far [m]. ``turn``: the sum of absolute rotations so far [rad].
    ``unknown``: the time so far without valid odometry [s]. ``still``: the time so far at rest [s].
    """

    t: float
    x: float
    y: float
    heading: float
    path: float
    turn: float
    unknown: float
    still: float = 0.0


def propagate(covariance: Array, increment: Increment) -> Array:
    """Return the body-frame covariance (3, 3) of a pose after a motion ``increment``, from the ``covariance``
    before."""
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
    """Interpolate M estimated poses to T times by odometry. Returns poses (T, 3) and body-frame covariances (T, 3, 3).

    ``previous`` (T,): the index of the last estimated pose before each of the T times.
    ``deltas`` (T, 3), ``noises`` (T, 3, 3), ``durations`` (T,) [s]: the odometry's motion from that pose to the time,
    its body-frame covariance, and its duration.
    ``steps`` (M-1, 3), ``step_noises`` (M-1, 3, 3), ``step_durations`` (M-1,) [s]: the same from each estimated pose to
    the next estimated pose.
    ``elsewhere`` (M-1,): True if a person carried the robot to the next pose. Only the previous pose is used then.
    ``poses`` (M, 3), ``covariances`` (M, 3, 3): the estimated poses and their body-frame covariances.

    The error of the odometry between two estimated poses is distributed in proportion to time.
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
