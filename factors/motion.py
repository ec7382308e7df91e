"""Motion increments and the propagation of covariances."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from factors.odometry.kernels import carried
from factors.se2 import Array


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
