"""Poses between those of a row, along the odometry: compiled, as a run has ten of them a second."""

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled
from factors.odometry.kernels import carried
from factors.se2 import Array, Integers
from factors.se2_kernels import composed, exp, log, related
from factors.small_kernels import put


@compiled
def between(
    before: Integers,
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
    """T poses (T, 3) and body-frame covariances (T, 3, 3), each after the one with the number ``before`` (T,) of M ``poses`` (M, 3)
    with ``covariances`` (M, 3, 3).

    ``deltas`` (T, 3), ``noises`` (T, 3, 3) and ``durations`` (T,) [s]: of the motion from there; ``steps`` (M-1, 3) and so on: of
    that from each pose to the next. What the odometry then misses the next pose by is spread in proportion to time. The covariance
    goes linearly from one to the other, plus that of a bridge pinned at both ends. ``elsewhere`` (M-1,): whether the robot was
    carried to the next pose, which tells nothing of those before.
    """
    count = len(before)
    at, spreads = np.empty((count, 3)), np.empty((count, 3, 3))
    for i in range(count):
        k = before[i]
        x, y, heading = composed(poses[k, 0], poses[k, 1], poses[k, 2], deltas[i, 0], deltas[i, 1], deltas[i, 2])
        if k < len(steps) and not elsewhere[k]:
            share = durations[i] / step_durations[k]
            a, b, c = composed(poses[k, 0], poses[k, 1], poses[k, 2], steps[k, 0], steps[k, 1], steps[k, 2])
            a, b, c = related(a, b, c, poses[k + 1, 0], poses[k + 1, 1], poses[k + 1, 2])
            a, b, c = log(a, b, c)
            a, b, c = exp(share * a, share * b, share * c)
            x, y, heading = composed(x, y, heading, a, b, c)
            for m in range(3):
                for n in range(3):
                    ends = (1.0 - share) * covariances[k, m, n] + share * covariances[k + 1, m, n]
                    spreads[i, m, n] = ends + share * (1.0 - share) * step_noises[k, m, n]
        else:
            put(carried(covariances[k], deltas[i], noises[i]), spreads[i])
        at[i, 0], at[i, 1], at[i, 2] = x, y, heading
    return at, spreads
