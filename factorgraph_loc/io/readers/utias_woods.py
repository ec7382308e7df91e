"""The University of Toronto's "Lost in the Woods" (``dataset2.mat``): wheel odometry and a laser that detects known trunks."""

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files import checks
from factorgraph_loc.files.models import FileModel, InUnit, parse_model
from factorgraph_loc.io.native.rig_file import DEFAULT_RIG
from factorgraph_loc.io.readers.left_out import not_read
from factorgraph_loc.io.readers.plaza import read_matlab
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.measurement import Stream
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeStream
from factorgraph_loc.sensors.landmarks.settings import Landmark
from factorgraph_loc.sensors.odometry.measurement import VelocityStream
from factors import se2
from factors.se2 import Array, Integers

LANDMARKS = 17
SERIES = ("t", "v", "om", "x_true", "y_true", "th_true", "true_valid")
FIELDS = {**dict.fromkeys(SERIES, 1), "r": LANDMARKS, "b": LANDMARKS, "l": 2}


class Options(FileModel):
    """The options of the reader."""

    max_range: Annotated[float, Field(gt=0.0), InUnit("m")] = 5.0
    """landmarks farther away are ignored"""


def read(path: Path | None, options: Options) -> Log:
    """The run, with landmarks named 1 to 17. InputError names file, field and row (from 1)."""
    if path is None:
        raise InputError("utias_woods: the path of dataset2.mat is missing")
    fields, others = read_matlab(path, FIELDS)
    count = len(fields["t"])
    for name in (*SERIES, "r", "b"):
        if len(fields[name]) != count:
            raise InputError(f"{path}: {name} has {len(fields[name])} rows, expected {count} as t has")
    rows = np.arange(1, count + 1, dtype=np.int64)
    warnings: list[str] = []
    series = {name: fields[name][:, 0] for name in SERIES}
    for name in ("t", "v", "om"):
        checks.require_finite(path, rows, name, series[name])
    t_ns = checks.stamps(path, rows, series["t"])
    t0_ns = int(t_ns[0])
    keep = checks.in_order(path, rows, t_ns, warnings)
    t = checks.seconds(t_ns, t0_ns)
    streams: dict[str, Stream] = {"odometry": VelocityStream(t[keep], series["v"][keep], series["om"][keep])}
    sightings = read_sightings(path, fields["r"][keep], fields["b"][keep], t[keep], rows[keep], options.max_range)
    if len(sightings.t):
        streams["bearing_range"] = sightings
    else:
        warnings.append(f"{path}: no landmark is nearer than max_range, {options.max_range:g} m")
    return Log(
        name=path.stem,
        rig=DEFAULT_RIG,
        world=read_landmarks(path, fields["l"]),
        streams=streams,
        reference=read_reference(path, series, t, rows, keep),
        t0_ns=t0_ns,
        warnings=tuple(warnings),
        metadata=not_read(others),
    )


def read_landmarks(path: Path, table: Array) -> World:
    if len(table) != LANDMARKS or not np.all(np.isfinite(table)):
        raise bad_field(path, "l", f"{len(table)} rows", f"{LANDMARKS} rows of finite x and y")
    landmarks = {
        str(i): parse_model(Landmark, {"x": x, "y": y}, f"{path}: l:{i}")
        for i, (x, y) in enumerate(table.tolist(), start=1)
    }
    return World(name="woods", landmarks=landmarks)


def read_sightings(path: Path, r: Array, b: Array, t: Array, rows: Integers, max_range: float) -> BearingRangeStream:
    """The landmarks within ``max_range``; ranges ``r`` and bearings ``b`` are (N, 17), and r = 0 means not seen."""
    for name, table in (("r", r), ("b", b)):
        checks.require_finite(path, np.repeat(rows, LANDMARKS), name, table.ravel())
    if np.any(r < 0.0):
        i, j = (int(k) for k in np.argwhere(r < 0.0)[0])
        raise bad_field(path, f"r of landmark {j + 1}", float(r[i, j]), "a range, or 0 if not seen", row=int(rows[i]))
    row, column = np.nonzero((r > 0.0) & (r < max_range))
    names = [str(k + 1) for k in column.tolist()]
    return BearingRangeStream(t[row], names, r[row, column], se2.wrap(b[row, column]))


def read_reference(path: Path, series: dict[str, Array], t: Array, rows: Integers, keep: Integers) -> Trajectory | None:
    """The poses of the motion capture; gaps are kept."""
    valid = keep[series["true_valid"][keep] > 0]
    if len(valid) == 0:
        return None
    for name in ("x_true", "y_true", "th_true"):
        checks.require_finite(path, rows[valid], name, series[name][valid])
    poses = np.column_stack((series["x_true"][valid], series["y_true"][valid], se2.wrap(series["th_true"][valid])))
    return Trajectory(t[valid], poses)
