"""Trajectories in three dimensions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from factorgraph_loc.files.models import write_text
from factorgraph_loc.model.exchange import Exchange
from factorgraph_loc.model.planar import rotations_of
from factorgraph_loc.model.trajectory import Trajectory, averaged, decimal_seconds, neighbours
from factors.se2 import Array, Integers

if TYPE_CHECKING:
    from factorgraph_loc.model.pose_path import PosePath


@dataclass(frozen=True)
class Trajectory3(Exchange):
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

    def to_numpy(self) -> Array:
        """The poses as an array (N, 8): t [s], x, y, z [m], and the quaternion x, y, z, w."""
        return np.column_stack((self.t, self.positions, self.quaternions()))

    def quaternions(self) -> Array:
        """The rotations as quaternions (N, 4): x, y, z, w, with w at least 0."""
        if not len(self):
            return np.empty((0, 4))
        return np.asarray(Rotation.from_matrix(self.rotations).as_quat(canonical=True))

    @classmethod
    def _columns(cls) -> tuple[str, ...]:
        return "t", "x", "y", "z", "qx", "qy", "qz", "qw"

    @classmethod
    def _of_rows(cls, rows: Array) -> Self:
        rotations = rotations_of("the array", np.arange(1, len(rows) + 1), rows[:, 4:])
        return cls(rows[:, 0], rows[:, 1:4], rotations)

    @classmethod
    def _of_path(cls, path: PosePath, t0_ns: int) -> Self:
        assert path.t_ns is not None
        return cls((path.t_ns - t0_ns) / 1e9, path.positions, path.rotations)

    def _write_tum(self, path: Path, t0_ns: int) -> None:
        rows = []
        for t, place, turn in zip(self.t.tolist(), self.positions, self.quaternions(), strict=True):
            numbers = [*(f"{value:.9f}" for value in place), *(f"{value:.12f}" for value in turn)]
            rows.append(f"{decimal_seconds(t, t0_ns)} {' '.join(numbers)}\n")
        write_text(path, "".join(rows))
