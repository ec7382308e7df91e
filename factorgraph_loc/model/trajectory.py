"""Planar trajectories with covariances, interpolation, and the TUM text format."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import checks
from factorgraph_loc.files.columns import COVARIANCES, symmetric
from factorgraph_loc.files.models import write_text
from factorgraph_loc.model.pose_path import Exchange, PosePath, numbers, upright
from factors import se2
from factors.se2 import Array, Integers

if TYPE_CHECKING:
    import polars as pl


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

    @classmethod
    def of(cls, path: PosePath, t0_ns: int = 0) -> Self:
        """The poses of a path, at times in seconds after ``t0_ns``, nanoseconds since 1970. InputError if it has no times, they do
        not increase, or heights vary."""
        return cls(checks.seconds(path.stamps(), t0_ns), path.on_floor([]), has_heading=path.has_rotations)

    def path(self, name: str, t0_ns: int = 0) -> PosePath:
        """The poses at height 0, with times that count from ``t0_ns``."""
        headings = self.poses[:, 2] if self.has_heading else np.zeros(len(self))
        positions = np.column_stack((self.poses[:, :2], np.zeros(len(self))))
        return PosePath(name, positions, upright(headings), checks.absolute(self.t, t0_ns), self.has_heading)

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


def write_tum(trajectory: Trajectory | PosePath, path: str | Path, t0_ns: int = 0) -> None:
    """Write a TUM file with absolute timestamps in decimal seconds, to the nanosecond. ``t0_ns``: time zero of a trajectory."""
    stamps = checks.absolute(trajectory.t, t0_ns) if isinstance(trajectory, Trajectory) else trajectory.stamps()
    rows = []
    for t_ns, row in zip(stamps.tolist(), trajectory._tum(), strict=True):
        sign, (whole, fraction) = "-" if t_ns < 0 else "", divmod(abs(t_ns), 10**9)
        rows.append(f"{sign}{whole}.{fraction:09d} {row}\n")
    write_text(Path(path), "".join(rows))
