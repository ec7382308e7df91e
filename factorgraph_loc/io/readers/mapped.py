"""The reader of folders with tables of other programs. The manifest maps the columns of each table to fields."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.column_mapping import ColumnMapping, TableFolder, TimedMapping, read_mapped
from factorgraph_loc.files.columns import ANGLE, STAMPS, Table, named
from factorgraph_loc.files.models import FileModel, add_fields
from factorgraph_loc.files.several import by_name, one_or_several
from factorgraph_loc.files.tables import TableRows
from factorgraph_loc.io.motions import odometry_stream
from factorgraph_loc.io.native import native
from factorgraph_loc.io.native.rig_file import DEFAULT_RIG, default_rig
from factorgraph_loc.io.native.world_file import parse_world
from factorgraph_loc.io.readers.mapped_motion import OdometryFile, ReferenceFile, read_odometry, read_reference
from factorgraph_loc.io.readers.mapped_rfid import RfidFile, joined, read_all_reads
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.measurement import Stream
from factorgraph_loc.model.planar import Turned, about_z
from factorgraph_loc.model.sections import several
from factorgraph_loc.sensors.camera.measurement import make_images
from factorgraph_loc.sensors.odometry.jumps import without_jumps
from factorgraph_loc.sensors.odometry.measurement import IMU, YawRateStream
from factorgraph_loc.sensors.rfid.tables import ROUND_GAP, ReadsByRound, read_rounds
from factorgraph_loc.sensors.tables import Reading, native_tables
from factorgraph_loc.text import listed, notice
from factors import se2
from factors.se2 import Array

RATES = ("wx", "wy", "wz")
FILE_NAME = named("file_name", "a name in the table of the sensor")
MAP_NAME = named("name", "a name in the map")
RATE = replace(IMU["w"], may_lack=True)  # turn rate about one of three axes, which may be missing in a row


class NamesFile(ColumnMapping):
    """Settings of a table that translates names used by a sensor to names in the map. ``columns`` has two fields:
    ``file_name``, a name in the table of the sensor, and ``name``, the name in the map."""


class NamedFile(TimedMapping):
    """Settings of a table of a sensor. Each row of the table names an object of the map, such as a landmark."""

    names: NamesFile | None = None
    """table that translates the names in the file to those in the map; rows with names that it lacks are skipped"""


class ImuFile(TimedMapping, Turned):
    """Settings of the table of an IMU. The fields in ``columns`` are t and w, the turn rate about the vertical axis; or
    t, wx, wy and wz, the angular velocity in the IMU frame. ``axes`` and ``mounting`` give its orientation."""


class ImageFile(TimedMapping):
    """Settings of the table of images."""

    folder: str = "."
    """folder of the images, by default the folder of the log"""


class Options(FileModel):
    """Settings of all tables of a log. ``rfid``: the reads of one RFID reader. ``readers``: the reads of several RFID
    readers, by names that the user chooses."""

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
    """Return the type annotation of the settings for the table ``name``."""
    kind = NamedFile if _has_names(native_tables()[name][1]) else TimedMapping
    return one_or_several(kind) if name in several() else kind | None


OTHERS = [name for name in native_tables() if name not in Options.model_fields]  # tables without options of their own
add_fields(Options, {name: (_type_of(name), None) for name in OTHERS}, after="camera")


def read(path: Path | None, options: Options) -> Log:
    """Return the log in the folder ``path`` with tables of other programs. ``options``: the columns of the tables.

    Its t = 0 is the first timestamp of the sensors. Raises InputError with file, row and column of an invalid value.
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
    odometry_t_ns, moves = read_odometry(folder, options.odometry)
    tables = {
        name: _table(folder, native_tables()[kind][1], mapping)
        for kind in ("imu", "camera", *OTHERS)
        for name, mapping in by_name(kind, getattr(options, kind)).items()
    }
    rounds = _rounds(folder, options)
    stamps = [odometry_t_ns, *(table.t_ns for table in tables.values()), *([rounds.end_ns] if rounds else [])]
    t0_ns = min(int(t_ns.min()) for t_ns in stamps)
    streams: dict[str, Stream] = {"odometry": odometry_stream(odometry_t_ns, moves, t0_ns, options.odometry, warnings)}
    if options.camera is not None:
        images = folder.file(options.camera.folder)
        streams["camera"] = make_images(tables.pop("camera"), t0_ns, warnings, images)
    streams |= native.streams_of(tables, Reading(DEFAULT_RIG, t0_ns, warnings))
    if isinstance(gyro := streams.get("imu"), YawRateStream) and options.imu is not None:
        streams["imu"] = without_jumps(gyro, options.imu, warnings)
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
    """Read the file that ``mapping`` names in ``folder``. Return its rows with the fields of a table in ``tables``.

    The first of ``tables`` is used for which ``mapping`` has all required fields."""
    shapes = tuple(_fields(table, mapping) for table in tables)
    columns = {column.name: column for table in tables for column in table.columns}
    if isinstance(mapping, ImuFile):
        shapes, columns = (*shapes, ("t", *RATES)), columns | {name: replace(RATE, name=name) for name in RATES}
    cells = folder.read(mapping, shapes, columns)
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
    """Return the rows of ``table`` with names translated to names in the map.

    ``naming``: the description of the table of translations. Rows with a name that this table lacks are skipped, with a
    warning in ``folder.warnings``."""
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
    """Read the table that ``naming`` describes. Return the name in the map for each name in the table of a sensor.

    Raises InputError if a name is listed twice."""
    mapped = read_mapped(path, naming, (("file_name", "name"),))
    known: dict[str, str] = {}
    pairs = zip(mapped.names("file_name", FILE_NAME), mapped.names("name", MAP_NAME), strict=True)
    for i, (name, meaning) in enumerate(pairs):
        if name in known:
            raise mapped.invalid("file_name", i, "each name once")
        known[name] = meaning
    return known


def _fields(table: Table, mapping: TimedMapping) -> tuple[str, ...]:
    """Return the fields to read: all that ``table`` requires, and the optional ones that ``mapping`` has."""
    return "t", *(c.name for c in table.columns[1:] if not c.may_lack or c.name in mapping.columns)


def _about_z(rows: TableRows, mapping: ImuFile, numbers: dict[str, Array]) -> Array:
    if "w" not in numbers:
        return about_z(rows.path, rows.rows, np.column_stack([numbers[n] for n in RATES]), mapping.turned())
    if mapping.is_given():
        raise InputError(
            f"{rows.path}: axes or mounting is given, but columns lacks wx, wy, wz: add them, or remove axes and mounting"
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
