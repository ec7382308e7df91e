"""Stamped poses in space, of cameras and robots that do not stay on a floor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from factorgraph_loc.trajectory import Trajectory
from factors.se2 import Array


@dataclass(frozen=True)
class Trajectory3:
    """``t`` (N,) seconds, strictly increasing; ``positions`` (N, 3) [m] and ``rotations`` (N, 3, 3) in the world's frame;
    ``covariances`` (N, 6, 6) of an estimate: of the perturbation in the robot's frame, turn first, then shift."""

    t: Array
    positions: Array
    rotations: Array
    covariances: Array | None = None

    def __post_init__(self) -> None:
        if self.positions.shape != (len(self.t), 3) or self.rotations.shape != (len(self.t), 3, 3):
            raise ValueError(
                f"positions {self.positions.shape}, rotations {self.rotations.shape}, expected those of {len(self.t)} stamps"
            )
        if len(self.t) > 1 and not np.all(np.diff(self.t) > 0.0):
            raise ValueError("stamps of a trajectory must increase")

    def __len__(self) -> int:
        return len(self.t)

    def at(self, t: Array) -> Trajectory3:
        """The poses at times ``t`` (M,), which must lie between the first and the last stamp: straight between neighbours, turning
        evenly."""
        t = np.asarray(t, dtype=float)
        if len(self) == 1:
            return Trajectory3(t, np.repeat(self.positions, len(t), axis=0), np.repeat(self.rotations, len(t), axis=0))
        positions = np.column_stack([np.interp(t, self.t, self.positions[:, i]) for i in range(3)])
        return Trajectory3(t, positions, Slerp(self.t, Rotation.from_matrix(self.rotations))(t).as_matrix())

    def planar(self) -> Trajectory:
        """The same seen from above: (x, y) and the direction of the first axis."""
        headings = np.arctan2(self.rotations[:, 1, 0], self.rotations[:, 0, 0])
        return Trajectory(self.t, np.column_stack((self.positions[:, :2], headings)))
