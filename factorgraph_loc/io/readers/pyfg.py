"""The reader of PyFG files, the format of data sets of planar range-aided SLAM.

A file has the odometry of one robot, its ranges to landmarks, and the true poses and landmarks. A range has the time of
its pose. The covariances in the file become the noise of the rig. Format: Papalia and others, "Certifiably correct
range-aided SLAM", IEEE Transactions on Robotics 40, 2024.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from factorgraph_loc.errors import InputError, bad_field, require
from factorgraph_loc.files import checks
from factorgraph_loc.files.models import FileModel, parse_model, read_text
from factorgraph_loc.files.tables import TableRows
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.measurement import Stream
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.landmarks.measurement import BEARING_RANGE, Landmark
from factorgraph_loc.sensors.odometry.measurement import IncrementStream
from factorgraph_loc.sensors.tables import stream_of
from factorgraph_loc.text import Notice, listed, notice
from factors import se2
from factors.se2 import Array, Integers

SUFFIX = ".pyfg"
# the columns of each kind of row; columns in capital letters contain names of variables, other columns numbers
ROWS = {
    "VERTEX_SE2": "t POSE x y theta",
    "VERTEX_XY": "LANDMARK x y",
    "EDGE_SE2": "t FROM TO x y theta cxx cxy cxt cyy cyt ctt",
    "EDGE_RANGE": "t POSE LANDMARK range variance",
}
DIFFERENT = 1.5  # a larger ratio of the largest to the smallest variance gives a warning that the median is used


class Options(FileModel):
    """The reader has no options."""


def read(path: Path | None, _options: Options) -> Log:
    """Return the log in a PyFactorGraph file. Its t = 0 is the time of the first pose.

    Raises InputError at an invalid value, and at a row that does not belong to a single robot in the plane.
    """
    if path is None:
        raise InputError("the reader pyfg needs the path of a file")
    kinds = _parsed(path)
    poses, marks, moves, ranged = (kinds[kind] for kind in ROWS)
    if len(poses.rows) < 2:
        raise InputError(f"{path}: has {len(poses.rows)} rows VERTEX_SE2, expected two or more poses")
    numbers = _numbered(poses)
    _require_chain(moves, poses.names["POSE"])
    landmarks = {
        name: parse_model(Landmark, {"x": x, "y": y}, f"{path}:{row}")
        for name, row, x, y in zip(
            marks.names["LANDMARK"],
            marks.rows.tolist(),
            marks.numbers["x"].tolist(),
            marks.numbers["y"].tolist(),
            strict=True,
        )
    }
    warnings: list[Notice] = []
    t0_ns, t_ns = int(poses.t_ns[0]), poses.t_ns
    steps = np.vstack((np.zeros(3), _table(moves, "x y theta")))
    t_moved, steps = checks.increments_in_order(path, poses.rows, t_ns, steps, warnings)
    keep = checks.in_order(path, poses.rows, t_ns, [])
    truth = _table(poses, "x y theta")[keep]
    truth[:, 2] = se2.wrap(truth[:, 2])
    streams: dict[str, Stream] = {
        "odometry": IncrementStream(checks.seconds(t_moved, t0_ns), *np.ascontiguousarray(steps.T))
    }
    if len(ranged.rows):
        streams["bearing_range"] = stream_of(BEARING_RANGE, _ranges(ranged, numbers, landmarks, t_ns), t0_ns, warnings)
    return Log(
        name=path.stem,
        rig=_rig(moves, ranged, np.diff(t_ns) * 1e-9, warnings),
        world=World(name=path.stem, landmarks=landmarks),
        streams=streams,
        reference=Trajectory(checks.seconds(t_ns[keep], t0_ns), truth),
        t0_ns=t0_ns,
        warnings=tuple(warnings),
    )


def _parsed(path: Path) -> dict[str, TableRows]:
    """Return the rows of a PyFactorGraph file by their first word, such as "EDGE_RANGE".

    Raises InputError at a row whose first word is not in :data:`ROWS`, or with too few or too many values."""
    lines: dict[str, list[tuple[int, list[str]]]] = {kind: [] for kind in ROWS}
    for row, line in enumerate(read_text(path).splitlines(), start=1):
        kind, *values = line.split() or [""]
        if kind in ROWS:
            if len(values) != len(ROWS[kind].split()):
                raise bad_field(path, kind, " ".join(values), ROWS[kind], row=row)
            lines[kind].append((row, values))
        elif kind and not kind.startswith("#"):
            raise bad_field(
                path, "row", kind, f"one of {listed(ROWS)}: other variables and factors are not supported", row=row
            )
    return {kind: _rows(path, ROWS[kind].split(), cells) for kind, cells in lines.items()}


def _rows(path: Path, columns: Sequence[str], lines: Sequence[tuple[int, Sequence[str]]]) -> TableRows:
    rows = np.array([row for row, _ in lines], dtype=np.int64)
    cells = dict(zip(columns, zip(*(values for _, values in lines), strict=True), strict=True)) if lines else {}
    numbers: dict[str, Array] = {}
    for name in (column for column in columns if not column.isupper()):
        values = [_number(path, row, name, cell) for row, cell in zip(rows.tolist(), cells.get(name, ()), strict=True)]
        numbers[name] = np.array(values, dtype=float)
        require(np.isfinite(numbers[name]), path, rows, name, numbers[name], "a finite number")
    t_ns = checks.stamps(path, rows, numbers.pop("t")) if "t" in numbers else np.zeros(len(rows), dtype=np.int64)
    names = {column: list(cells.get(column, ())) for column in columns if column.isupper()}
    return TableRows(path, rows, t_ns, numbers, names)


def _number(path: Path, row: int, name: str, cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        raise bad_field(path, name, cell, "a number", row=row) from None


def _table(rows: TableRows, columns: str) -> Array:
    """Return the numbers (N, K) in K columns of ``rows``. ``columns``: their names, separated by spaces."""
    return np.column_stack([rows.numbers[name] for name in columns.split()])


def _numbered(poses: TableRows) -> dict[str, int]:
    """Return the index of each pose by its name.

    Raises InputError at a repeated name, and at a pose of a second robot, whose name begins with another letter."""
    numbers: dict[str, int] = {}
    robot = poses.names["POSE"][0][:1]
    for i, name in enumerate(poses.names["POSE"]):
        if name[:1] != robot:
            raise bad_field(poses.path, "pose", name, f"poses of one robot, {robot}", row=int(poses.rows[i]))
        if name in numbers:
            raise bad_field(poses.path, "pose", name, "a name that no earlier pose has", row=int(poses.rows[i]))
        numbers[name] = i
    return numbers


def _require_chain(moves: TableRows, poses: Sequence[str]) -> None:
    """Raise InputError unless ``moves`` has exactly one motion from each pose to the next one, in order."""
    expected = list(pairwise(poses))
    pairs = zip(moves.rows.tolist(), moves.names["FROM"], moves.names["TO"], strict=True)
    for i, (row, *pair) in enumerate(pairs):
        if i >= len(expected) or tuple(pair) != expected[i]:
            following = " ".join(expected[i]) if i < len(expected) else "no more"
            wanted = f"{following}: motions from each pose to the next, without loop closures"
            raise bad_field(moves.path, "EDGE_SE2", " ".join(pair), wanted, row=row)
    if len(moves.rows) < len(expected):
        lacking = " ".join(expected[len(moves.rows)])
        raise InputError(f"{moves.path}: has no EDGE_SE2 {lacking}, expected a motion from each pose to the next")


def _ranges(ranged: TableRows, numbers: Mapping[str, int], marks: Mapping[str, Landmark], t_ns: Integers) -> TableRows:
    """Return a table of ranges to landmarks, in order of the poses that they were measured at.

    ``ranged``: the rows of ranges. ``numbers``: the index of each pose by name. ``marks``: the landmarks by name.
    ``t_ns``: the timestamp of each pose. Raises InputError at a range from an unknown pose or to an unknown landmark.
    """
    names = zip(ranged.rows.tolist(), ranged.names["POSE"], ranged.names["LANDMARK"], strict=True)
    for row, pose, mark in names:
        if pose not in numbers:
            raise bad_field(ranged.path, "EDGE_RANGE from", pose, "a pose of the file", row=row)
        if mark not in marks:
            raise bad_field(ranged.path, "EDGE_RANGE to", mark, "a landmark of the file (VERTEX_XY)", row=row)
    at = np.array([numbers[pose] for pose in ranged.names["POSE"]], dtype=np.int64)
    distance = ranged.numbers["range"]
    table = {"range": distance, "bearing": np.full(len(at), np.nan)}
    rows = TableRows(ranged.path, ranged.rows, t_ns[at], table, {"landmark": ranged.names["LANDMARK"]})
    return rows.rows_at(np.argsort(at, kind="stable"))


def _rig(moves: TableRows, ranged: TableRows, durations: Array, warnings: list[Notice]) -> Rig:
    """Return a rig with the noise of odometry and ranges: the median of the noise in the rows ``moves`` and ``ranged``.

    ``durations``: the durations of the motions [s]. If the noise differs between rows, a warning is appended to
    ``warnings``."""
    per_time = {}
    for name, column in {"along": "cxx", "lateral": "cyy", "heading": "ctt"}.items():
        variance = _positive(moves, column)
        per_time[name] = {"per_time": float(np.median(np.sqrt(variance / np.maximum(durations, 1e-3))))}
        _warn_of_different(moves.path, column, variance, warnings)
    content = {"name": moves.path.stem, "sensors": ["odometry", "bearing_range"], "odometry": {"noise": per_time}}
    variance = _positive(ranged, "variance") if len(ranged.rows) else np.ones(1)
    _warn_of_different(ranged.path, "variance", variance, warnings)
    content["bearing_range"] = {"range_sigma": float(np.sqrt(np.median(variance)))}
    return parse_model(Rig, content, moves.path)


def _positive(rows: TableRows, column: str) -> Array:
    require(rows.numbers[column] > 0.0, rows.path, rows.rows, column, rows.numbers[column], "a variance above 0")
    return rows.numbers[column]


def _warn_of_different(path: Path, column: str, variances: Array, warnings: list[Notice]) -> None:
    if variances.max() > DIFFERENT * variances.min():
        median = float(np.median(variances))
        sentence = "{file}: {column} differs between rows, {least:g} to {most:g}: the rig has the median {median:g}"
        warnings.append(notice("different_variances", sentence, path, column, variances.min(), variances.max(), median))
