"""Measured motion as estimators and finders know it."""

from __future__ import annotations

from typing import Any, Protocol

import gtsam

from factorgraph_loc.model.variable import Estimated
from factors.graph import Factor
from factors.motion import ChainState, Increment
from factors.se2 import Array


class Motion(Protocol):
    """The sensor that predicts: rows in, relative motion between any two recent times out.

    ``constants``: those that are estimated, P of them; ``horizon`` [s]: how long rows are kept.
    """

    constants: Estimated
    horizon: float

    def add(self, m: Any) -> None:
        """Take a row; one that is not used is counted as ignored, one older than what is kept as late."""

    def keep(self, horizon: float) -> None:
        """Keep the rows of the last ``horizon`` seconds, as far as they are there yet."""

    def state(self, t: float) -> ChainState:
        """Where the chain of all rows is at ``t``."""

    def relative(self, start: ChainState, end: ChainState) -> Increment:
        """The motion between two states, with its covariance."""

    def changed(self, increment: Increment, constants: Array) -> tuple[Array, Array]:
        """``delta`` (3,) of an increment under changed ``constants`` (P,), and the Jacobian (3, P) of its perturbation."""

    def recalibrated(self, increment: Increment, constants: Array) -> Increment:
        """An increment under changed ``constants`` (P,)."""

    def poses_at(self, start: ChainState, t: Array, constants: Array) -> Array:
        """Poses (R, 3) at times (R,), before or after, in the frame of the pose at ``start``, under changed ``constants`` (P,)."""

    def twist(self, t: float) -> Array:
        """The robot's velocity (3,) just before ``t``, in its own frame."""

    def factor(self, increment: Increment) -> Factor:
        """An increment as a factor on two poses, and on the constants where there are any."""

    def native(self, keys: tuple[int, int], increment: Increment) -> gtsam.NonlinearFactor:
        """An increment without constants as a factor of GTSAM's on two poses."""
