"""Trajectories and poses in three dimensions, and what is seen of them from above."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import scipy
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.planar import AS_IT_IS, Turned, on_floor, rotations_of
from factorgraph_loc.model.trajectory import Exchange, Trajectory, neighbours
from factors.se2 import Array, Integers

_FLAT = 1e-9  # m and sines within which poses are planar


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


@dataclass(frozen=True)
class PosePath:
    """A sequence of poses: ``positions`` (N, 3) [m] and ``rotations`` (N, 3, 3) in a world frame.

    ``t_ns`` (N,): absolute times [ns], strictly increasing, or None if only the order of the poses is known. ``has_rotations`` is
    False if the rotations are meaningless. ``warnings``: one line for each problem that a reader corrected.
    """

    name: str
    positions: Array
    rotations: Array
    t_ns: Integers | None
    has_rotations: bool = True
    warnings: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def is_planar(self) -> bool:
        """Whether all poses have one height and stand upright."""
        return bool(np.ptp(self.positions[:, 2]) <= _FLAT and np.all(np.abs(self.rotations[:, 2, :2]) <= _FLAT))

    def seconds(self) -> Array:
        """The times (N,) in seconds since 1970, each the float nearest to it. ValueError if they are unknown."""
        if self.t_ns is None:
            raise ValueError(f"{self.name} has no times")
        return np.array([t / 10**9 for t in self.t_ns.tolist()])

    def rows(self, which: Integers) -> PosePath:
        """The poses with indices ``which``."""
        t_ns = None if self.t_ns is None else self.t_ns[which]
        return replace(self, positions=self.positions[which], rotations=self.rotations[which], t_ns=t_ns)

    def planar(self, t0_ns: int) -> Trajectory:
        """The poses seen from above, in seconds after ``t0_ns``: x, y and the direction of the robot's x axis."""
        return replace(self.in_space(t0_ns).planar(), has_heading=self.has_rotations)

    def in_space(self, t0_ns: int) -> Trajectory3:
        """The poses as a trajectory, in seconds after ``t0_ns``. ValueError if their times are unknown."""
        if self.t_ns is None:
            raise ValueError(f"{self.name} has no times")
        return Trajectory3((self.t_ns - t0_ns) / 1e9, self.positions, self.rotations)

    def on_floor(self, warnings: list[str], turned: Turned = AS_IT_IS) -> Array:
        """Planar poses (N, 3): see :func:`~factorgraph_loc.model.planar.on_floor`."""
        return on_floor(self.name, self.positions, self.rotations if self.has_rotations else None, warnings, turned)

    def seen_from_above(self) -> PosePath:
        """The same poses at height 0, turned about the vertical axis only."""
        headings = np.arctan2(self.rotations[:, 1, 0], self.rotations[:, 0, 0])
        return replace(self, positions=self.positions * (1.0, 1.0, 0.0), rotations=upright(headings))


def path_of(trajectory: Trajectory | Trajectory3, name: str, t0_ns: int = 0) -> PosePath:
    """The poses of a trajectory whose times count from ``t0_ns``; those of a planar one have height 0."""
    t_ns = np.rint(trajectory.t * 1e9).astype(np.int64) + t0_ns
    if isinstance(trajectory, Trajectory3):
        return PosePath(name, trajectory.positions, trajectory.rotations, t_ns)
    headings = trajectory.poses[:, 2] if trajectory.has_heading else np.zeros(len(trajectory))
    positions = np.column_stack((trajectory.poses[:, :2], np.zeros(len(trajectory))))
    return PosePath(name, positions, upright(headings), t_ns, trajectory.has_heading)


def require_poses(path: PosePath) -> None:
    """InputError if there are no poses, or one is not finite."""
    if not len(path):
        raise InputError(f"{path.name}: contains no poses, expected at least one")
    known = np.isfinite(path.positions).all(axis=1) & np.isfinite(path.rotations).all(axis=(1, 2))
    if not known.all():
        raise InputError(f"{path.name}: pose {int(np.argmin(known)) + 1} is not finite, expected finite numbers")


def upright(headings: Array) -> Array:
    """Rotations (N, 3, 3) by ``headings`` (N,) about the vertical axis."""
    out = np.zeros((len(headings), 3, 3))
    out[:, 0, 0] = out[:, 1, 1] = np.cos(headings)
    out[:, 1, 0] = np.sin(headings)
    out[:, 0, 1] = -np.sin(headings)
    out[:, 2, 2] = 1.0
    return out
