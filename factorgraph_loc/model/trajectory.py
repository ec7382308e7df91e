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
    """A planar trajectory in the world frame.

    ``t`` (N,): times [s], strictly increasing. ``poses`` (N, 3): x, y [m] and heading [rad] of the robot.
    ``covariances`` (N, 3, 3) of (x, y, heading), or None. ``has_heading``: False if the headings are meaningless.
    """

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
        """Return the planar poses of a path, at times in seconds after ``t0_ns`` [ns since 1970]. Raises InputError if
        the path has no times, if times do not increase, or if heights vary by metres."""
        return cls(checks.seconds(path.stamps(), t0_ns), path.on_floor([]), has_heading=path.has_rotations)

    def path(self, name: str, t0_ns: int = 0) -> PosePath:
        """Return a :class:`PosePath` of the poses at height 0, called ``name``. ``t0_ns``: absolute time of t = 0
        [ns]."""
        headings = self.poses[:, 2] if self.has_heading else np.zeros(len(self))
        positions = np.column_stack((self.poses[:, :2], np.zeros(len(self))))
        return PosePath(name, positions, upright(headings), checks.absolute(self.t, t0_ns), self.has_heading)

    def rows(self, which: Integers | NDArray[np.bool_]) -> Self:
        """Return a trajectory of only the poses at the indices ``which``, or where the mask ``which`` (N,) is True."""
        covariances = None if self.covariances is None else self.covariances[which]
        return replace(self, t=self.t[which], poses=self.poses[which], covariances=covariances)

    def at(self, t: Array, *, max_gap: float = np.inf) -> Array:
        """Return the poses (M, 3) at times ``t`` (M,) [s], interpolated on SE(2). A pose is NaN outside of the
        trajectory, and in a gap longer than ``max_gap`` [s]."""
        out = np.full((len(t), 3), np.nan)
        if len(self.t) == 0:
            return out
        first, last, fraction, valid = neighbours(self.t, t, max_gap)
        start = self.poses[first]
        twist = se2.log(se2.between(start, self.poses[last]))
        out[valid] = se2.compose(start, se2.exp(fraction[:, None] * twist))[valid]
        return out

    def covariances_at(self, t: Array, *, max_gap: float = np.inf) -> Array:
        """Return the covariances (M, 3, 3) at times ``t`` (M,) [s], interpolated linearly.

        A covariance is NaN outside of the trajectory, and in a gap longer than ``max_gap`` [s]. Raises ValueError if
        the trajectory has no covariances.
        """
        if self.covariances is None:
            raise ValueError("the trajectory has no covariances")
        out = np.full((len(t), 3, 3), np.nan)
        if len(self.t) == 0:
            return out
        first, last, fraction, valid = neighbours(self.t, t, max_gap)
        out[valid] = averaged(self.covariances, first, last, fraction)[valid]
        return out

    def to_numpy(self) -> Array:
        """Return the poses as an array (N, 4): t [s], x, y [m], heading [rad]."""
        return np.column_stack((self.t, self.poses))

    @classmethod
    def from_polars(cls, table: pl.DataFrame) -> Self:
        """Return a trajectory from a table with the columns t [s], x, y [m] and heading [rad]. Others are ignored.

        Optional columns of covariances are cov_xx, cov_xy, cov_xh, cov_yy, cov_yh and cov_hh. Raises InputError if a
        column is missing, or if it has values that are not numbers.
        """
        trajectory = super().from_polars(table)
        if not any(name in table.columns for name in COVARIANCES):
            return trajectory
        if missing := [name for name in COVARIANCES if name not in table.columns]:
            raise InputError(f"the table has no column {missing[0]}, expected all or none of {', '.join(COVARIANCES)}")
        return replace(trajectory, covariances=symmetric(list(numbers(table, COVARIANCES).T)))

    def to_polars(self) -> pl.DataFrame:
        """Return a table with the columns of :meth:`from_polars`, with covariances if the trajectory has them."""
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
    """Return the neighbours of the times ``t`` (M,) among sorted timestamps ``stamps`` (N,), N > 0, for interpolation.

    Returns four arrays (M,): the index of the timestamp before, the index of the timestamp after, the fraction of the
    time between them, and a mask. The two indices are equal at a timestamp. The mask is False before the first and
    after the last timestamp, and in gaps longer than ``max_gap`` [s].
    """
    t = np.asarray(t, dtype=float)
    last = np.clip(np.searchsorted(stamps, t, side="left"), 0, len(stamps) - 1)
    first = np.where(stamps[last] == t, last, np.maximum(last - 1, 0))
    gap = stamps[last] - stamps[first]
    valid = (t >= stamps[0]) & (t <= stamps[-1]) & (gap <= max_gap + 1e-9)
    fraction = np.where(gap > 0.0, (t - stamps[first]) / np.where(gap > 0.0, gap, 1.0), 0.0)
    return first, last, fraction, valid


def averaged(covariances: Array, first: Integers, last: Integers, fraction: Array) -> Array:
    """Return ``covariances`` (N, D, D) interpolated linearly at M times, as an array (M, D, D).

    ``first``, ``last`` (M,): indices of the covariances before and after each time. ``fraction`` (M,): 0 at the first
    of them, 1 at the last.
    """
    weight = fraction[:, None, None]
    return np.asarray((1.0 - weight) * covariances[first] + weight * covariances[last])


def write_tum(trajectory: Trajectory | PosePath, path: str | Path, t0_ns: int = 0) -> None:
    """Write a trajectory to a TUM file, with absolute timestamps in seconds that are exact to the nanosecond.

    ``t0_ns``: absolute time [ns] of t = 0 of a :class:`Trajectory`. It is not used for a :class:`PosePath`.
    """
    stamps = checks.absolute(trajectory.t, t0_ns) if isinstance(trajectory, Trajectory) else trajectory.stamps()
    rows = []
    for t_ns, row in zip(stamps.tolist(), trajectory._tum(), strict=True):
        sign, (whole, fraction) = "-" if t_ns < 0 else "", divmod(abs(t_ns), 10**9)
        rows.append(f"{sign}{whole}.{fraction:09d} {row}\n")
    write_text(Path(path), "".join(rows))
