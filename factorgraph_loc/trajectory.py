"""Stamped planar poses with covariances; interpolation; the TUM text format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files import write_text
from factors import se2
from factors.se2 import Array


@dataclass(frozen=True)
class Trajectory:
    """``t`` (N,) seconds, strictly increasing; ``poses`` (N, 3) robot in world; ``covariances`` (N, 3, 3) of (x, y, heading) in
    the world's frame, or None. ``has_heading`` is False where the source's heading means nothing and is not scored."""

    t: Array
    poses: Array
    covariances: Array | None = None
    has_heading: bool = True

    def __post_init__(self) -> None:
        if self.poses.shape != (len(self.t), 3):
            raise ValueError(f"poses have shape {self.poses.shape}, expected ({len(self.t)}, 3)")
        if len(self.t) > 1 and not np.all(np.diff(self.t) > 0.0):
            raise ValueError("stamps of a trajectory must increase")

    def __len__(self) -> int:
        return len(self.t)

    def at(self, t: Array, *, max_gap: float = np.inf) -> Array:
        """Poses (M, 3) at times ``t`` (M,), along the arc between neighbours; NaN outside and in gaps above ``max_gap``."""
        t = np.asarray(t, dtype=float)
        out = np.full((len(t), 3), np.nan)
        if len(self.t) == 0:
            return out
        after = np.clip(np.searchsorted(self.t, t, side="left"), 0, len(self.t) - 1)
        exact = self.t[after] == t
        before = np.where(exact, after, np.maximum(after - 1, 0))
        gap = self.t[after] - self.t[before]
        valid = (t >= self.t[0]) & (t <= self.t[-1]) & (gap <= max_gap + 1e-9)
        fraction = np.where(gap > 0.0, (t - self.t[before]) / np.where(gap > 0.0, gap, 1.0), 0.0)
        start = self.poses[before]
        twist = se2.log(se2.between(start, self.poses[after]))
        out[valid] = se2.compose(start, se2.exp(fraction[:, None] * twist))[valid]
        return out


def read_tum(path: Path, t0_ns: int = 0, *, has_heading: bool = True) -> Trajectory:
    """Read a TUM file (``t x y z qx qy qz qw``, absolute seconds) as planar poses, in seconds after ``t0_ns``."""
    times: list[float] = []
    poses: list[tuple[float, float, float]] = []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error
    for row, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        parts = line.split()
        if len(parts) != 8:
            raise bad_field(path, "row", line, "8 values: t x y z qx qy qz qw", row=row)
        try:
            x, y, _, qx, qy, qz, qw = (float(p) for p in parts[1:])
            t = seconds_after(parts[0], t0_ns)
        except ValueError:
            raise bad_field(path, "row", line, "8 numbers", row=row) from None
        if not np.all(np.isfinite((t, x, y, qx, qy, qz, qw))):
            raise bad_field(path, "row", line, "finite numbers", row=row)
        if times and t <= times[-1]:
            raise bad_field(path, "t", parts[0], "a stamp after that of the row before", row=row)
        times.append(t)
        poses.append((x, y, np.arctan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))))
    if not times:
        raise InputError(f"{path}: holds no poses, expected at least one row")
    return Trajectory(np.array(times), np.array(poses), has_heading=has_heading)


def write_tum(trajectory: Trajectory, path: Path, t0_ns: int = 0) -> None:
    """Write a TUM file with absolute stamps in decimal seconds."""
    rows = []
    for t, (x, y, heading) in zip(trajectory.t, trajectory.poses, strict=True):
        t_ns = t0_ns + round(t * 1e9)
        qz, qw = np.sin(heading / 2.0), np.cos(heading / 2.0)
        rows.append(f"{t_ns // 10**9}.{t_ns % 10**9:09d} {x:.9f} {y:.9f} 0 0 0 {qz:.12f} {qw:.12f}\n")
    write_text(path, "".join(rows))


def seconds_after(stamp: str, t0_ns: int) -> float:
    """A stamp in decimal seconds, as seconds after ``t0_ns``, without losing nanoseconds of an absolute time."""
    whole, _, fraction = stamp.partition(".")
    if whole.lstrip("+-").isdigit() and (fraction == "" or fraction.isdigit()):
        ns = int((fraction + "000000000")[:9])
        total = int(whole) * 10**9 + (-ns if whole.startswith("-") else ns)
        return (total - t0_ns) * 1e-9
    return float(stamp) - t0_ns * 1e-9
