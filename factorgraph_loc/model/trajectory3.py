"""Trajectories and poses in three dimensions, and their projections onto the plane."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import scipy
from numpy.typing import NDArray

from factorgraph_loc.model.planar import rotations_of
from factorgraph_loc.model.pose_path import PosePath, upright
from factorgraph_loc.model.trajectory import Exchange, Trajectory, neighbours
from factors.se2 import Array, Integers


@dataclass(frozen=True)
class Trajectory3(Exchange):
    """``t`` (N,) seconds, strictly increasing; ``positions`` (N, 3) [m] and ``rotations`` (N, 3, 3) in the world frame."""

    t: Array
    positions: Array
    rotations: Array

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
        """The poses at times ``t`` (M,), which must lie between the first and the last timestamp. Positions are interpolated
        linearly, rotations by slerp."""
        t = np.asarray(t, dtype=float)
        if len(self) == 1:
            return replace(self.rows(np.zeros(len(t), dtype=np.int64)), t=t)
        positions = np.column_stack([np.interp(t, self.t, self.positions[:, i]) for i in range(3)])
        rotations = scipy.spatial.transform.Slerp(self.t, scipy.spatial.transform.Rotation.from_matrix(self.rotations))(
            t
        ).as_matrix()
        return Trajectory3(t, positions, rotations.reshape(-1, 3, 3))

    def spans(self, t: Array, *, max_gap: float) -> NDArray[np.bool_]:
        """Which of the times ``t`` (M,) lie between the first and the last timestamp and not in a gap longer than ``max_gap``."""
        return neighbours(self.t, t, max_gap)[3]

    def rows(self, which: Integers) -> Trajectory3:
        """The poses with indices ``which``."""
        return Trajectory3(self.t[which], self.positions[which], self.rotations[which])

    def planar(self) -> Trajectory:
        """The planar trajectory: (x, y) and the direction of the robot's x axis."""
        headings = np.arctan2(self.rotations[:, 1, 0], self.rotations[:, 0, 0])
        return Trajectory(self.t, np.column_stack((self.positions[:, :2], headings)))

    def to_numpy(self) -> Array:
        """The poses as an array (N, 8): t [s], x, y, z [m], and the quaternion x, y, z, w."""
        return np.column_stack((self.t, self.positions, self.quaternions()))

    def quaternions(self) -> Array:
        """The rotations as quaternions (N, 4): x, y, z, w, with w at least 0."""
        if not len(self):
            return np.empty((0, 4))
        return np.asarray(scipy.spatial.transform.Rotation.from_matrix(self.rotations).as_quat(canonical=True))

    @classmethod
    def _columns(cls) -> tuple[str, ...]:
        return "t", "x", "y", "z", "qx", "qy", "qz", "qw"

    @classmethod
    def _of_rows(cls, rows: Array) -> Self:
        rotations = rotations_of("the array", np.arange(1, len(rows) + 1), rows[:, 4:])
        return cls(rows[:, 0], rows[:, 1:4], rotations)

    @classmethod
    def _of_path(cls, t: Array, path: PosePath) -> Self:
        return cls(t, path.positions, path.rotations)

    def _tum(self) -> Iterator[str]:
        for place, turn in zip(self.positions, self.quaternions(), strict=True):
            yield " ".join((*(f"{value:.9f}" for value in place), *(f"{value:.12f}" for value in turn)))


def path_of(trajectory: Trajectory | Trajectory3, name: str, t0_ns: int = 0) -> PosePath:
    """The poses of a trajectory whose times count from ``t0_ns``; those of a planar one have height 0."""
    t_ns = np.rint(trajectory.t * 1e9).astype(np.int64) + t0_ns
    if isinstance(trajectory, Trajectory3):
        return PosePath(name, trajectory.positions, trajectory.rotations, t_ns)
    headings = trajectory.poses[:, 2] if trajectory.has_heading else np.zeros(len(trajectory))
    positions = np.column_stack((trajectory.poses[:, :2], np.zeros(len(trajectory))))
    return PosePath(name, positions, upright(headings), t_ns, trajectory.has_heading)
