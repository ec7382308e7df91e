"""What a sensor is expected to tell on a way that a robot may drive."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from factors.se2 import Array

Array32 = NDArray[np.float32]
Places = NDArray[np.int64]


class Forecast(Protocol):
    """Of one sensor, in a world whose map is taken as exact. ``goals`` (K, 2) [m]: places near which it tells most; none of one
    that sees far."""

    goals: Array

    def information(self, poses: Array, ways: Array) -> Array:
        """Fisher's information (N, 3, 3) that is expected on the body-frame perturbation of poses (N, 3), of ``ways`` (N,) metres
        that are driven about each, or of turns that take as long."""

    def add_log_weights(self, poses: Array, metres: float, stops: Places, seed: np.uint64, out: Array32) -> None:
        """Add to ``out`` (J, M) what the measurements that the first J particles might make on one path tell of each of M.

        ``poses`` (S, M, 3): where they look; ``metres``: of the path, turns counted by the time that they take; ``stops`` (M,): at
        how many of the places each gets to look. Draws are the same for all paths of one ``seed``.
        """
