"""Reading, writing and conversion of trajectories, alike for those on a floor and in space."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.plugins import FILES, load
from factors.se2 import Array, Integers

if TYPE_CHECKING:
    import polars as pl

    from factorgraph_loc.model.pose_path import PosePath

KITTI = ".kitti"


class Exchange:
    """What trajectories have in common: files, tables, and the types of other programs.

    Times are seconds after ``t0_ns``, nanoseconds since 1970; files, evo and ROS messages have absolute times.
    """

    @classmethod
    def read(cls, source: str | Path, t0_ns: int = 0) -> Self:
        """The trajectory that ``source`` names, as for ``fgloc score``: a file in TUM or EuRoC format, ``BAG:TOPIC``,
        ``BAG:/tf:PARENT.CHILD``, the folder of a run, or a log with a reference.

        InputError describes what is invalid in one line: also poses without times (KITTI).
        """
        return cls._of(load(FILES["read_trajectory"])(source), t0_ns)

    def write(self, path: str | Path, t0_ns: int = 0) -> None:
        """Write a file in TUM format, or in KITTI format with times beside it if the name ends with .kitti."""
        if Path(path).suffix == KITTI:
            load(FILES["write_kitti"])(self, Path(path))
        else:
            self._write_tum(Path(path), t0_ns)

    @classmethod
    def from_evo(cls, trajectory: Any, t0_ns: int = 0) -> Self:
        """A trajectory of evo (``PoseTrajectory3D``). InputError if it has no times, or they do not increase."""
        return cls._of(load(FILES["from_evo"])(trajectory), t0_ns)

    def to_evo(self, t0_ns: int = 0) -> Any:
        """The trajectory as evo's ``PoseTrajectory3D``; InputError if evo is not installed."""
        return load(FILES["to_evo"])(self._path(t0_ns))

    @classmethod
    def from_ros(cls, messages: Any, t0_ns: int = 0) -> Self:
        """The poses of a ``nav_msgs/Path``, or of several messages: ``PoseStamped``, ``PoseWithCovarianceStamped``, ``Odometry``,
        ``TransformStamped``, or ``PointStamped`` without rotations.

        Messages of rclpy or rosbags, for example; their headers have the times. InputError names the invalid message.
        """
        return cls._of(load(FILES["from_ros"])(messages), t0_ns)

    def to_ros(self, frame_id: str = "map", t0_ns: int = 0) -> Any:
        """The trajectory as a ``nav_msgs/Path``, of ROS 2 where its environment is sourced, else of the library rosbags.

        InputError if there is neither.
        """
        return load(FILES["to_ros"])(self._path(t0_ns), frame_id)

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
        """The poses as an array with a row for each."""

    @classmethod
    def from_polars(cls, table: pl.DataFrame) -> Self:
        """A trajectory from the columns that :meth:`to_polars` gives; others are ignored. InputError if one is missing, or has
        values that are no numbers."""
        if missing := [name for name in cls._columns() if name not in table.columns]:
            raise InputError(f"the table has no column {missing[0]}, expected {', '.join(cls._columns())}")
        return cls.from_numpy(numbers(table, cls._columns()))

    def to_polars(self) -> pl.DataFrame:
        """The poses as a table with a row for each."""
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
    def _of_path(cls, path: PosePath, t0_ns: int) -> Self:
        """The trajectory with the poses of a path, whose times increase."""

    @abstractmethod
    def _write_tum(self, path: Path, t0_ns: int) -> None: ...

    def _path(self, t0_ns: int) -> PosePath:
        from factorgraph_loc.model.pose_path import path_of  # noqa: PLC0415 - which imports trajectories

        return path_of(self, "the trajectory", t0_ns)  # type: ignore[arg-type]

    @classmethod
    def _of(cls, path: PosePath, t0_ns: int) -> Self:
        if path.t_ns is None:
            raise InputError(f"{path.name}: has poses without times, expected poses with times")
        require_times(path.name, path.t_ns)
        return cls._of_path(path, t0_ns)


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
