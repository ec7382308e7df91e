"""The reader of the Plaza logs in the gtsam wheel: odometry and ranges to radio beacons.

Data set: Djugash, Hamner, Roth, JFR 26(9), 2009.
"""

import io
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError, bad_field, require
from factorgraph_loc.files import bounded, checks
from factorgraph_loc.files.models import FileModel, parse_model
from factorgraph_loc.files.tables import TableRows
from factorgraph_loc.io.native.rig_file import DEFAULT_RIG
from factorgraph_loc.model.log import NOT_READ, Log
from factorgraph_loc.model.measurement import Stream
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.landmarks.measurement import BEARING_RANGE, Landmark
from factorgraph_loc.sensors.odometry.measurement import IncrementStream
from factorgraph_loc.sensors.tables import stream_of
from factorgraph_loc.text import Notice, listed, notice
from factors import se2
from factors.se2 import Array

# number of columns by array of the file: odometry (DR), ranges (TD), ground truth (GT) and beacons (TL)
FIELDS = {"DR": 3, "TD": 4, "GT": 4, "TL": 3}

# for each run: rad added to the heading of the reference, so that positive distances are forward
HEADING_OFFSET = {1: 0.0, 2: math.pi}
# for each run: whether the heading of the reference is measured; in run 1 it is integrated from the odometry
HAS_HEADING = {1: False, 2: True}


class Options(FileModel):
    """The options of the reader ``plaza``."""

    run: Annotated[int, Field(ge=1, le=2)]
    """number of the run"""


def read(path: Path | None, options: Options) -> Log:
    """Return the log of the run ``options.run`` from the file ``path``, by default the file in the gtsam wheel.

    Its t = 0 is the first row of the ground truth. Raises InputError with the file, the array, and the row, counted
    from 1.
    """
    file = path or shipped(options.run)
    fields, unread = read_matlab(file, FIELDS)
    warnings: list[Notice] = []
    truth, driven, observed = (
        _rows(f"{file}:{name}", fields[name], columns)
        for name, columns in (("GT", "t x y heading"), ("DR", "t dx dtheta"), ("TD", "t unused beacon range"))
    )
    keep = checks.in_order(truth.path, truth.rows, truth.t_ns, warnings)
    truth = truth.rows_at(keep)
    t0_ns = int(truth.t_ns[0])
    heading = se2.wrap(truth.numbers["heading"] + HEADING_OFFSET[options.run])
    poses = np.column_stack((truth.numbers["x"], truth.numbers["y"], heading))
    return Log(
        name=f"plaza{options.run}",
        rig=DEFAULT_RIG,
        world=beacons(f"{file}:TL", fields["TL"]),
        streams={"odometry": increments(driven, t0_ns, warnings), "bearing_range": ranges(observed, t0_ns, warnings)},
        reference=Trajectory(checks.seconds(truth.t_ns, t0_ns), poses, has_heading=HAS_HEADING[options.run]),
        t0_ns=t0_ns,
        warnings=tuple(warnings),
        metadata={NOT_READ: listed([*unread, "TD: column 2"])},
    )


def read_matlab(path: Path, fields: Mapping[str, int]) -> tuple[dict[str, Array], list[str]]:
    """Return arrays of a MATLAB file (version 5 to 7) by name, and a list of the names of all other arrays.

    ``fields``: the number of columns of each array to read, by name. Raises InputError with the file and the name of a
    missing, invalid or too large array.
    """
    from scipy.io import loadmat, whosmat  # noqa: PLC0415 - slow to import

    content = bounded.read_bytes(path, bounded.DATA)
    with bounded.foreign(path, "is not a MATLAB file (of version 5 to 7)"):
        declared = {name: (shape, kind) for name, shape, kind in whosmat(io.BytesIO(content))}
        sizes = [math.prod(declared[name][0]) * 8 for name in fields if name in declared]
        bounded.require_size(path, "its size in bytes when unpacked", sum(sizes), bounded.DATA)
        arrays = loadmat(io.BytesIO(content), variable_names=list(fields))
    for name, columns in fields.items():
        if name not in arrays:
            raise InputError(f"{path}: {name} is missing")
        if not isinstance(arrays[name], np.ndarray) or arrays[name].dtype.kind not in "fiu":
            raise InputError(f"{path}: {name} is of type {declared[name][1]}, expected rows of {columns} real numbers")
        if arrays[name].ndim != 2 or arrays[name].shape[1] != columns or not len(arrays[name]):
            raise InputError(f"{path}: {name} has shape {arrays[name].shape}, expected rows of {columns} numbers")
    return {name: arrays[name].astype(float) for name in fields}, [name for name in declared if name not in fields]


def shipped(run: int) -> Path:
    """Return the path of a run's file in the gtsam wheel. Raises InputError if the installed gtsam lacks it."""
    import gtsam  # noqa: PLC0415 - slow to import, and needed here only

    try:
        return Path(gtsam.findExampleDataFile(f"Plaza{run}_.mat"))  # type: ignore[no-untyped-call]
    except RuntimeError as error:
        raise InputError(f"Plaza{run}_.mat: is not in the installed gtsam: give the path of the file") from error


def _rows(source: str, table: Array, columns: str) -> TableRows:
    """Return the rows of ``table`` (N, K), whose first column is the time [s]. Raises InputError if a number is not finite.

    ``columns``: the names of the K columns, separated by spaces."""
    rows = np.arange(1, len(table) + 1, dtype=np.int64)
    names = columns.split()
    checks.require_finite(source, rows, names, table)
    numbers = dict(zip(names[1:], table[:, 1:].T, strict=True))
    return TableRows(Path(source), rows, checks.stamps(source, rows, table[:, 0]), numbers, {})


def beacons(source: str, table: Array) -> World:
    landmarks: dict[str, Landmark] = {}
    for row, (number, x, y) in enumerate(table, start=1):
        if not np.all(np.isfinite((number, x, y))):
            raise bad_field(source, "row", [float(number), float(x), float(y)], "finite numbers", row=row)
        landmarks[f"{number:g}"] = parse_model(Landmark, {"x": x, "y": y}, f"{source}:{row}")
    return World(name="plaza", landmarks=landmarks)


def increments(driven: TableRows, t0_ns: int, warnings: list[Notice]) -> IncrementStream:
    """Return the odometry increments of a log, from the rows ``driven`` with the columns dx [m] and dtheta [rad].

    If the rows begin after ``t0_ns`` [ns], a row without motion is added at ``t0_ns``. If rows have equal timestamps,
    their motions are composed, and a warning is appended to ``warnings``.
    """
    moves = np.column_stack((driven.numbers["dx"], np.zeros(len(driven.rows)), driven.numbers["dtheta"]))
    t_ns, moves = checks.increments_in_order(driven.path, driven.rows, driven.t_ns, moves, warnings)
    if t_ns[0] > t0_ns:
        moves = np.vstack((np.zeros(3), moves))
        t_ns = np.concatenate(([t0_ns], t_ns))
    return IncrementStream(checks.seconds(t_ns, t0_ns), *np.ascontiguousarray(moves.T))


def ranges(observed: TableRows, t0_ns: int, warnings: list[Notice]) -> Stream:
    """Return ranges to landmarks with times [s] since ``t0_ns`` [ns], sorted by time.

    ``observed``: rows with a landmark and a range [m]. If the order changes, a warning is appended to ``warnings``.
    """
    distance = observed.numbers["range"]
    require(distance > 0.0, observed.path, observed.rows, "range", distance, "more than 0")
    if moved := int(np.count_nonzero(observed.t_ns < np.maximum.accumulate(observed.t_ns))):
        sentence = "{source}: {rows} rows are older than an earlier row: the rows are sorted by time"
        warnings.append(notice("sorted_rows", sentence, observed.path, moved))
    names = {"landmark": [f"{number:g}" for number in observed.numbers["beacon"]]}
    numbers = {"range": distance, "bearing": np.full(len(distance), np.nan)}
    order = np.argsort(observed.t_ns, kind="stable")
    return stream_of(BEARING_RANGE, replace(observed, numbers=numbers, names=names).rows_at(order), t0_ns, warnings)
