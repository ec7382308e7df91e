"""A robot with three UHF RFID antennas between shelves: a folder with ``tags.csv`` and a folder ``runN`` for each run.

The recording has reference poses but no odometry, which is simulated:
:func:`~factorgraph_loc.sensors.odometry.simulation.wheel_odometry`.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files import checks
from factorgraph_loc.files.columns import require_span
from factorgraph_loc.files.models import FileModel, inside, parse_model, read_text
from factorgraph_loc.files.tables import read_cells
from factorgraph_loc.io.native.rig_file import DEFAULT_RIG
from factorgraph_loc.io.readers.left_out import not_read
from factorgraph_loc.io.readers.pose_file import read_columns
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.odometry import simulation as simulated_odometry
from factorgraph_loc.sensors.odometry.simulation import wheel_odometry
from factorgraph_loc.sensors.rfid.columns import TAGS
from factorgraph_loc.sensors.rfid.map import Tag
from factorgraph_loc.sensors.rfid.rounds import ends_of, make_rfid_stream, rounds_from_gaps
from factorgraph_loc.sensors.rfid.stream import RfidStream
from factorgraph_loc.text import listed
from factors import se2
from factors.se2 import Array, Integers

ANTENNAS = ("first", "second", "third")
TAG_COLUMNS = ("epc", "x_m", "y_m", "z_m", "facing_deg")
TAG_FIELDS = {"x_m": TAGS["x"], "y_m": TAGS["y"], "z_m": TAGS["z"], "facing_deg": TAGS["facing"]}
READ_FIELDS = ("number", "EPC", "port", "carrier MHz", "phase degrees", "RSSI dBm", "reader clock us", "host clock us")
LEFT_OUT = (READ_FIELDS[0], READ_FIELDS[6])
BOUNDS = {"carrier MHz": (840.0, 960.0), "phase degrees": (0.0, 360.0), "RSSI dBm": (-120.0, 20.0)}
ROUND_GAP = 0.05  # s between inventory rounds of an antenna
THINNING = 4  # the reference has 200 Hz


class Options(FileModel):
    """The options of the reader."""

    run: Annotated[int, Field(ge=0)] = 13
    """number of the recording"""
    odometry_seed: Annotated[int, Field(ge=0)] = 0
    """seed of the simulated odometry"""


def read(path: Path | None, options: Options) -> Log:
    """The run; t = 0 at the first pose of the reference. InputError names file, row and field."""
    if path is None:
        raise InputError("rf_robot: the path of the folder with tags.csv is missing")
    folder = inside(path, f"run{options.run}", path)
    if not folder.is_dir():
        runs = sorted(f.name for f in path.glob("run*") if f.is_dir())
        raise bad_field(path, "run", options.run, f"a folder of that number, one of {listed(runs) or '(none)'}")
    warnings: list[str] = []
    reference, t0_ns = read_reference(inside(folder, "reference_pose.txt", folder), warnings)
    odometry = wheel_odometry(reference, options.odometry_seed)
    reads = [read_reads(inside(folder, f"{antenna}.txt", folder), warnings) for antenna in ANTENNAS]
    return Log(
        name=f"{path.resolve().name}-run{options.run}",
        rig=DEFAULT_RIG,
        world=World(name=path.resolve().name, tags=read_tags(inside(path, "tags.csv", path))),
        streams={"odometry": odometry, "rfid": make_stream(reads, t0_ns, float(odometry.t[-1]), folder, warnings)},
        reference=Trajectory(reference.t[::THINNING], reference.poses[::THINNING]),
        t0_ns=t0_ns,
        warnings=tuple(warnings),
        metadata={"odometry": f"{simulated_odometry.DESCRIPTION}; seed {options.odometry_seed}"} | not_read(LEFT_OUT),
    )


def read_tags(path: Path) -> dict[str, Tag]:
    """The surveyed tags by EPC."""
    cells, _ = read_cells(path, (TAG_COLUMNS,))
    numbers = [cells.numbers(name, column, name.split("_")[1]) for name, column in TAG_FIELDS.items()]
    rows: dict[str, int] = {}
    tags: dict[str, Tag] = {}
    for row, epc, (x, y, z, facing) in zip(
        cells.rows, cells.columns["epc"], np.stack(numbers, axis=1).tolist(), strict=True
    ):
        if not epc or epc in tags:
            expected = f"another EPC than in row {rows[epc]}" if epc else "the EPC of a tag"
            raise bad_field(path, "epc", epc, expected, row=row)
        for name, value in zip(TAG_COLUMNS[1:], (x, y, z, facing), strict=True):
            if math.isnan(value):
                raise bad_field(path, name, "", "a number", row=row)
        rows[epc] = row
        tags[epc] = parse_model(Tag, {"x": x, "y": y, "z": z, "facing": facing}, f"{path}:{row}")
    if not tags:
        raise InputError(f"{path}: contains no tags, expected at least one row")
    return tags


def read_reference(path: Path, warnings: list[str]) -> tuple[Trajectory, int]:
    """All poses, in seconds after the first one, and the time of that."""
    table, rows = read_columns(path, ("x", "y", "heading", "time"))
    t_ns = checks.stamps(path, rows, table[:, 3], per_second=1e6)  # the resolution of a double at such times
    if len(rows):
        require_span([(path, rows, t_ns)])
    keep = checks.in_order(path, rows, t_ns, warnings)
    if len(keep) < 2 or t_ns[keep[-1]] - t_ns[keep[0]] < 1e9 / simulated_odometry.RATE:
        raise InputError(f"{path}: contains less than 0.1 s of poses, expected a run")
    t0_ns = int(t_ns[keep[0]])
    poses = np.column_stack((table[keep, :2], se2.wrap(table[keep, 2])))
    return Trajectory(checks.seconds(t_ns[keep], t0_ns), poses), t0_ns


@dataclass(frozen=True)
class _AntennaReads:
    """The N reads of one antenna: host timestamps [ns], EPCs, and RSSI [dBm], phase [rad], frequency [Hz], each (N,)."""

    t_ns: Integers
    epc: list[str]
    rssi: Array
    phase: Array
    frequency: Array


def read_reads(path: Path, warnings: list[str]) -> _AntennaReads:
    """The reads in a file of one antenna."""
    epc: list[str] = []
    stamps: list[int] = []
    values: list[tuple[float, ...]] = []
    rows: list[int] = []
    for row, line in enumerate(read_text(path).split("\n"), start=1):
        parts = line.split()
        if not parts:
            continue
        if len(parts) != len(READ_FIELDS):
            expected = f"{len(READ_FIELDS)} values: {', '.join(READ_FIELDS)}"
            raise bad_field(path, "row", line.strip(), expected, row=row)
        values.append(tuple(_number(path, row, READ_FIELDS[i], parts[i]) for i in (3, 4, 5)))
        if not parts[7].isdigit() or len(parts[7]) > 16:
            raise bad_field(path, READ_FIELDS[7], parts[7], "a whole number of microseconds", row=row)
        stamps.append(int(parts[7]) * 1000)
        epc.append(parts[1])
        rows.append(row)
    if not rows:
        warnings.append(f"{path}: contains no reads")
    table = np.array(values).reshape(-1, 3)
    for (field, (low, high)), column in zip(BOUNDS.items(), table.T, strict=True):
        bad = np.flatnonzero((column < low) | (column > high))
        if len(bad):
            raise bad_field(path, field, float(column[bad[0]]), f"{low:g} to {high:g}", row=rows[bad[0]])
    t_ns = np.array(stamps, dtype=np.int64)
    checks.arrivals(path, np.array(rows, dtype=np.int64), t_ns, warnings)
    return _AntennaReads(t_ns, epc, table[:, 2], np.radians(table[:, 1]), table[:, 0] * 1e6)


def make_stream(reads: list[_AntennaReads], t0_ns: int, end: float, source: Path, warnings: list[str]) -> RfidStream:
    """The rounds of all antennas within the odometry, 0 to ``end`` seconds."""
    t_ns = np.concatenate([r.t_ns for r in reads])
    order = np.argsort(t_ns, kind="stable")
    t_ns = t_ns[order]
    antenna = np.repeat(ANTENNAS, [len(r.t_ns) for r in reads])[order].tolist()
    names = [name for r in reads for name in r.epc]
    rssi, phase, frequency = (
        np.concatenate([getattr(r, column) for r in reads])[order] for column in ("rssi", "phase", "frequency")
    )
    number = rounds_from_gaps(t_ns, antenna, ROUND_GAP)
    end_ns = ends_of(t_ns, number, ROUND_GAP)
    first = np.searchsorted(number, np.arange(len(end_ns)))
    whole = (t_ns[first] >= t0_ns) & ((end_ns - t0_ns) / 1e9 <= end)
    keep = whole[number]
    if left := int(np.count_nonzero(~keep)):
        warnings.append(f"{source}: {left} of {len(t_ns)} reads are outside of the reference and skipped")
    renumbered = np.cumsum(whole) - 1
    return make_rfid_stream(
        t_ns[keep],
        renumbered[number[keep]],
        [names[i] for i in order[keep].tolist()],
        (rssi[keep], phase[keep], frequency[keep]),
        end_ns[whole],
        [antenna[i] for i in first[whole].tolist()],
        t0_ns,
    )


def _number(path: Path, row: int, field: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise bad_field(path, field, text, "a finite number", row=row)
    return value
