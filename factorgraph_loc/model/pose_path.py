"""Poses with absolute times, as in files, bags and messages; exchange of trajectories as arrays and tables."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
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

_FLAT = 1e-9  # m and sines within which poses are planar


class Exchange:
    """The common base of trajectories that are made from arrays and tables, with times in seconds."""

    @classmethod
    def from_numpy(cls, table: Array) -> Self:
        """A trajectory from an array with a row for each pose, as :meth:`to_numpy` returns it. InputError if it is none."""
        rows = np.asarray(table, dtype=float)
        columns = cls._columns()
        if rows.ndim != 2 or rows.shape[1] != len(columns):
            expected = f"a row for each pose with {', '.join(columns)}"
            raise InputError(f"the array has the shape {rows.shape}, expected (N, {len(columns)}): {expected}")
        require_times("the array", rows[:, 0])
        return cls._of_rows(rows)

    @abstractmethod
    def to_numpy(self) -> Array:
        """The poses as an array (N, 4) or (N, 8), one row per pose: the time t [s] first, then the pose. The columns are those of
        the subclass."""

    @classmethod
    def from_polars(cls, table: pl.DataFrame) -> Self:
        """A trajectory from the columns that :meth:`to_polars` gives; others are ignored. InputError if one is missing, or has
        values that are no numbers."""
        if missing := [name for name in cls._columns() if name not in table.columns]:
            raise InputError(f"the table has no column {missing[0]}, expected {', '.join(cls._columns())}")
        return cls.from_numpy(numbers(table, cls._columns()))

    def to_polars(self) -> pl.DataFrame:
        """The poses as a table with the columns of :meth:`to_numpy`, one row per pose."""
        import polars as pl  # noqa: PLC0415 - most users of trajectories need none

        return pl.DataFrame(self.to_numpy(), schema=list(self._columns()))

    @classmethod
    @abstractmethod
    def _columns(cls) -> tuple[str, ...]:
        """The names of the columns of :meth:`to_numpy`."""

    @classmethod
    @abstractmethod
    def _of_rows(cls, rows: Array) -> Self:
        """The trajectory with these rows, as of :meth:`to_numpy`."""

    @abstractmethod
    def _tum(self) -> Iterator[str]:
        """The poses as rows of a TUM file without times."""


def numbers(table: pl.DataFrame, names: Iterable[str]) -> Array:
    """Columns of a table as an array (N, K). InputError for one with values that are no numbers."""
    import polars as pl  # noqa: PLC0415

    columns = []
    for name in names:
        column = table[name]
        if not column.dtype.is_numeric() or column.null_count():
            raise InputError(f"column {name} has values that are no numbers, expected numbers alone")
        columns.append(column.cast(pl.Float64).to_numpy())
    return np.column_stack(columns)


def require_times(name: str, t: Array | Integers) -> None:
    """InputError for the first pose whose time, in seconds or nanoseconds, is not after that of the pose before."""
    if len(stuck := np.flatnonzero(~(np.diff(t) > 0))):
        i = int(stuck[0]) + 1
        unit = "ns" if np.issubdtype(t.dtype, np.integer) else "s"
        raise InputError(f"{name}: pose {i + 1} has the time {t[i]} {unit}, expected one after that of the pose before")


@dataclass(frozen=True)
class PosePath(Exchange):
    """A sequence of poses: ``positions`` (N, 3) [m] and ``rotations`` (N, 3, 3) in a world frame.

    ``t_ns`` (N,): absolute times [ns], strictly increasing, or None if only the order of the poses is known. ``has_rotations`` is
    False if the rotations are meaningless. ``warnings``: one line for each problem that a reader corrected.
    """

    name: str
    positions: Array
    rotations: Array
    t_ns: Integers | None
    has_rotations: bool = True
    warnings: tuple[Notice, ...] = ()

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def is_planar(self) -> bool:
        """Whether all poses have one height and stand upright."""
        return bool(np.ptp(self.positions[:, 2]) <= _FLAT and np.all(np.abs(self.rotations[:, 2, :2]) <= _FLAT))

    def stamps(self) -> Integers:
        """The times (N,) [ns]; InputError if they are unknown, as in KITTI files, or do not increase."""
        if self.t_ns is None:
            raise InputError(f"{self.name}: has poses without times, expected poses with times")
        require_times(self.name, self.t_ns)
        return self.t_ns

    def seconds(self) -> Array:
        """The times (N,) in seconds since 1970, each the float nearest to it. InputError as in :meth:`stamps`."""
        return np.array([t / 10**9 for t in self.stamps().tolist()])

    def rows(self, which: Integers) -> PosePath:
        """The poses with indices ``which``."""
        t_ns = None if self.t_ns is None else self.t_ns[which]
        return replace(self, positions=self.positions[which], rotations=self.rotations[which], t_ns=t_ns)

    def at(self, t_ns: Integers) -> PosePath:
        """The poses at times ``t_ns`` (M,), which must lie between the first and the last. Positions are interpolated linearly,
        rotations by slerp."""
        if len(self) == 1:
            return replace(self.rows(np.zeros(len(t_ns), dtype=np.int64)), t_ns=t_ns)
        own, t = (checks.seconds(stamps, int(self.stamps()[0])) for stamps in (self.stamps(), t_ns))
        turns = scipy.spatial.transform.Rotation.from_matrix(self.rotations)
        rotations = scipy.spatial.transform.Slerp(own, turns)(t).as_matrix().reshape(-1, 3, 3)
        positions = np.column_stack([np.interp(t, own, self.positions[:, i]) for i in range(3)])
        return replace(self, positions=positions, rotations=rotations, t_ns=t_ns)

    def on_floor(self, warnings: list[Notice], turned: Turned = AS_IT_IS) -> Array:
        """Planar poses (N, 3): see :func:`~factorgraph_loc.model.planar.on_floor`."""
        return on_floor(self.name, self.positions, self.rotations if self.has_rotations else None, warnings, turned)

    def headings(self) -> Array:
        """The directions (N,) of the x axis, from above."""
        return np.arctan2(self.rotations[:, 1, 0], self.rotations[:, 0, 0])

    def seen_from_above(self) -> PosePath:
        """The same poses at height 0, turned about the vertical axis only."""
        return replace(self, positions=self.positions * (1.0, 1.0, 0.0), rotations=upright(self.headings()))

    def quaternions(self) -> Array:
        """The rotations as quaternions (N, 4): x, y, z, w, with w at least 0."""
        if not len(self):
            return np.empty((0, 4))
        return np.asarray(scipy.spatial.transform.Rotation.from_matrix(self.rotations).as_quat(canonical=True))

    def to_numpy(self) -> Array:
        """The poses as an array (N, 8): t [s since 1970], x, y, z [m], and the quaternion x, y, z, w."""
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
