"""The interface for the expected information of a sensor along a planned path."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from factors.se2 import Array

Array32 = NDArray[np.float32]
Places = NDArray[np.int64]


class Forecast(Protocol):
    """The forecast of one sensor in a world whose map is exact. ``goals`` (K, 2) [m]: positions near which it is most
    informative; empty for a sensor with long range."""

    goals: Array

    def information(self, poses: Array, ways: Array) -> Array:
        """Expected Fisher information (N, 3, 3) on the body-frame perturbation of poses (N, 3). ``ways`` (N,) [m]: distance
        travelled at each pose; turns count by their duration."""

    def add_log_weights(self, poses: Array, metres: float, stops: Places, seed: np.uint64, out: Array32) -> None:
        """Add the log-likelihoods (M,) of measurements that the first J particles might make on a path to ``out`` (J, M).

        ``poses`` (S, M, 3): where particles measure; ``metres``: length of the path, with turns by their duration; ``stops``
        (M,): number of measurements of each particle. Random draws are the same for all paths with one ``seed``.
        """
