"""Planar trajectories with covariances, interpolation, the TUM text format, and the base class of trajectories."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.columns import COVARIANCES, symmetric
from factorgraph_loc.files.models import write_text
from factorgraph_loc.model.pose_path import PosePath
from factors import se2
from factors.se2 import Array, Integers

if TYPE_CHECKING:
    import polars as pl


class Exchange:
    """The common base of trajectories: made from poses with absolute times, from arrays and from tables.

    Times are seconds after ``t0_ns``, nanoseconds since 1970.
    """

    t: Array

    @classmethod
    def of(cls, path: PosePath, t0_ns: int = 0) -> Self:
        """The poses of a path.

        InputError if it has no times, as in KITTI files, or they do not increase. For a trajectory on the floor also if heights
        vary.
        """
        if path.t_ns is None:
            raise InputError(f"{path.name}: has poses without times, expected poses with times")
        require_times(path.name, path.t_ns)
        return cls._of_path((path.t_ns - t0_ns) / 1e9, path)

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

    @classmethod
    @abstractmethod
    def _of_path(cls, t: Array, path: PosePath) -> Self:
        """The trajectory with the poses of a path at the times ``t``."""

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
class Trajectory(Exchange):
    """A planar trajectory: ``t`` (N,) seconds, strictly increasing; ``poses`` (N, 3) of the robot in the world; ``covariances``
    (N, 3, 3) of (x, y, heading) in the world frame, or None. ``has_heading`` is False if the headings are meaningless."""

    t: Array
    poses: Array
    covariances: Array | None = None
    has_heading: bool = True

    def __post_init__(self) -> None:
        if self.poses.shape != (len(self.t), 3):
            raise ValueError(f"poses have shape {self.poses.shape}, expected ({len(self.t)}, 3)")
        if len(self.t) > 1 and not np.all(np.diff(self.t) > 0.0):
            raise ValueError("timestamps of a trajectory must increase")

    def __len__(self) -> int:
        return len(self.t)

    def rows(self, which: Integers | NDArray[np.bool_]) -> Self:
        """The poses at indices ``which``, or where ``which`` (N,) is true."""
        covariances = None if self.covariances is None else self.covariances[which]
        return replace(self, t=self.t[which], poses=self.poses[which], covariances=covariances)

    def at(self, t: Array, *, max_gap: float = np.inf) -> Array:
        """Poses (M, 3) at times ``t`` (M,), interpolated on SE(2); NaN outside and in gaps longer than ``max_gap``."""
        out = np.full((len(t), 3), np.nan)
        if len(self.t) == 0:
            return out
        first, last, fraction, valid = neighbours(self.t, t, max_gap)
        start = self.poses[first]
        twist = se2.log(se2.between(start, self.poses[last]))
        out[valid] = se2.compose(start, se2.exp(fraction[:, None] * twist))[valid]
        return out

    def covariances_at(self, t: Array, *, max_gap: float = np.inf) -> Array:
        """Covariances (M, 3, 3) at times ``t`` (M,), interpolated linearly; NaN outside and in gaps longer than ``max_gap``.
        ValueError if the trajectory has no covariances."""
        if self.covariances is None:
            raise ValueError("the trajectory has no covariances")
        out = np.full((len(t), 3, 3), np.nan)
        if len(self.t) == 0:
            return out
        first, last, fraction, valid = neighbours(self.t, t, max_gap)
        out[valid] = averaged(self.covariances, first, last, fraction)[valid]
        return out

    def to_numpy(self) -> Array:
        """The poses as an array (N, 4): t [s], x, y [m], heading [rad]."""
        return np.column_stack((self.t, self.poses))

    @classmethod
    def from_polars(cls, table: pl.DataFrame) -> Self:
        """A trajectory from the columns t [s], x, y [m], heading [rad], and optionally those of covariances; others are ignored.

        Columns of covariances: cov_xx, cov_xy, cov_xh, cov_yy, cov_yh, cov_hh. InputError if a column is missing, or has values
        that are no numbers.
        """
        trajectory = super().from_polars(table)
        if not any(name in table.columns for name in COVARIANCES):
            return trajectory
        if missing := [name for name in COVARIANCES if name not in table.columns]:
            raise InputError(f"the table has no column {missing[0]}, expected all or none of {', '.join(COVARIANCES)}")
        return replace(trajectory, covariances=symmetric(list(numbers(table, COVARIANCES).T)))

    def to_polars(self) -> pl.DataFrame:
        """The poses as a table with the columns of :meth:`from_polars`, those of covariances if there are any."""
        table, known = super().to_polars(), self.covariances
        return (
            table if known is None else table.with_columns(**{k: known[:, i, j] for k, (i, j) in COVARIANCES.items()})
        )

    @classmethod
    def _columns(cls) -> tuple[str, ...]:
        return "t", "x", "y", "heading"

    @classmethod
    def _of_rows(cls, rows: Array) -> Self:
        return cls(rows[:, 0], rows[:, 1:])

    @classmethod
    def _of_path(cls, t: Array, path: PosePath) -> Self:
        return cls(t, path.on_floor([]), has_heading=path.has_rotations)

    def _tum(self) -> Iterator[str]:
        for x, y, heading in self.poses:
            yield f"{x:.9f} {y:.9f} 0 0 0 {np.sin(heading / 2.0):.12f} {np.cos(heading / 2.0):.12f}"


def neighbours(stamps: Array, t: Array, max_gap: float) -> tuple[Integers, Integers, Array, NDArray[np.bool_]]:
    """Bracket times ``t`` (M,) in sorted ``stamps`` (N,), N > 0.

    Returns the indices of the previous and the next stamp, which are equal at a stamp; the fraction between them; and whether a
    time is inside and not in a gap longer than ``max_gap``.
    """
    t = np.asarray(t, dtype=float)
    last = np.clip(np.searchsorted(stamps, t, side="left"), 0, len(stamps) - 1)
    first = np.where(stamps[last] == t, last, np.maximum(last - 1, 0))
    gap = stamps[last] - stamps[first]
    valid = (t >= stamps[0]) & (t <= stamps[-1]) & (gap <= max_gap + 1e-9)
    fraction = np.where(gap > 0.0, (t - stamps[first]) / np.where(gap > 0.0, gap, 1.0), 0.0)
    return first, last, fraction, valid


def averaged(covariances: Array, first: Integers, last: Integers, fraction: Array) -> Array:
    """Covariances (M, D, D) interpolated in ``covariances`` (N, D, D): see :func:`neighbours`."""
    weight = fraction[:, None, None]
    return np.asarray((1.0 - weight) * covariances[first] + weight * covariances[last])


def write_tum(trajectory: Exchange, path: str | Path, t0_ns: int = 0) -> None:
    """Write a TUM file with absolute timestamps in decimal seconds."""
    rows = [f"{decimal_seconds(t, t0_ns)} {row}\n" for t, row in zip(trajectory.t, trajectory._tum(), strict=True)]
    write_text(Path(path), "".join(rows))


def decimal_seconds(t: float, t0_ns: int) -> str:
    """A time ``t`` [s] after ``t0_ns`` as absolute decimal seconds, to the nanosecond."""
    t_ns = t0_ns + round(t * 1e9)
    sign, (whole, fraction) = "-" if t_ns < 0 else "", divmod(abs(t_ns), 10**9)
    return f"{sign}{whole}.{fraction:09d}"
