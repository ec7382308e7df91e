"""The native format: a folder with ``run.toml``, a CSV or Parquet table per sensor, and ``reference.tum``."""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import checks
from factorgraph_loc.files.columns import require_span
from factorgraph_loc.files.data_root import RUN_FILE
from factorgraph_loc.files.models import FileModel, file_name, inside, parse_model, read_toml, write_toml
from factorgraph_loc.files.row_rules import RowRules
from factorgraph_loc.files.tables import TableRows, read_table, write_table
from factorgraph_loc.files.temporary import sweep, temporary_folder, writing
from factorgraph_loc.io.native.rig_file import default_rig, read_rig, write_rig
from factorgraph_loc.io.native.world_file import parse_world, read_world, write_world
from factorgraph_loc.io.readers.manifests import StartSettings
from factorgraph_loc.io.readers.pose_file import read_pose_file
from factorgraph_loc.maps.points import POINTS_SUFFIX
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.measurement import Stream, of_sensor
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.sections import kind_of, layers
from factorgraph_loc.model.trajectory import Trajectory, write_tum
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.odometry.jumps import without_jumps
from factorgraph_loc.sensors.odometry.measurement import IncrementStream, VelocityStream, YawRateStream
from factorgraph_loc.sensors.registry import channel
from factorgraph_loc.sensors.tables import Reading, Writing, assemble, disassemble, native_table, native_tables
from factorgraph_loc.text import Notice, listed, notice

REFERENCE = "reference.tum"
SUFFIXES = (".csv", ".parquet")
OF_LOGS = (*SUFFIXES, ".toml", ".tum")
_OR_LOG = ", or one with a log in the native format to overwrite"


class Options(FileModel):
    """The native format has no options. The class exists because every reader takes options."""


class RunFile(RowRules):
    """The content of ``run.toml``, the main file of a log in the native format.

    ``rig``, ``world``: the robot and the map, as a table or a file name. ``has_heading``: False if the headings of the
    reference trajectory are invalid. ``start``: a known start pose. ``metadata``: values that are stored with the log.
    """

    PLACE: ClassVar[str] = RUN_FILE
    name: str | None = None
    rig: dict[str, Any] | str | None = None
    world: dict[str, Any] | str | None = None
    has_heading: bool = True
    start: StartSettings | None = None
    metadata: dict[str, str] = Field(default_factory=dict)


def read(path: Path | None, options: Options) -> Log:  # noqa: ARG001 - every reader takes options
    """Return the log in the native format in the folder ``path``. Its t = 0 is the first timestamp of the tables.

    Raises InputError with file, row and field of an invalid value.
    """
    if path is None or not (path / RUN_FILE).is_file():
        raise InputError(f"{path}: has no {RUN_FILE}, expected a folder in the native format")
    run_path = path / RUN_FILE
    run = parse_model(RunFile, read_toml(run_path), run_path)
    warnings: list[Notice] = []
    tables = read_tables(path, warnings, run)
    if "odometry" not in tables:
        if not run_path.read_text(encoding="utf-8").strip():
            raise InputError(f"{run_path}: is empty, expected a manifest, or odometry.csv in its folder")
        raise InputError(f"{path}: has no odometry, which every estimator needs, expected rows in odometry.csv")
    rig = rig_of(run, run_path, tables)
    require_span([(rows.path, rows.rows, rows.t_ns) for rows in tables.values()])
    t0_ns = min(int(rows.t_ns.min()) for rows in tables.values())
    streams = streams_of(tables, Reading(rig, t0_ns, warnings))
    for name, stream in streams.items():
        if isinstance(stream, VelocityStream | IncrementStream | YawRateStream):
            streams[name] = without_jumps(stream, run, warnings)
    return Log(
        name=run.name or path.resolve().name,
        rig=rig,
        world=world_of(run, run_path),
        streams=streams,
        reference=read_reference(path / REFERENCE, t0_ns, run, warnings),
        start=run.start.pose(t0_ns) if run.start else None,
        t0_ns=t0_ns,
        warnings=tuple(warnings),
        metadata=run.metadata,
    )


def rig_of(run: RunFile, source: Path, tables: Iterable[str]) -> Rig:
    if run.rig is None:
        return default_rig(tables)
    if isinstance(run.rig, str):
        return read_rig(inside(source.parent, run.rig, source))
    return parse_model(Rig, run.rig, f"{source} [rig]").placed(source.parent)


def world_of(run: RunFile, source: Path) -> World:
    if run.world is None:
        return World()
    if isinstance(run.world, str):
        return read_world(inside(source.parent, run.world, source))
    return parse_world(run.world, f"{source} [world]", source.parent)


def read_tables(folder: Path, warnings: list[Notice], rules: RowRules) -> dict[str, TableRows]:
    """Return the non-empty tables of sensors in the folder of a log, by the name of the table, such as "odometry".

    Rows that ``rules`` skip are left out. Warnings about these rows and about unknown tables are appended to
    ``warnings``.
    """
    tables = {}
    stems = sorted(file.stem for file in folder.iterdir() if file.suffix in SUFFIXES)
    for name in dict.fromkeys((*native_tables(), *stems)):
        if (known := native_table(name)) is None:
            continue
        files = [folder / f"{name}{suffix}" for suffix in SUFFIXES if (folder / f"{name}{suffix}").is_file()]
        if len(files) > 1:
            raise InputError(f"{folder}: holds both {files[0].name} and {files[1].name}, expected one of them")
        for file in files:
            rows = read_table(inside(folder, file.name, folder), known[1], rules, warnings)
            if rows.left_out:
                warnings.append(checks.unread_columns(file, rows.left_out))
            if len(rows.rows):
                tables[name] = rows
            else:
                warnings.append(notice("no_rows", "{source}: contains no rows", file))
    suffixes = (POINTS_SUFFIX, *(layer.suffix for layer in layers().values() if layer.suffix))
    unread = sorted(
        file.name
        for file in folder.iterdir()
        if file.suffix in SUFFIXES and native_table(file.stem) is None and not file.name.endswith(suffixes)
    )
    if unread:
        warnings.append(notice("unread_files", "{source}: this version does not read {files}", folder, listed(unread)))
    return tables


def streams_of(tables: Mapping[str, TableRows], reading: Reading) -> dict[str, Stream]:
    """Return the measurements of each sensor by the name of the sensor. ``tables``: the parsed tables of a log by name.

    ``reading``: has the rig, the absolute time of t = 0 [ns], and a list that receives warnings.
    """
    rows: dict[str, dict[str, TableRows]] = {}
    for name, table in tables.items():
        if (known := native_table(name)) is not None:
            rows.setdefault(known[0], {})[kind_of(name)] = table
    return {name: of_sensor(assemble(channel(name), table, reading), name) for name, table in rows.items()}


def read_reference(path: Path, t0_ns: int, run: RunFile, warnings: list[Notice]) -> Trajectory | None:
    if not path.is_file():
        return None
    poses = read_pose_file(inside(path.parent, path.name, path.parent), "tum", run)
    warnings += poses.warnings
    return Trajectory(checks.seconds(poses.stamps(), t0_ns), poses.on_floor(warnings), has_heading=run.has_heading)


def write_native(
    log: Log, folder: str | Path, format: Literal["csv", "parquet"] = "csv", *, overwrite: bool = False
) -> None:
    """Write a log atomically as a folder in the native format of this project. ``format``: the file type of the tables.

    ``folder`` must be new or empty. With ``overwrite`` it may also contain a log in the native format, which is
    replaced. Timestamps are exact to the nanosecond, numbers to the last digit. Images are copied. Limitations:
    covariances of the reference are not written, and the start has the larger of its standard deviations in x and y.
    Raises InputError for a log without measurements, and for a log with features of images.
    """
    folder = Path(folder)
    if not log.streams:
        raise InputError(f"{log.name}: has no measurements, which a log needs: `fgloc export` writes trajectories")
    require_new(folder, overwrite=overwrite)
    with writing(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        with temporary_folder(folder) as temporary:
            content = temporary / "log"  # unlike the private temporary folder, it has the permissions of a new folder
            content.mkdir()
            write_files(log, content, format)
            if overwrite and folder.exists():
                folder.replace(temporary / "before")
            content.replace(folder)


def require_new(folder: Path, *, overwrite: bool = False) -> None:
    """Raise InputError if a log cannot be written to ``folder``, because it is not empty.

    With ``overwrite``, the folder may contain a log in the native format, but nothing else. Temporary folders that
    remain from interrupted writing are removed.
    """
    sweep(folder.parent)
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    if not overwrite or not (folder / RUN_FILE).is_file():
        raise InputError(f"{folder}: is not an empty folder, expected a new one{_OR_LOG if overwrite else ''}")
    if foreign := sorted(f.name for f in folder.iterdir() if f.suffix not in OF_LOGS and f.name != "camera"):
        raise InputError(
            f"{folder}: contains {listed(foreign)}, which overwriting would delete: expected only the files of a log"
        )


def write_files(log: Log, folder: Path, format: str) -> None:
    base = file_name(re.sub(r"[^\w.-]+", "_", log.name).strip(".") or "log")
    run: dict[str, Any] = {"name": log.name, "rig": f"{base}.rig.toml", "world": f"{base}.world.toml"}
    write_rig(log.rig, folder / run["rig"])
    write_world(log.world, folder / run["world"])
    context = Writing(log.name, log.t0_ns, folder)
    for name, stream in log.streams.items():
        for table, columns in disassemble(channel(name), stream, context).items():
            file = f"{table}{name.removeprefix(kind_of(name))}.{format}"
            write_table(folder / file, native_tables()[table][1], columns)
    if log.reference is not None:
        run["has_heading"] = log.reference.has_heading
        write_tum(log.reference, folder / REFERENCE, log.t0_ns)
    if log.start is not None:
        run["start"] = {
            **dict(zip(("x", "y", "heading"), log.start.pose.tolist(), strict=True)),
            "sigma_position": float(max(log.start.sigmas[:2])),
            "sigma_heading": float(log.start.sigmas[2]),
            "t_ns": round(log.start.t * 1e9) + log.t0_ns,
        }
    if log.metadata:
        run["metadata"] = dict(log.metadata)
    write_toml(folder / RUN_FILE, run)
