"""Trajectories in three dimensions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from factorgraph_loc.model.trajectory import Trajectory, averaged, neighbours
from factors.se2 import Array, Integers


@dataclass(frozen=True)
class Trajectory3:
    """``t`` (N,) seconds, strictly increasing; ``positions`` (N, 3) [m] and ``rotations`` (N, 3, 3) in the world frame;
    ``covariances`` (N, 6, 6) of a perturbation in the robot frame, rotation before translation."""

    t: Array
    positions: Array
    rotations: Array
    covariances: Array | None = None

    def __post_init__(self) -> None:
        if self.positions.shape != (len(self.t), 3) or self.rotations.shape != (len(self.t), 3, 3):
            raise ValueError(
                f"positions {self.positions.shape}, rotations {self.rotations.shape}, expected those of {len(self.t)} timestamps"
            )
        if len(self.t) > 1 and not np.all(np.diff(self.t) > 0.0):
            raise ValueError("timestamps of a trajectory must increase")

    def __len__(self) -> int:
        return len(self.t)

    def at(self, t: Array) -> Trajectory3:
        """The poses at times ``t`` (M,), which must lie between the first and the last timestamp. Positions and covariances are
        interpolated linearly, rotations by slerp."""
        t = np.asarray(t, dtype=float)
        before, after, fraction, _ = neighbours(self.t, t, np.inf)
        covariances = None if self.covariances is None else averaged(self.covariances, before, after, fraction)
        if len(self) == 1:
            alike = self.rows(np.zeros(len(t), dtype=np.int64))
            return Trajectory3(t, alike.positions, alike.rotations, covariances)
        positions = np.column_stack([np.interp(t, self.t, self.positions[:, i]) for i in range(3)])
        rotations = Slerp(self.t, Rotation.from_matrix(self.rotations))(t).as_matrix()
        return Trajectory3(t, positions, rotations.reshape(-1, 3, 3), covariances)

    def spans(self, t: Array, *, max_gap: float) -> NDArray[np.bool_]:
        """Which of the times ``t`` (M,) lie between the first and the last timestamp and not in a gap longer than ``max_gap``."""
        return neighbours(self.t, t, max_gap)[3]

    def rows(self, which: Integers) -> Trajectory3:
        """The poses with indices ``which``."""
        covariances = None if self.covariances is None else self.covariances[which]
        return Trajectory3(self.t[which], self.positions[which], self.rotations[which], covariances)

    def planar(self) -> Trajectory:
        """The planar trajectory: (x, y) and the direction of the robot's x axis."""
        headings = np.arctan2(self.rotations[:, 1, 0], self.rotations[:, 0, 0])
        return Trajectory(self.t, np.column_stack((self.positions[:, :2], headings)))
