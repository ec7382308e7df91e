"""UTIAS MRCLAM (Leung, Halpern, Barfoot, Liu, IJRR 30(8), 2011): one robot of a folder of ``.dat`` files.

Landmarks are named by their subject number, to which the barcode numbers of sightings are mapped.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files import checks
from factorgraph_loc.files.models import FileModel, inside, parse_model
from factorgraph_loc.io.native.rig_file import DEFAULT_RIG
from factorgraph_loc.io.readers.pose_file import read_columns
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.measurement import Stream
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeStream
from factorgraph_loc.sensors.landmarks.settings import Landmark
from factorgraph_loc.sensors.odometry.measurement import VelocityStream
from factors import se2

MICROSECONDS = 1e6  # per second: files have milliseconds, and doubles near 10^9 s do not resolve nanoseconds
ROBOTS = range(1, 6)  # subject numbers; higher ones are landmarks


class Options(FileModel):
    """The options of the reader."""

    robot: Annotated[int, Field(ge=1, le=5)]
    """subject number of the robot"""


def read(path: Path | None, options: Options) -> Log:
    """The run of one robot; t = 0 at its first odometry. InputError names file and row."""
    if path is None or not path.is_dir():
        raise InputError(f"{path}: is not a folder, expected that of the .dat files")
    warnings: list[str] = []
    prefix = f"Robot{options.robot}"
    file = inside(path, f"{prefix}_Odometry.dat", path)
    table, rows = read_columns(file, ("time", "forward velocity", "angular velocity"))
    if len(rows) == 0:
        raise InputError(f"{file}: contains no rows: the log has no odometry, which every estimator needs")
    t_ns = checks.stamps(file, rows, table[:, 0], per_second=MICROSECONDS)
    keep = checks.in_order(file, rows, t_ns, warnings)
    t0_ns = int(t_ns[0])
    streams: dict[str, Stream] = {
        "odometry": VelocityStream(checks.seconds(t_ns[keep], t0_ns), table[keep, 1], table[keep, 2])
    }
    if inside(path, f"{prefix}_Measurement.dat", path).is_file():
        sightings = read_sightings(path, prefix, t0_ns, warnings)
        if len(sightings.t):
            streams["bearing_range"] = sightings
    reference = None
    if (file := inside(path, f"{prefix}_Groundtruth.dat", path)).is_file():
        reference = read_reference(file, t0_ns, warnings)
    return Log(
        name=f"{path.name}-robot{options.robot}",
        rig=DEFAULT_RIG,
        world=read_landmarks(inside(path, "Landmark_Groundtruth.dat", path)),
        streams=streams,
        reference=reference,
        t0_ns=t0_ns,
        warnings=tuple(warnings),
    )


def read_landmarks(file: Path) -> World:
    """The map: landmarks by subject number, with the larger of the survey's standard deviations in x and y."""
    table, rows = read_columns(file, ("subject", "x", "y", "x std-dev", "y std-dev"))
    landmarks: dict[str, Landmark] = {}
    for row, (subject, x, y, sigma_x, sigma_y) in zip(rows, table, strict=True):
        name = str(whole(file, row, "subject", subject))
        if name in landmarks:
            raise bad_field(file, "subject", name, "each subject once", row=int(row))
        if not 0.0 <= max(sigma_x, sigma_y) <= 100.0:
            raise bad_field(file, "std-dev", float(max(sigma_x, sigma_y)), "0 to 100 m", row=int(row))
        told = {"x": x, "y": y, "sigma": max(sigma_x, sigma_y)}
        landmarks[name] = parse_model(Landmark, told, f"{file}:{row}")
    return World(name="mrclam", landmarks=landmarks)


def read_barcodes(file: Path) -> dict[int, int]:
    """Subject number by barcode number."""
    table, rows = read_columns(file, ("subject", "barcode"))
    subjects: dict[int, int] = {}
    for row, (subject, barcode) in zip(rows, table, strict=True):
        code = whole(file, row, "barcode", barcode)
        if code in subjects:
            raise bad_field(file, "barcode", code, "each barcode once", row=int(row))
        subjects[code] = whole(file, row, "subject", subject)
    return subjects


def read_sightings(folder: Path, prefix: str, t0_ns: int, warnings: list[str]) -> BearingRangeStream:
    """The landmarks that the robot saw; other robots and unknown barcodes are counted and skipped."""
    file = inside(folder, f"{prefix}_Measurement.dat", folder)
    table, rows = read_columns(file, ("time", "barcode", "range", "bearing"))
    if len(rows) == 0:
        warnings.append(f"{file}: contains no rows")
    subjects = read_barcodes(inside(folder, "Barcodes.dat", folder))
    checks.require_above_zero(file, rows, "range", table[:, 2])
    seen = [subjects.get(whole(file, r, "barcode", c)) for r, c in zip(rows, table[:, 1], strict=True)]
    robots = sum(subject in ROBOTS for subject in seen)
    strangers = sum(subject is None for subject in seen)
    if robots or strangers:
        warnings.append(f"{file}: skipped {robots} sightings of other robots and {strangers} of unknown barcodes")
    landmark = np.array([subject is not None and subject not in ROBOTS for subject in seen], dtype=bool)
    names = [str(subject) for subject, kept in zip(seen, landmark, strict=True) if kept]
    table, rows = table[landmark], rows[landmark]
    t_ns = checks.stamps(file, rows, table[:, 0], per_second=MICROSECONDS)
    keep = checks.sightings_in_order(file, rows, t_ns, names, warnings)
    return BearingRangeStream(
        checks.seconds(t_ns[keep], t0_ns), [names[i] for i in keep], table[keep, 2], se2.wrap(table[keep, 3])
    )


def read_reference(file: Path, t0_ns: int, warnings: list[str]) -> Trajectory | None:
    """The poses of the motion capture; gaps are kept."""
    table, rows = read_columns(file, ("time", "x", "y", "orientation"))
    if len(rows) == 0:
        warnings.append(f"{file}: contains no rows")
        return None
    t_ns = checks.stamps(file, rows, table[:, 0], per_second=MICROSECONDS)
    keep = checks.in_order(file, rows, t_ns, warnings)
    poses = table[keep, 1:]
    poses[:, 2] = se2.wrap(poses[:, 2])
    return Trajectory(checks.seconds(t_ns[keep], t0_ns), poses)


def whole(file: Path, row: int, field: str, value: float) -> int:
    """A number as an integer; InputError if it is not whole."""
    if not float(value).is_integer():
        raise bad_field(file, field, float(value), "a whole number", row=int(row))
    return int(value)
