"""Our own format: a folder with ``run.toml``, a CSV or Parquet table per sensor, and ``reference.tum``."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files import checks
from factorgraph_loc.files.columns import BEARING_RANGE, NEAREST, require_span
from factorgraph_loc.files.models import FileModel, file_name, inside, parse_model, read_toml, write_toml
from factorgraph_loc.files.tables import Table, read_table, write_table
from factorgraph_loc.files.temporary import sweep, temporary_folder
from factorgraph_loc.io.native.default_rig import DEFAULT_RIG
from factorgraph_loc.io.native.rig_file import read_rig, write_rig
from factorgraph_loc.io.native.world_file import parse_world, read_world, write_world
from factorgraph_loc.io.readers.manifests import StartSettings
from factorgraph_loc.maps.points import POINTS_SUFFIX
from factorgraph_loc.model.log import Log, StartPose
from factorgraph_loc.model.planar import on_floor, rotations_of
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.stream import Stream
from factorgraph_loc.model.trajectory import Trajectory, read_tum_rows, write_tum
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.stream import FeatureStream, ImageStream, RightSightingStream, SightingStream
from factorgraph_loc.sensors.camera.tables import IMAGES, PIXELS, make_images, make_pixels, write_images
from factorgraph_loc.sensors.landmarks.stream import BearingRangeStream
from factorgraph_loc.sensors.odometry.stream import IncrementStream, VelocityStream, YawRateStream
from factorgraph_loc.sensors.rfid.map import TAGS_SUFFIX
from factorgraph_loc.sensors.rfid.settings import RfidSettings
from factorgraph_loc.sensors.rfid.stream import RfidStream
from factorgraph_loc.sensors.rfid.tables import INVENTORIES, READS, read_rounds, tables_of
from factorgraph_loc.sensors.twist.stream import TwistStream
from factorgraph_loc.text import listed
from factors.se2 import Array, Integers

RUN_FILE = "run.toml"
REFERENCE = "reference.tum"
VELOCITIES = ("t_ns", "v", "w")
INCREMENTS = ("t_ns", "dx", "dy", "dtheta")
SHAPES: dict[str, tuple[tuple[str, ...], ...]] = {
    "odometry": (VELOCITIES, INCREMENTS),
    "imu": (("t_ns", "w"),),
    "bearing_range": (("t_ns", "landmark", "range", "bearing"),),
    "rfid": READS,
    "inventories": (INVENTORIES,),  # of the sensor rfid too
    "camera": (IMAGES,),
    "sightings": (PIXELS,),
}
ROUND_GAP: float = RfidSettings.model_fields["round_gap"].default
SUFFIXES = (".csv", ".parquet")


class Options(FileModel):
    """The native format has no options."""


class RunFile(FileModel):
    """``run.toml``. ``rig`` and ``world``: a table, or the name of a file below the folder.

    ``has_heading``: whether the heading of the reference means something.
    """

    name: str | None = None
    rig: dict[str, Any] | str | None = None
    world: dict[str, Any] | str | None = None
    has_heading: bool = True
    start: StartSettings | None = None
    metadata: dict[str, str] = Field(default_factory=dict)


def read(path: Path | None, options: Options) -> Log:  # noqa: ARG001 - every reader takes options
    """The log in the folder ``path``; t = 0 at the first stamp of its tables. InputError names file, row and field."""
    if path is None or not (path / RUN_FILE).is_file():
        raise InputError(f"{path}: has no {RUN_FILE}, expected a folder in the native format")
    run_path = path / RUN_FILE
    run = parse_model(RunFile, read_toml(run_path), run_path)
    warnings: list[str] = []
    tables = read_tables(path, warnings)
    if "odometry" not in tables:
        raise InputError(f"{path}: has no odometry, which every estimator needs")
    rig = rig_of(run, run_path)
    reads, inventories = tables.pop("rfid", None), tables.pop("inventories", None)
    rounds = None
    if reads is not None or inventories is not None:
        rounds = read_rounds(reads, inventories, rig.rfid.round_gap if rig.rfid else ROUND_GAP, warnings)
    stamped = [(table.path, table.rows, table.t_ns) for table in (*tables.values(), reads, inventories) if table]
    require_span(stamped)
    t0_ns = min(int(t_ns.min()) for _, _, t_ns in stamped)
    streams: dict[str, Stream] = {}
    for sensor, table in tables.items():
        streams[sensor] = make_stream(sensor, table, t0_ns, warnings)
    if rounds:
        streams["rfid"] = rounds.stream(t0_ns)
    return Log(
        name=run.name or path.resolve().name,
        rig=rig,
        world=world_of(run, run_path),
        streams=streams,
        reference=read_reference(path / REFERENCE, t0_ns, run.has_heading, warnings),
        start=run.start.pose(t0_ns) if run.start else None,
        t0_ns=t0_ns,
        warnings=tuple(warnings),
        metadata=run.metadata,
    )


def rig_of(run: RunFile, source: Path) -> Rig:
    if run.rig is None:
        return DEFAULT_RIG
    if isinstance(run.rig, str):
        return read_rig(inside(source.parent, run.rig, source))
    return parse_model(Rig, run.rig, f"{source} [rig]").placed(source.parent)


def world_of(run: RunFile, source: Path) -> World:
    if run.world is None:
        return World()
    if isinstance(run.world, str):
        return read_world(inside(source.parent, run.world, source))
    return parse_world(run.world, f"{source} [world]", source.parent)


def read_tables(folder: Path, warnings: list[str]) -> dict[str, Table]:
    """The tables that hold rows, by name. A table of a sensor that this version does not read is a warning."""
    tables = {}
    for sensor, shapes in SHAPES.items():
        files = [folder / f"{sensor}{suffix}" for suffix in SUFFIXES if (folder / f"{sensor}{suffix}").is_file()]
        if len(files) > 1:
            raise InputError(f"{folder}: holds both {files[0].name} and {files[1].name}, expected one of them")
        for file in files:
            table = read_table(inside(folder, file.name, folder), sensor, shapes)
            if len(table.rows):
                tables[sensor] = table
            else:
                warnings.append(f"{file}: holds no rows")
    unread = sorted(
        file.name
        for file in folder.iterdir()
        if file.suffix in SUFFIXES and file.stem not in SHAPES and not file.name.endswith((TAGS_SUFFIX, POINTS_SUFFIX))
    )
    if unread:
        warnings.append(f"{folder}: this version does not read {listed(unread)}")
    return tables


def make_stream(sensor: str, table: Table, t0_ns: int, warnings: list[str]) -> Stream:
    """A table as a stream; what is wrong in it is an InputError or a line in ``warnings``."""
    match sensor:
        case "bearing_range":
            return make_sightings(table, t0_ns, warnings)
        case "camera":
            return make_images(table, t0_ns, warnings)
        case "sightings":
            return make_pixels(table, t0_ns, warnings)
    if "dx" in table.numbers:
        moves = np.column_stack([table.numbers[field] for field in INCREMENTS[1:]])
        t_ns, moves = checks.increments_in_order(table.path, table.rows, table.t_ns, moves, warnings)
        return IncrementStream(checks.seconds(t_ns, t0_ns), *np.ascontiguousarray(moves.T))
    keep = checks.in_order(table.path, table.rows, table.t_ns, warnings)
    t = checks.seconds(table.t_ns[keep], t0_ns)
    kept = {field: values[keep] for field, values in table.numbers.items()}
    if sensor == "imu":
        return YawRateStream(t, kept["w"])
    return VelocityStream(t, kept["v"], kept["w"])


def make_sightings(table: Table, t0_ns: int, warnings: list[str]) -> BearingRangeStream:
    ranges, bearings = table.numbers["range"], table.numbers["bearing"]
    for name, values in (("range", ranges), ("bearing", bearings)):
        BEARING_RANGE[name].require(table.path, table.rows, values)
    nothing = np.flatnonzero(np.isnan(ranges) & np.isnan(bearings))
    if len(nothing):
        raise bad_field(table.path, "row", "", "a range, a bearing or both", row=int(table.rows[nothing[0]]))
    if len(short := np.flatnonzero(ranges < NEAREST)):  # radios that got no answer say 0, and gross errors may be below
        first = f"{table.path}:{int(table.rows[short[0]])}"
        warnings.append(
            f"{first}: range is {ranges[short[0]]:g}: {len(short)} ranges that are not above 0 are left out"
        )
        ranges = np.where(ranges >= NEAREST, ranges, np.nan)
    names = table.names["landmark"]
    keep = checks.sightings_in_order(table.path, table.rows, table.t_ns, names, warnings)
    keep = keep[np.isfinite(ranges[keep]) | np.isfinite(bearings[keep])]
    t = checks.seconds(table.t_ns[keep], t0_ns)
    return BearingRangeStream(t, [names[i] for i in keep], ranges[keep], bearings[keep])


def read_reference(path: Path, t0_ns: int, has_heading: bool, warnings: list[str]) -> Trajectory | None:
    if not path.is_file():
        return None
    rows, t_ns, table = read_tum_rows(inside(path.parent, path.name, path.parent))
    poses = on_floor(path, table[:, :3], rotations_of(path, rows, table[:, 3:]), warnings)
    keep = checks.in_order(path, rows, t_ns, warnings)
    return Trajectory(checks.seconds(t_ns[keep], t0_ns), poses[keep], has_heading=has_heading)


def write_native(log: Log, folder: str | Path, format: Literal["csv", "parquet"] = "csv") -> None:
    """Write a log as a new folder, at once or not at all; InputError if ``folder`` holds something.

    Stamps are exact to the nanosecond, the numbers of the tables to the last digit. Covariances of the reference are not
    written, and of a start's deviations in x and y only the larger one. Images are copied; features that were found in images,
    motion in space and a second camera cannot be written: InputError.
    """
    folder = Path(folder)
    require_new(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with temporary_folder(folder) as temporary:
        content = temporary / "log"  # its mode is that of any new folder, the other's is private
        content.mkdir()
        write_files(log, content, format)
        content.replace(folder)


def require_new(folder: Path) -> None:
    """InputError if ``folder`` holds something; what earlier attempts to write it have left beside it is removed."""
    sweep(folder.parent)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: exists and is not an empty folder, expected a new one")


def write_files(log: Log, folder: Path, format: str) -> None:
    base = file_name(re.sub(r"[^\w.-]+", "_", log.name).strip(".") or "log")
    run: dict[str, Any] = {"name": log.name, "rig": f"{base}.rig.toml", "world": f"{base}.world.toml"}
    write_rig(log.rig, folder / run["rig"])
    write_world(log.world, folder / run["world"])
    for sensor, stream in log.streams.items():
        if isinstance(stream, RfidStream):
            reads, inventories = tables_of(stream, log.t0_ns)
            write_table(folder / f"{sensor}.{format}", reads)
            write_table(folder / f"inventories.{format}", inventories)
            continue
        if isinstance(stream, FeatureStream):
            raise InputError(f"{log.name}: {sensor} holds features, expected the images in which they were found")
        if isinstance(stream, TwistStream | RightSightingStream):
            raise InputError(
                f"{log.name}: {sensor} has no table in this format, expected the log of a robot on a floor"
            )
        columns: dict[str, Any] = {"t_ns": absolute(stream.t, log.t0_ns)}
        columns |= (
            {"file": write_images(stream.file, folder)} if isinstance(stream, ImageStream) else columns_of(stream)
        )
        write_table(folder / f"{sensor}.{format}", columns)
    if log.reference is not None:
        run["has_heading"] = log.reference.has_heading
        write_tum(log.reference, folder / REFERENCE, log.t0_ns)
    if log.start is not None:
        run["start"] = start_table(log.start, log.t0_ns)
    if log.metadata:
        run["metadata"] = dict(log.metadata)
    write_toml(folder / RUN_FILE, run)


def absolute(t: Array, t0_ns: int) -> Integers:
    return np.asarray(np.rint(t * 1e9).astype(np.int64) + t0_ns)


def columns_of(stream: Stream) -> Mapping[str, Array | Sequence[str]]:
    """The columns of a stream beside its stamps."""
    match stream:
        case VelocityStream():
            return {"v": stream.v, "w": stream.w}
        case IncrementStream():
            return {"dx": stream.dx, "dy": stream.dy, "dtheta": stream.dtheta}
        case YawRateStream():
            return {"w": stream.w}
        case BearingRangeStream():
            return {"landmark": list(stream.landmark), "range": stream.range, "bearing": stream.bearing}
        case SightingStream():
            return {"landmark": list(stream.point), "u": stream.u, "v": stream.v}
    raise TypeError(f"the native format has no table for {type(stream).__name__}")


def start_table(start: StartPose, t0_ns: int) -> dict[str, Any]:
    x, y, heading = (float(v) for v in start.pose)
    return {
        "x": x,
        "y": y,
        "heading": heading,
        "sigma_position": float(max(start.sigmas[:2])),
        "sigma_heading": float(start.sigmas[2]),
        "t_ns": round(start.t * 1e9) + t0_ns,
    }
