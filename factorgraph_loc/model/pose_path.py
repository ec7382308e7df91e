"""Sequences of three-dimensional poses with absolute times, and conversion of trajectories to and from arrays and tables."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Self

import numpy as np
import scipy

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import checks
from factorgraph_loc.model.planar import AS_IT_IS, Turned, on_floor, rotations_of
from factorgraph_loc.text import Notice
from factors.se2 import Array, Integers

if TYPE_CHECKING:
    import polars as pl

_FLAT = 1e-9  # maximum differences of heights [m] and sines of tilts of planar poses


class Exchange:
    """The base class of trajectories: conversion to and from arrays and tables, with times in seconds."""

    @classmethod
    def from_numpy(cls, table: Array) -> Self:
        """Return a trajectory from an array with the columns of :meth:`to_numpy`, one row per pose. Raises InputError
        if the number of columns is wrong, or if the times do not increase."""
        rows = np.asarray(table, dtype=float)
        columns = cls._columns()
        if rows.ndim != 2 or rows.shape[1] != len(columns):
            expected = f"a row for each pose with {', '.join(columns)}"
            raise InputError(f"the array has the shape {rows.shape}, expected (N, {len(columns)}): {expected}")
        require_times("the array", rows[:, 0])
        return cls._of_rows(rows)

    @abstractmethod
    def to_numpy(self) -> Array:
        """Return the poses as an array, one row per pose: the time t [s] first, then the pose. The shape is (N, 4) for
        planar poses and (N, 8) for poses with quaternions."""

    @classmethod
    def from_polars(cls, table: pl.DataFrame) -> Self:
        """Return a trajectory from a table with the columns of :meth:`to_polars`. Other columns are ignored. Raises
        InputError if a column is missing, or if it has values that are not numbers."""
        if missing := [name for name in cls._columns() if name not in table.columns]:
            raise InputError(f"the table has no column {missing[0]}, expected {', '.join(cls._columns())}")
        return cls.from_numpy(numbers(table, cls._columns()))

    def to_polars(self) -> pl.DataFrame:
        """Return the poses as a table with the columns of :meth:`to_numpy`, one row per pose."""
        import polars as pl  # noqa: PLC0415 - most users of trajectories do not need polars

        return pl.DataFrame(self.to_numpy(), schema=list(self._columns()))

    @classmethod
    @abstractmethod
    def _columns(cls) -> tuple[str, ...]:
        """Return the names of the columns of :meth:`to_numpy`."""

    @classmethod
    @abstractmethod
    def _of_rows(cls, rows: Array) -> Self:
        """Return the trajectory with the poses in ``rows``, an array with the columns of :meth:`to_numpy`."""

    @abstractmethod
    def _tum(self) -> Iterator[str]:
        """Yield the text of each pose in a TUM file, without its time."""


def numbers(table: pl.DataFrame, names: Iterable[str]) -> Array:
    """Return the K columns ``names`` of a table with N rows as an array (N, K). Raises InputError if an entry is not a
    number."""
    import polars as pl  # noqa: PLC0415

    columns = []
    for name in names:
        column = table[name]
        if not column.dtype.is_numeric() or column.null_count():
            raise InputError(f"column {name} has values that are not numbers, expected only numbers")
        columns.append(column.cast(pl.Float64).to_numpy())
    return np.column_stack(columns)


def require_times(name: str, t: Array | Integers) -> None:
    """Raise InputError if the times of poses do not increase.

    ``t`` (N,): times in seconds, or integers in nanoseconds. ``name``: name of the poses in the error.
    """
    if len(stuck := np.flatnonzero(~(np.diff(t) > 0))):
        i = int(stuck[0]) + 1
        unit = "ns" if np.issubdtype(t.dtype, np.integer) else "s"
        raise InputError(f"{name}: pose {i + 1} has the time {t[i]} {unit}, expected a time after that of pose {i}")


@dataclass(frozen=True)
class PosePath(Exchange):
    """A sequence of three-dimensional poses in a world frame.

    ``name``: the name in errors. ``positions`` (N, 3) [m]. ``rotations`` (N, 3, 3): from the body frame to the world
    frame. ``t_ns`` (N,): absolute times [ns], strictly increasing, or None if only the order of the poses is known.
    ``has_rotations``: False if the rotations are meaningless. ``warnings``: problems that a reader corrected.
    ``lost_ns``: times [ns] of poses with a zero quaternion, which are not in the sequence.
    """

    name: str
    positions: Array
    rotations: Array
    t_ns: Integers | None
    has_rotations: bool = True
    warnings: tuple[Notice, ...] = ()
    lost_ns: Integers = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def is_planar(self) -> bool:
        """True if all poses have the same height and are not tilted."""
        return bool(np.ptp(self.positions[:, 2]) <= _FLAT and np.all(np.abs(self.rotations[:, 2, :2]) <= _FLAT))

    def stamps(self) -> Integers:
        """Return the times (N,) [ns]. Raises InputError if they are unknown, as in KITTI files, or do not increase."""
        if self.t_ns is None:
            raise InputError(f"{self.name}: has poses without times, expected poses with times")
        require_times(self.name, self.t_ns)
        return self.t_ns

    def seconds(self) -> Array:
        """Return the times (N,) in seconds since 1970. Raises InputError if times are unknown or do not increase."""
        return np.array([t / 10**9 for t in self.stamps().tolist()])

    def rows(self, which: Integers) -> PosePath:
        """Return a path of the poses with the indices ``which`` (M,), in this order."""
        t_ns = None if self.t_ns is None else self.t_ns[which]
        return replace(self, positions=self.positions[which], rotations=self.rotations[which], t_ns=t_ns)

    def at(self, t_ns: Integers) -> PosePath:
        """Return the poses at times ``t_ns`` (M,) [ns], which must lie between the first and the last time. Positions
        are interpolated linearly, rotations by spherical linear interpolation."""
        if len(self) == 1:
            return replace(self.rows(np.zeros(len(t_ns), dtype=np.int64)), t_ns=t_ns)
        own, t = (checks.seconds(stamps, int(self.stamps()[0])) for stamps in (self.stamps(), t_ns))
        turns = scipy.spatial.transform.Rotation.from_matrix(self.rotations)
        rotations = scipy.spatial.transform.Slerp(own, turns)(t).as_matrix().reshape(-1, 3, 3)
        positions = np.column_stack([np.interp(t, own, self.positions[:, i]) for i in range(3)])
        return replace(self, positions=positions, rotations=rotations, t_ns=t_ns)

    def on_floor(self, warnings: list[Notice], turned: Turned = AS_IT_IS) -> Array:
        """Return planar poses (N, 3): x, y [m] and heading [rad] of the robot. ``warnings``: a list. Warnings about
        heights or tilts are appended to it. ``turned``: the axes of the recorded poses, and how their frame is mounted
        on the robot."""
        return on_floor(self.name, self.positions, self.rotations if self.has_rotations else None, warnings, turned)

    def headings(self) -> Array:
        """Return the headings (N,) [rad], the directions of the x axis in the horizontal plane."""
        return np.arctan2(self.rotations[:, 1, 0], self.rotations[:, 0, 0])

    def seen_from_above(self) -> PosePath:
        """Return the path projected on the floor: height 0, and rotations about the vertical axis only."""
        return replace(self, positions=self.positions * (1.0, 1.0, 0.0), rotations=upright(self.headings()))

    def quaternions(self) -> Array:
        """Return the rotations as quaternions (N, 4) in the order x, y, z, w, with w >= 0."""
        if not len(self):
            return np.empty((0, 4))
        return np.asarray(scipy.spatial.transform.Rotation.from_matrix(self.rotations).as_quat(canonical=True))

    def to_numpy(self) -> Array:
        """Return the poses as an array (N, 8): t [s since 1970], x, y, z [m], and the quaternion x, y, z, w."""
        return np.column_stack((self.seconds(), self.positions, self.quaternions()))

    @classmethod
    def _columns(cls) -> tuple[str, ...]:
        return "t", "x", "y", "z", "qx", "qy", "qz", "qw"

    @classmethod
    def _of_rows(cls, rows: Array) -> Self:
        numbered = np.arange(1, len(rows) + 1)
        rotations = rotations_of("the array", numbered, rows[:, 4:])
        return cls("the array", rows[:, 1:4], rotations, checks.stamps("the array", numbered, rows[:, 0]))

    def _tum(self) -> Iterator[str]:
        for place, turn in zip(self.positions, self.quaternions(), strict=True):
            yield " ".join((*(f"{value:.9f}" for value in place), *(f"{value:.12f}" for value in turn)))


def require_poses(path: PosePath) -> None:
    """Raise InputError if a path has no poses, or if a pose is not finite."""
    if not len(path):
        raise InputError(f"{path.name}: contains no poses, expected at least one")
    known = np.isfinite(path.positions).all(axis=1) & np.isfinite(path.rotations).all(axis=(1, 2))
    if not known.all():
        raise InputError(f"{path.name}: pose {int(np.argmin(known)) + 1} is not finite, expected finite numbers")


def upright(headings: Array) -> Array:
    """Return the rotation matrices (N, 3, 3) about the vertical axis by ``headings`` (N,) [rad]."""
    out = np.zeros((len(headings), 3, 3))
    out[:, 0, 0] = out[:, 1, 1] = np.cos(headings)
    out[:, 1, 0] = np.sin(headings)
    out[:, 0, 1] = -np.sin(headings)
    out[:, 2, 2] = 1.0
    return out
