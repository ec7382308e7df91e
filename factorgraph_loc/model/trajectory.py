"""Planar trajectories with covariances, interpolation, and the TUM text format."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.columns import LATEST, POSES
from factorgraph_loc.files.models import read_text, write_text
from factorgraph_loc.model.exchange import Exchange, numbers
from factorgraph_loc.model.planar import on_floor, rotations_of
from factors import se2
from factors.se2 import Array, Integers

if TYPE_CHECKING:
    import polars as pl

    from factorgraph_loc.model.pose_path import PosePath

COVARIANCES = {  # columns of tables: entries of a covariance of (x, y, heading)
    "cov_xx": (0, 0),
    "cov_xy": (0, 1),
    "cov_xh": (0, 2),
    "cov_yy": (1, 1),
    "cov_yh": (1, 2),
    "cov_hh": (2, 2),
}


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

    def at(self, t: Array, *, max_gap: float = np.inf) -> Array:
        """Poses (M, 3) at times ``t`` (M,), interpolated on SE(2); NaN outside and in gaps longer than ``max_gap``."""
        out = np.full((len(t), 3), np.nan)
        if len(self.t) == 0:
            return out
        before, after, fraction, valid = neighbours(self.t, t, max_gap)
        start = self.poses[before]
        twist = se2.log(se2.between(start, self.poses[after]))
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
        before, after, fraction, valid = neighbours(self.t, t, max_gap)
        out[valid] = averaged(self.covariances, before, after, fraction)[valid]
        return out

    def to_numpy(self) -> Array:
        """The poses as an array (N, 4): t [s], x, y [m], heading [rad]."""
        return np.column_stack((self.t, self.poses))

    @classmethod
    def from_polars(cls, table: pl.DataFrame) -> Self:
        """A trajectory from the columns t [s], x, y [m], heading [rad], and those of covariances (cov_xx, cov_xy, cov_xh, cov_yy,
        cov_yh, cov_hh) if there are any; others are ignored.

        InputError if a column is missing, or has values that are no numbers.
        """
        found = super().from_polars(table)
        if not any(name in table.columns for name in COVARIANCES):
            return found
        if missing := [name for name in COVARIANCES if name not in table.columns]:
            raise InputError(f"the table has no column {missing[0]}, expected all or none of {', '.join(COVARIANCES)}")
        covariances = np.empty((len(table), 3, 3))
        for column, (i, j) in zip(numbers(table, COVARIANCES).T, COVARIANCES.values(), strict=True):
            covariances[:, i, j] = covariances[:, j, i] = column
        return replace(found, covariances=covariances)

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
    def _of_path(cls, path: PosePath, t0_ns: int) -> Self:
        assert path.t_ns is not None
        poses = on_floor(path.name, path.positions, path.rotations if path.has_rotations else None, [])
        return cls((path.t_ns - t0_ns) / 1e9, poses, has_heading=path.has_rotations)

    def _write_tum(self, path: Path, t0_ns: int) -> None:
        write_tum(self, path, t0_ns)


def neighbours(stamps: Array, t: Array, max_gap: float) -> tuple[Integers, Integers, Array, NDArray[np.bool_]]:
    """Bracket times ``t`` (M,) in sorted ``stamps`` (N,), N > 0: the indices before and after, which are equal at a stamp, the
    fraction between them, and whether a time is inside and not in a gap longer than ``max_gap``."""
    t = np.asarray(t, dtype=float)
    after = np.clip(np.searchsorted(stamps, t, side="left"), 0, len(stamps) - 1)
    before = np.where(stamps[after] == t, after, np.maximum(after - 1, 0))
    gap = stamps[after] - stamps[before]
    valid = (t >= stamps[0]) & (t <= stamps[-1]) & (gap <= max_gap + 1e-9)
    fraction = np.where(gap > 0.0, (t - stamps[before]) / np.where(gap > 0.0, gap, 1.0), 0.0)
    return before, after, fraction, valid


def averaged(covariances: Array, before: Integers, after: Integers, fraction: Array) -> Array:
    """Covariances (M, D, D) interpolated in ``covariances`` (N, D, D): see :func:`neighbours`."""
    weight = fraction[:, None, None]
    return np.asarray((1.0 - weight) * covariances[before] + weight * covariances[after])


def read_tum(path: str | Path, t0_ns: int = 0, *, has_heading: bool = True) -> Trajectory:
    """Read a TUM file (``t x y z qx qy qz qw``, absolute seconds) as planar poses, in seconds after ``t0_ns``.

    InputError names file and row if a row is invalid or timestamps do not increase; also if heights vary by more than
    :data:`factorgraph_loc.model.planar.MOST`.
    """
    rows, t_ns, table = read_tum_rows(Path(path))
    poses = on_floor(path, table[:, :3], rotations_of(path, rows, table[:, 3:]), [])
    stuck = np.flatnonzero(np.diff(t_ns) <= 0) + 1
    if len(stuck):
        i = int(stuck[0])
        raise bad_field(path, "t", f"{t_ns[i]} ns", "a stamp after that of the row before", row=int(rows[i]))
    return Trajectory(np.asarray((t_ns - t0_ns) / 1e9, dtype=float), poses, has_heading=has_heading)


def read_tum_rows(path: Path) -> tuple[Integers, Integers, Array]:
    """The rows of a TUM file in any order: line numbers (N,), timestamps (N,) in nanoseconds, and (N, 7) x, y, z [m] and the
    quaternion x, y, z, w."""
    rows: list[int] = []
    stamps: list[int] = []
    values: list[list[float]] = []
    lines = read_text(path).split("\n")
    for row, line in enumerate(lines, start=1):
        parts = line.split()
        if not parts or parts[0].startswith("#"):
            continue
        if len(parts) != 8:
            raise bad_field(path, "row", line.strip(), "8 values: t x y z qx qy qz qw", row=row)
        try:
            stamps.append(nanoseconds(parts[0]))
            values.append([float(p) for p in parts[1:]])
        except (ValueError, OverflowError):
            raise bad_field(path, "row", line.strip(), "8 finite numbers", row=row) from None
        rows.append(row)
    if not rows:
        raise InputError(f"{path}: contains no poses, expected at least one row")
    table = np.array(values)
    bad = np.flatnonzero(~np.all(np.isfinite(table), axis=1))
    if len(bad):
        raise bad_field(path, "row", lines[rows[bad[0]] - 1].strip(), "8 finite numbers", row=rows[bad[0]])
    numbers = np.array(rows, dtype=np.int64)
    for column, found in zip(POSES.columns[1:8], table.T, strict=True):
        column.require(path, numbers, found)
    return numbers, np.array(stamps, dtype=np.int64), table


def write_tum(trajectory: Trajectory, path: str | Path, t0_ns: int = 0) -> None:
    """Write a TUM file with absolute timestamps in decimal seconds."""
    rows = []
    for t, (x, y, heading) in zip(trajectory.t, trajectory.poses, strict=True):
        qz, qw = np.sin(heading / 2.0), np.cos(heading / 2.0)
        rows.append(f"{decimal_seconds(t, t0_ns)} {x:.9f} {y:.9f} 0 0 0 {qz:.12f} {qw:.12f}\n")
    write_text(Path(path), "".join(rows))


def decimal_seconds(t: float, t0_ns: int) -> str:
    """A time ``t`` [s] after ``t0_ns`` as absolute decimal seconds, to the nanosecond."""
    t_ns = t0_ns + round(t * 1e9)
    sign, (whole, fraction) = "-" if t_ns < 0 else "", divmod(abs(t_ns), 10**9)
    return f"{sign}{whole}.{fraction:09d}"


def nanoseconds(stamp: str) -> int:
    """A timestamp in decimal seconds as nanoseconds, exact for absolute times."""
    whole, _, fraction = stamp.partition(".")
    if whole.lstrip("+-").isdigit() and (fraction == "" or fraction.isdigit()):
        ns = int((fraction + "000000000")[:9])
        total = int(whole) * 10**9 + (-ns if whole.startswith("-") else ns)
    else:
        total = round(float(stamp) * 1e9)
    if abs(total) > LATEST:
        raise OverflowError(f"{stamp} s is beyond 64 bits of nanoseconds")
    return total
