"""The interface of motion sensors (odometry) used for prediction."""

from __future__ import annotations

from typing import Any, Protocol

import gtsam

from factorgraph_loc.model.settings import Estimated
from factors.graph import Factor
from factors.motion import ChainState, Increment
from factors.se2 import Array


class Motion(Protocol):
    """A motion sensor: collects rows and gives the relative motion between any two recent times.

    ``constants``: the P calibration constants that are estimated. ``horizon`` [s]: how long rows are kept.
    """

    constants: Estimated
    horizon: float

    def add(self, m: Any) -> None:
        """Add a row, or :class:`~factorgraph_loc.model.measurement.Rows`. Unused rows are counted as ignored, those older than the
        kept rows as late."""

    def keep(self, horizon: float) -> None:
        """Keep the rows of the last ``horizon`` seconds."""

    def state(self, t: float) -> ChainState:
        """The state of the integrated odometry at ``t``."""

    def relative(self, start: ChainState, end: ChainState) -> Increment:
        """The relative motion between two states, with its covariance."""

    def travelled(self, start: ChainState, t: float) -> tuple[ChainState, Increment]:
        """The state at ``t``, and the relative motion from ``start`` to it."""

    def changed(self, increment: Increment, constants: Array) -> tuple[Array, Array]:
        """Corrected ``delta`` (3,) of an increment for ``constants`` (P,), and its Jacobian (3, P) in the tangent space."""

    def predicted(
        self, increment: Increment, pose: Array, covariance: Array, constants: Array, first: int
    ) -> tuple[Array, Array, Array]:
        """Predict a Gaussian by an increment: the pose (3,), the first rows (3, S) of the transition (the other rows are those of
        the identity), and the covariance (S, S) of the error state, in which the columns of ``constants`` (P,) begin at
        ``first``."""

    def recalibrated(self, increment: Increment, constants: Array) -> Increment:
        """An increment corrected for ``constants`` (P,)."""

    def poses_at(self, start: ChainState, t: Array, constants: Array) -> Array:
        """Poses (R, 3) at times (R,) relative to the pose at ``start``, for ``constants`` (P,)."""

    def twist(self, t: float) -> Array:
        """The robot's velocity (3,) just before ``t``, in the robot frame."""

    def factor(self, increment: Increment) -> Factor:
        """An increment as a factor on two poses, and on the constants if there are any."""

    def native(self, keys: tuple[int, int], increment: Increment) -> gtsam.NonlinearFactor:
        """An increment without constants as a GTSAM factor on two poses."""
