"""The reader of folders with tables of other programs. The manifest maps the columns of each table to fields."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError, require
from factorgraph_loc.files import checks
from factorgraph_loc.files.column_mapping import ColumnMapping, TableFolder, TimedMapping, read_mapped
from factorgraph_loc.files.columns import ANGLE, STAMPS, Table, named
from factorgraph_loc.files.columns import POSES as POSE_COLUMNS
from factorgraph_loc.files.models import FileModel, add_fields
from factorgraph_loc.files.several import by_name, one_or_several
from factorgraph_loc.files.tables import Cells, TableRows
from factorgraph_loc.io import motions
from factorgraph_loc.io.motions import TURNS, WHEELS, odometry_stream
from factorgraph_loc.io.native import native
from factorgraph_loc.io.native.rig_file import DEFAULT_RIG, default_rig
from factorgraph_loc.io.native.world_file import parse_world
from factorgraph_loc.io.readers.mapped_rfid import RfidFile, joined, read_all_reads
from factorgraph_loc.io.readers.pose_file import read_kitti, read_pose_file
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.measurement import Stream
from factorgraph_loc.model.planar import Turned, about_z, on_floor, rotations_of
from factorgraph_loc.model.sections import several
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.camera.measurement import make_images
from factorgraph_loc.sensors.odometry.measurement import IMU, INCREMENTS, VELOCITIES, WAYS
from factorgraph_loc.sensors.odometry.measurement import WHEELS as WHEEL_COLUMNS
from factorgraph_loc.sensors.rfid.tables import ROUND_GAP, ReadsByRound, read_rounds
from factorgraph_loc.sensors.tables import Reading, native_tables
from factorgraph_loc.text import Notice, listed, notice
from factors import se2
from factors.se2 import Array, Integers

QUATERNION = ("qx", "qy", "qz", "qw")
POSES = (("t", "x", "y", "heading"), ("t", "x", "y", *QUATERNION), ("t", "x", "y", "z", *QUATERNION))
ODOMETRY = (
    ("t", "v", "w"),
    ("t", "dx", "dy", "dtheta"),
    *(("t", *wheels) for left in WHEELS for wheels in (motions.wheels_of(left, 2), motions.wheels_of(left, 4))),
    *POSES,
)
LEAST_AROUND = 300.0  # change of heading between rows above which the heading is assumed to wrap at 360, in degrees
COLUMNS = {c.name: c for table in (VELOCITIES, INCREMENTS, WAYS, WHEEL_COLUMNS, POSE_COLUMNS) for c in table.columns}
COLUMNS |= {f"rear_{name}": column for name, column in COLUMNS.items() if name.startswith(("left", "right"))}
RATES = ("wx", "wy", "wz")
FILE_NAME = named("file_name", "a name in the table of the sensor")
MAP_NAME = named("name", "a name in the map")
RATE = replace(IMU["w"], may_lack=True)  # turn rate about one of three axes, which may be missing in a row


class PosesFile(TimedMapping, Turned):
    """A file with poses."""

    format: Literal["columns", "tum", "kitti", "euroc"] = "columns"
    """format of the file: columns for a table with a mapping of columns, or a common format of trajectories"""
    columns: dict[str, str] = Field(default_factory=dict)
    """column of the file for each field, if the format is columns"""
    times: str | None = None
    """file with the timestamps of a KITTI file"""

    def is_in_format(self) -> bool:
        """True if the file is in TUM, KITTI or EuRoC format, not a table with mapped columns."""
        return self.format != "columns" or self.times is not None


class OdometryFile(PosesFile, motions.WheelSizes):
    """The table of odometry. ``columns`` maps t and one of: v, w (speed and turn rate); dx, dy, dtheta (motion since the previous
    row); x, y, and heading or a quaternion (poses, of which only the relative motion is used); left, right (distances of the
    wheels); left_speed, right_speed (speeds); left_angle, right_angle (angles); left_rate, right_rate (angular rates).
    Four wheels also need rear_left, rear_right (rear_left_speed, ...). ``radius`` and ``track`` of the rig ([odometry.wheels]) have
    precedence over these settings."""


class ReferenceFile(PosesFile):
    """The reference."""

    has_heading: bool = True
    """true if the reference measures the heading; false if its headings are meaningless"""


class NamesFile(ColumnMapping):
    """A table that translates names. ``columns`` maps ``file_name``, a name in the table of a sensor, and ``name``, the name in the
    map."""


class NamedFile(TimedMapping):
    """A table of a sensor whose rows name an object of the map, such as a landmark."""

    names: NamesFile | None = None
    """table that translates the names in the file to those in the map; rows with names that it lacks are skipped"""


class ImuFile(TimedMapping, Turned):
    """The table of an IMU. ``columns`` maps t and w, the turn rate about the vertical axis; or t, wx, wy and wz, the angular
    velocity in the frame of the IMU, whose orientation is given by ``axes`` and ``mounting``."""


class ImageFile(TimedMapping):
    """The table of images."""

    folder: str = "."
    """folder of the images, by default the folder of the log"""


class Options(FileModel):
    """The tables of a log. ``rfid`` describes the reads of one RFID reader. ``readers`` replaces it for several RFID readers, each
    with a name that the user chooses."""

    odometry: OdometryFile | None = None
    imu: ImuFile | None = None
    rfid: RfidFile | None = None
    readers: dict[str, RfidFile] = Field(default_factory=dict)
    inventories: TimedMapping | None = None
    """table of inventory rounds: t (the end of a round), antenna, duration; names of antennas are translated as in rfid"""
    camera: ImageFile | None = None
    reference: ReferenceFile | None = None
    world: dict[str, Any] = Field(default_factory=dict)
    """the map, with the same keys as a world file; the files that it names are in the folder of the log"""


def _has_names(tables: Sequence[Table]) -> bool:
    return any(column.kind == "name" for table in tables for column in table.columns)


def _type_of(name: str) -> Any:
    """Return the type of the setting that describes the table ``name``."""
    kind = NamedFile if _has_names(native_tables()[name][1]) else TimedMapping
    return one_or_several(kind) if name in several() else kind | None


OTHERS = [name for name in native_tables() if name not in Options.model_fields]  # tables without options of their own
add_fields(
    Options,
    {name: (_type_of(name), None) for name in OTHERS},
    after="camera",
)


def read(path: Path | None, options: Options) -> Log:
    """Return the log in the folder ``path``. Its t = 0 is the first timestamp of the sensors.

    Raises InputError with file, row and column of an invalid value.
    """
    if path is None:
        raise InputError("mapped: path is missing in the manifest: name the folder of the log's files")
    if not path.is_dir():
        raise InputError(f"{path}: is not a folder: path in the manifest names the folder of the log's files")
    if options.odometry is None:
        raise InputError(
            f"{path}: [options] has no odometry, which every estimator needs: describe its table in [options.odometry]"
        )
    folder = TableFolder(path)
    warnings = folder.warnings
    odometry_t_ns, moves = _odometry(folder, options.odometry)
    tables = {
        name: _table(folder, native_tables()[kind][1], mapping)
        for kind in ("imu", "camera", *OTHERS)
        for name, mapping in by_name(kind, getattr(options, kind)).items()
    }
    rounds = _rounds(folder, options)
    stamps = [odometry_t_ns, *(table.t_ns for table in tables.values()), *([rounds.end_ns] if rounds else [])]
    t0_ns = min(int(t_ns.min()) for t_ns in stamps)
    streams: dict[str, Stream] = {"odometry": odometry_stream(odometry_t_ns, moves, t0_ns)}
    if options.camera is not None:
        images = folder.file(options.camera.folder)
        streams["camera"] = make_images(tables.pop("camera"), t0_ns, warnings, images)
    streams |= native.streams_of(tables, Reading(DEFAULT_RIG, t0_ns, warnings))
    if rounds:
        streams["rfid"] = rounds.stream(t0_ns)
    reference = None
    if (of_reference := options.reference) is not None:
        reference = read_reference(folder, of_reference, t0_ns)
        if reference.t[0] > (stamps[0][-1] - t0_ns) / 1e9 or reference.t[-1] < (stamps[0][0] - t0_ns) / 1e9:
            sentence = (
                "{source}: the reference and the odometry do not overlap in time: they begin at t = {reference:.3f} s and "
                "{odometry:.3f} s; check units.t and clock_offset"
            )
            begins = reference.t[0], (stamps[0][0] - t0_ns) / 1e9
            warnings.append(notice("no_overlap", sentence, of_reference.file, *begins))
    name = path.resolve().name
    return Log(
        name=name,
        rig=default_rig(streams),
        world=parse_world({"name": name, **options.world}, path, path),
        streams=streams,
        reference=reference,
        t0_ns=t0_ns,
        warnings=(*warnings, *folder.left_out()),
    )


def _table(folder: TableFolder, tables: Sequence[Table], mapping: TimedMapping) -> TableRows:
    """Read a file in ``folder`` as a table of the native format, the first of ``tables`` whose fields ``mapping`` maps."""
    shapes = tuple(_fields(table, mapping) for table in tables)
    columns = {column.name: column for table in tables for column in table.columns}
    if isinstance(mapping, ImuFile):
        shapes, columns = (*shapes, ("t", *RATES)), columns | {name: replace(RATE, name=name) for name in RATES}
    cells = folder.read(mapping, shapes)
    known = [columns[name] for name in cells.columns if name != "t"]
    rows = TableRows.of(cells, known, cells.stamps("t", mapping.clock_offset))
    unknown = {name: np.full(len(rows.rows), np.nan) for name, column in columns.items() if column.may_lack}
    numbers = unknown | rows.numbers
    for column in known:
        if column.units is STAMPS:  # a second time of the row, such as the end of an interval, has the same clock
            numbers[column.name] = numbers[column.name] + 1e9 * mapping.clock_offset
        if column.units is ANGLE:
            numbers[column.name] = se2.wrap(numbers[column.name])  # the file may count from 0 to 2 pi
    if isinstance(mapping, ImuFile):
        numbers = {"w": _about_z(rows, mapping, numbers)}
    rows = replace(rows, numbers=numbers)
    if isinstance(mapping, NamedFile) and mapping.names is not None:
        return _in_map(rows, folder, mapping.names)
    return rows


def _in_map(table: TableRows, folder: TableFolder, naming: NamesFile) -> TableRows:
    """Return the rows of a table with names translated to those of the map.

    ``naming`` describes the table of the translations. Rows with a name that it lacks are skipped with a warning.
    """
    path = folder.file(naming.file)
    known = _names(path, naming)
    ((column, names),) = table.names.items()
    kept = np.flatnonzero([name in known for name in names])
    if not len(kept):
        raise InputError(f"{table.path}: no row has a {column} that is listed in {path.name}, such as {listed(known)}")
    if skipped := len(names) - len(kept):
        sentence = "{source}: {rows} rows are skipped: their {column} is not listed in {names}"
        folder.warnings.append(notice("unknown_names", sentence, table.path, skipped, column, path.name))
    selected = table.rows_at(kept)
    return replace(selected, names={column: [known[name] for name in selected.names[column]]})


def _names(path: Path, naming: NamesFile) -> dict[str, str]:
    """Return the name in the map for each name in the table of a sensor. Raises InputError if a name is listed twice."""
    mapped = read_mapped(path, naming, (("file_name", "name"),))
    known: dict[str, str] = {}
    pairs = zip(mapped.names("file_name", FILE_NAME), mapped.names("name", MAP_NAME), strict=True)
    for i, (name, meaning) in enumerate(pairs):
        if name in known:
            raise mapped.invalid("file_name", i, "each name once")
        known[name] = meaning
    return known


def _fields(table: Table, mapping: TimedMapping) -> tuple[str, ...]:
    """Return the fields to read: those that a table requires, and optional ones that ``mapping`` maps."""
    return "t", *(c.name for c in table.columns[1:] if not c.may_lack or c.name in mapping.columns)


def _about_z(rows: TableRows, mapping: ImuFile, numbers: dict[str, Array]) -> Array:
    if "w" not in numbers:
        return about_z(rows.path, rows.rows, np.column_stack([numbers[n] for n in RATES]), mapping.turned())
    if mapping.is_given():
        raise InputError(
            f"{rows.path}: axes or mounting is given, but columns maps no wx, wy, wz: map them, or remove it"
        )
    return numbers["w"]


def _rounds(folder: TableFolder, options: Options) -> ReadsByRound | None:
    path = folder.path
    files = [options.rfid] if options.rfid else list(options.readers.values())
    if options.rfid and options.readers:
        raise InputError(f"{path}: [options] has rfid and readers, expected one of them")
    if not files:
        if options.inventories is not None:
            raise InputError(f"{path}: [options] has inventories, but no rfid: describe the reads in [options.rfid]")
        return None
    tables = [read_all_reads(folder, file) for file in files]
    reads = tables[0] if len(tables) == 1 else joined(path, tables)
    gaps = {file.round_gap for file in files if file.round_gap is not None}
    inventories = None
    if (mapping := options.inventories) is not None:
        if gaps:
            raise InputError(
                f"{path}: round_gap has no effect, because inventories define the rounds: remove one of the two"
            )
        antennas = {name: given for file in files for name, given in file.antennas.items()}
        inventories = _table(folder, native_tables()["inventories"][1], mapping)
        named = [antennas.get(name, name) for name in inventories.names["antenna"]]
        inventories = replace(inventories, names={"antenna": named})
    if len(gaps) > 1:
        raise InputError(
            f"{path}: readers have round_gap {', '.join(f'{gap:g}' for gap in sorted(gaps))}, expected the same for all"
        )
    return read_rounds(reads, inventories, gaps.pop() if gaps else ROUND_GAP, folder.warnings)


def _odometry(folder: TableFolder, options: OdometryFile) -> tuple[Integers, Array]:
    """Return the timestamps (N,) [ns] of the odometry, and its velocities (N, 2) or increments (N, 3).

    Raises InputError with the file and the row of an invalid value.
    """
    path, warnings = folder.file(options.file), folder.warnings
    if options.is_in_format():
        if options.has_sizes():
            raise InputError(f"{path}: format {options.format} has no wheels: remove track, radius and base")
        t_ns, poses = _in_format(folder, options)
        return t_ns, motions.after_rest(motions.between_poses(path, t_ns, poses, warnings))
    mapped = folder.read(options, ODOMETRY)
    side = next((name for name in WHEELS if name in mapped.columns), None)
    wheel_names = motions.wheels_of(side, 4 if f"rear_{side}" in mapped.columns else 2) if side else ()
    if side is None and options.has_sizes():
        raise InputError(
            f"{path}: track, radius or base is given, but columns maps no wheels, such as left and right: map them, or remove "
            "track, radius and base"
        )
    if options.base is not None and len(wheel_names) == 2:
        raise InputError(f"{path}: base is given, but only two wheels are mapped: map rear_{side} too, or remove base")
    size = options.metres(path, side, turns=side in TURNS) if side else 1.0
    t_ns, columns = _columns(mapped, options.clock_offset)
    if "dx" in columns:
        moves = np.column_stack((columns["dx"], columns["dy"], columns["dtheta"]))
        return checks.increments_in_order(path, mapped.rows, t_ns, moves, warnings)
    keep = checks.in_order(path, mapped.rows, t_ns, warnings)
    t_ns = t_ns[keep]
    kept = {name: values[keep] for name, values in columns.items()}
    if "v" in kept:
        return t_ns, np.column_stack((kept["v"], kept["w"]))
    if side is not None:
        wheels = size * np.column_stack([kept[name] for name in wheel_names])
        if side in ("left_speed", "left_rate"):
            return t_ns, motions.of_speeds(path, t_ns, wheels, options, warnings)
        scales = size * np.array([COLUMNS[name].in_unit(options.units.get(name, 1.0))[1] for name in wheel_names])
        moves = motions.between_wheels(path, t_ns, wheels, scales, options, warnings)
    else:
        poses = _planar(path, mapped.rows[keep], kept, options, warnings)
        moves = motions.between_poses(path, t_ns, poses, warnings)
    return t_ns, motions.after_rest(moves)


def read_reference(folder: TableFolder, options: ReferenceFile, t0_ns: int) -> Trajectory:
    """Return the reference trajectory, with times in seconds after ``t0_ns`` [ns].

    Raises InputError with the file and the row of an invalid value.
    """
    path, warnings = folder.file(options.file), folder.warnings
    if options.is_in_format():
        t_ns, poses = _in_format(folder, options)
        return Trajectory(checks.seconds(t_ns, t0_ns), poses, has_heading=options.has_heading)
    mapped = folder.read(options, (*POSES, ("t", "x", "y")))
    if "heading" not in mapped.columns and "qw" not in mapped.columns and options.has_heading:
        raise InputError(
            f"{path}: columns in [options.reference] maps neither heading nor qx, qy, qz, qw: map one of them, or set "
            "has_heading = false"
        )
    t_ns, columns = _columns(mapped, options.clock_offset)
    poses = _planar(path, mapped.rows, columns, options, warnings)
    keep = checks.in_order(path, mapped.rows, t_ns, warnings)
    return Trajectory(checks.seconds(t_ns[keep], t0_ns), poses[keep], has_heading=options.has_heading)


def _in_format(folder: TableFolder, options: PosesFile) -> tuple[Integers, Array]:
    """Return the timestamps (N,) [ns] and the planar poses (N, 3) of a file in TUM, KITTI or EuRoC format."""
    path = folder.file(options.file)
    if options.columns or options.units:
        raise InputError(f"{path}: format {options.format} names its own columns and units: remove columns and units")
    if options.format == "kitti" and options.times is None:
        raise InputError(f"{path}: format is kitti, but times is missing: set it to the file with the timestamps")
    if options.format != "kitti" and options.times is not None:
        raise InputError(f"{path}: times is given, but format is {options.format}, not kitti: remove times")
    turned: Turned = options
    if options.times is not None:
        poses = read_kitti(path, folder.file(options.times))
        if not options.axes:
            turned = Turned(axes="body", mounting=options.mounting)  # the format defines the axes
    else:
        poses = read_pose_file(path, "euroc" if options.format == "euroc" else "tum")
    folder.warnings += poses.warnings
    return poses.stamps() + round(options.clock_offset * 1e9), poses.on_floor(folder.warnings, turned)


def _columns(mapped: Cells, offset: float) -> tuple[Integers, dict[str, Array]]:
    return mapped.stamps("t", offset), {n: mapped.numbers(n, COLUMNS[n]) for n in mapped.columns if n != "t"}


def _planar(path: Path, rows: Integers, columns: dict[str, Array], turned: Turned, warnings: list[Notice]) -> Array:
    if "qw" in columns:
        rotations = rotations_of(path, rows, np.column_stack([columns[name] for name in QUATERNION]))
        places = np.column_stack((columns["x"], columns["y"], columns.get("z", np.zeros(len(rows)))))
        return on_floor(path, places, rotations, warnings, turned)
    if turned.is_given():
        raise InputError(
            f"{path}: axes or mounting is given, but columns maps no qx, qy, qz, qw: map them, or remove it"
        )
    heading = columns.get("heading", np.zeros(len(rows)))
    around = np.abs(np.diff(heading, prepend=heading[0]))
    valid = ~((around > LEAST_AROUND) & (around < 360.0))
    require(valid, path, rows, "heading", heading, 'radians; it wraps at 360 as degrees do: set units.heading = "deg"')
    return np.column_stack((columns["x"], columns["y"], se2.wrap(heading)))
