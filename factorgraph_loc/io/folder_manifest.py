"""Proposes a manifest (the description of a log) for a folder of tables.

The manifest assigns files to sensors, and states the columns, units and clock offset of each file.
"""

import os
import re
import shlex
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.bounded import YAML
from factorgraph_loc.files.column_mapping import TableFolder
from factorgraph_loc.files.models import parse_model, read_text
from factorgraph_loc.io.guesses import TRUTH, Guess, guess
from factorgraph_loc.io.motions import wheel_steps
from factorgraph_loc.io.proposals import Proposal, distinct, proposal_of, toml_of
from factorgraph_loc.io.readers.mapped_motion import ReferenceFile, read_reference
from factorgraph_loc.io.turns import Turns, match
from factorgraph_loc.model.sections import kind_of, several
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.text import LISTED, listed, quoted
from factors.se2 import Array

SUFFIXES = (".csv", ".tsv", ".txt", ".dat", ".tum")
QUATERNION = ("qx", "qy", "qz", "qw")
FIELDS = {
    "odometry": ("t", "v", "w", "x", "y", "z", "heading", *QUATERNION),
    "reference": ("t", "x", "y", "z", "heading", *QUATERNION),
    "imu": ("t", "w"),
    "rfid": ("t", "epc", "antenna", "rssi", "phase", "frequency"),
    "inventories": ("t", "antenna", "duration"),
    "bearing_range": ("t", "landmark", "range", "bearing"),
    "tags": ("epc", "x", "y", "z", "facing"),
    "landmarks": ("landmark", "x", "y", "z"),
    "position": ("t", "x", "y"),
}
POSITIONS = re.compile("uwb|gps|gnss|position|(^|[-_.])(fix|ble)", re.IGNORECASE)  # in names of tables of positions
MAPS = ("tags", "landmarks")
WINDOW = 1.0  # s: the sampling interval of the positions between which distances are summed
TICK, TRACK, RADIUS = 0.001, 0.5, 0.1  # m per encoder count, m, m: examples of sizes that no file states
SIGMA = 0.1  # m: an example of the noise of a range or a position
APART = 5.0  # s: maximum gap between the time spans of two tables; at a larger gap, a clock offset is proposed


@dataclass
class _Roles:
    """The tables of a folder with their proposed uses, as {use: table}, such as {"odometry": ...}. ``remarks``: hints
    for the user."""

    tables: dict[str, Guess] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)


def manifest_of_folder(tables: Path, folder: Path) -> Proposal:
    """Return a proposed manifest of the folder ``tables``. A manifest is a TOML file that describes how to read a log.

    Nothing is written. Paths in the manifest are relative to ``folder`` if ``tables`` is below ``folder``, else to the
    folder that contains ``tables``. Raises InputError if no file in ``tables`` is a table with times.
    """
    path, folder = Path(os.path.realpath(tables)), folder.resolve()
    guesses = _guesses(path)
    if not any(table.has("t") for table in guesses):
        raise InputError(
            f"{tables}: has no table with times, expected files such as odometry.csv with a suffix {', '.join(SUFFIXES)}"
        )
    roles = _roles(guesses)
    options: dict[str, Any] = {}
    for role, table in list(roles.tables.items()):
        if role in MAPS:
            options.setdefault("world", {})[role] = _map_settings(role, roles)
        else:
            options[role] = _table_settings(role, table, roles, path)
    if "odometry" not in options:
        roles.remarks.append(
            "no file was recognised as odometry, which every estimator needs: describe one in [options.odometry]"
        )
    if "rfid" in options and not roles.tables["rfid"].has("antenna"):
        options["rfid"]["antenna"] = "antenna"
        roles.remarks.append("the reads name no antenna: antenna in [options.rfid] is the antenna name of all reads")
    reference = roles.tables.get("reference")
    if reference is not None and not _has_headings(reference):
        roles.remarks.append(f"{reference.name}: has no headings")
    _add_clocks(options, roles, path)
    for table in roles.tables.values():
        roles.remarks += [f"{table.name}: {reason}" for reason in table.reasons]
    read = {table.name for table in roles.tables.values()}
    unused = [
        entry.name for entry in sorted(path.iterdir()) if entry.name not in read and not entry.name.startswith(".")
    ]
    if unused:
        roles.remarks.append(f"not used: {listed(unused)}")
    beside = [] if "world" in options or any(path.parent.glob("*.world.toml")) else _map_in_parent(path, roles)
    roles.remarks += _needs_of_rig(roles) + beside
    for role in [role for role in options if kind_of(role) != role]:
        kind, _, own = role.partition(".")
        options.setdefault(kind, {})[own] = options.pop(role)
    return proposal_of("mapped", path, folder, options, roles.remarks, with_map=not beside and "world" not in options)


def _needs_of_rig(roles: _Roles) -> list[str]:
    """Return hints on what a rig file must have for the tables in ``roles``, with commands that write such a file."""
    out = []
    if "rfid" in roles.tables and roles.tables["rfid"].has("antenna"):
        antennas = dict.fromkeys(roles.tables["rfid"].columns[roles.tables["rfid"].fields["antenna"]])
        names = shlex.quote(",".join(antennas)) if len(antennas) < LISTED else listed(antennas)
        out.append(
            f"the rig needs antennas with the names in the reads: `fgloc rigs new --antennas {names}` writes such a rig"
        )
    radios = [role for role in roles.tables if kind_of(role) == "bearing_range"]
    sections = listed(f"[{role}]" for role in radios)
    if len(radios) > 1:
        each = ",".join(f"{role.partition('.')[2]}={SIGMA}" for role in radios)
        out.append(f"the rig needs {sections}: `fgloc rigs new --landmarks {each}` writes such a rig")
    if "position" in roles.tables:
        out.append(f"the rig needs [position]: `fgloc rigs new --position {SIGMA}` writes such a rig")
    if radios and "landmarks" in roles.tables and roles.tables["landmarks"].has("z"):
        out.append(f"the landmarks have heights: set z, the height of the sensor, in {sections} of the rig")
    return out


def _map_in_parent(path: Path, roles: _Roles) -> list[str]:
    """Find a table of tags or landmarks in the parent folder of ``path``, and add it to ``roles``.

    Return remarks with the lines of a world file for the table, or an empty list if there is no such table."""
    for table in _guesses(path.parent):
        role = _role(table)
        if role in MAPS:
            roles.tables[role] = table
            name = path.parent.name
            walls = next(
                (y.name for y in sorted(path.parent.glob("*.yaml")) if "resolution:" in read_text(y, YAML)), None
            )
            world = {"name": name, **({} if walls is None else {"walls": walls}), role: _map_settings(role, roles)}
            lines = toml_of(world).splitlines()
            return [f"{table.name} seems to be a map: save these lines as {name}.world.toml next to it", *lines]
    return []


def _map_settings(role: str, roles: _Roles) -> dict[str, Any]:
    """Return the lines of a world file that describe the tags or landmarks in ``roles``, as {key: value}.

    ``role``: "tags" or "landmarks". If the EPCs in the map and in the reads differ in letter case, a setting converts
    the EPCs of the map."""
    table, reads = roles.tables[role], roles.tables.get("rfid")
    settings = table.mapping(FIELDS[role])
    if role == "tags" and reads is not None:
        tags, read = (set(g.columns[g.fields["epc"]]) for g in (table, reads))
        case = next((case for case in ("upper", "lower") if all(epc == getattr(epc, case)() for epc in read)), None)
        if case is not None and not tags & read and {getattr(epc, case)() for epc in tags} & read:
            settings["epc_case"] = case
    return settings


def _guesses(folder: Path) -> list[Guess]:
    """Return the guessed columns and units of each table in a folder. Files that cannot be read as tables are left out."""
    out = []
    for file in sorted(entry for entry in folder.iterdir() if entry.suffix.lower() in SUFFIXES and entry.is_file()):
        with suppress(InputError):
            if (table := guess(file)) is not None:
                out.append(table)
    return out


def _roles(guesses: Sequence[Guess]) -> _Roles:
    """Return a proposed use, such as "odometry", of each of the tables ``guesses``.

    A table of poses is the reference if its file name suggests ground truth, or if another table is the odometry."""
    out = _Roles()
    poses = [g for g in guesses if g.has("t", "x", "y") and not g.has("epc") and not g.has("landmark")]
    truths = [g for g in poses if TRUTH.search(g.name)]
    by_role: dict[str, list[Guess]] = {}
    for table in guesses:
        if (role := _role(table)) is not None:
            by_role.setdefault(role, []).append(table)
    for role, tables in by_role.items():
        if role in several() and len(tables) > 1:
            names = distinct([Path(table.name).stem for table in tables])
            out.tables |= {f"{role}.{name}": table for name, table in zip(names, tables, strict=True)}
            continue
        out.tables[role] = tables[0]
        out.remarks += [f"{role} could also be {table.name}" for table in tables[1:]]
    rest = [g for g in poses if g not in out.tables.values() and g not in truths]
    measured = [g for g in rest if not _has_headings(g) and POSITIONS.search(g.name)]
    if measured:
        out.tables["position"] = measured[0]
        rest = [g for g in rest if g not in measured]
    if "odometry" not in out.tables and rest:
        out.tables["odometry"] = rest.pop(0)
    reference = truths[0] if truths else rest[0] if rest else None
    if reference is not None:
        out.tables["reference"] = reference
        if reference not in truths:
            out.remarks.append(
                f"{reference.name} is used as the reference: remove [options.reference] if it is an estimate, not the truth"
            )
    return out


def _role(table: Guess) -> str | None:
    """Return the use that the fields of a table imply, such as "odometry", or None for poses and unknown fields."""
    if not table.has("t"):
        return "tags" if table.has("epc", "x", "y") else "landmarks" if table.has("landmark", "x", "y") else None
    if table.has("epc"):
        return "rfid"
    if table.has("landmark") and (table.has("range") or table.has("bearing")):
        return "bearing_range"
    if _wheel_fields(table) or table.has("v", "w"):
        return "odometry"
    if table.has("antenna"):
        return "inventories"
    return "imu" if table.has("w") else None


def _wheel_fields(table: Guess) -> tuple[str, ...]:
    """Return the fields of two or four wheels. Returns an empty tuple if the table has no such fields."""
    return tuple(name for name in table.fields if name.removeprefix("rear_").startswith(("left", "right")))


def _table_settings(role: str, table: Guess, roles: _Roles, path: Path) -> dict[str, Any]:
    """Return the settings that describe a table in the manifest. ``role``: its use, such as "odometry". ``roles``: the
    tables of all uses. ``path``: the folder of the tables."""
    sides = _wheel_fields(table) if role == "odometry" else ()
    if sides:
        settings = table.mapping(("t", *sides))
        _add_sizes(settings, table, sides, roles, path)
        return settings
    settings = table.mapping(("t", "v", "w") if role == "odometry" and table.has("v", "w") else FIELDS[kind_of(role)])
    if role == "reference" and not _has_headings(table):
        settings["has_heading"] = False
    return settings


def _has_headings(table: Guess) -> bool:
    return table.has("heading") or table.has(*QUATERNION)


def _add_sizes(settings: dict[str, Any], table: Guess, sides: Sequence[str], roles: _Roles, path: Path) -> None:
    """Add the distance between the wheels, and the distance per encoder count, to the ``settings`` of odometry.

    ``table``: the table of odometry. ``sides``: its fields of the wheels. ``roles``: all tables, in the folder
    ``path``. The two distances are estimated from the reference. Without a reference they are examples, and a remark
    says so."""
    settings["track"] = TRACK
    if sides[0] != "left":
        if sides[0] in ("left_angle", "left_rate"):
            settings["radius"] = RADIUS
        roles.remarks.append(
            f"{table.name}: measure the distance between the wheels and the radius of a wheel, and set track and radius [m]"
        )
        return
    left, right = _counted(table, sides)
    reference, tick, track, length, travelled = _reference(roles, path), TICK, None, 0.0, 0.0
    if reference is not None:
        turns = Turns(table.times(), right - left)
        turned = match(turns, _turns_of(reference)) if reference.has_heading else None
        offset = 0.0 if turned is None or turned.offset is None else turned.offset
        length, travelled = _lengths(table.times(), left + right, replace(reference, t=reference.t + offset))
        if length > 0.0 and travelled > 0.0:
            tick = float(f"{2.0 * length / travelled:.3g}")
        if turned is not None and turned.ratio > 0.0:
            track = float(f"{tick * turned.ratio:.3g}")
    if length > 0.0 and travelled > 0.0:
        roles.remarks.append(
            f"{table.name}: units.left = {tick:g} m per count of {quoted(table.fields['left'])}, because the reference travels "
            f"{length:.1f} m while the wheels count {travelled / 2.0:.0f}; replace it by the distance per count of your wheels"
        )
    else:
        roles.remarks.append(
            f"{table.name}: units.left = {tick:g} m per count of {quoted(table.fields['left'])} is an example: replace it by the"
            " distance per count of your wheels"
        )
    if track is None:
        roles.remarks.append(f"{table.name}: measure the distance between the wheels, and set track [m]")
    else:
        settings["track"] = track
        roles.remarks.append(
            f"{table.name}: track = {track:g} m, estimated from the turns of the reference; replace it by a measured value"
        )
    settings.setdefault("units", {}).update(dict.fromkeys(sides, tick))


def _reference(roles: _Roles, path: Path) -> Trajectory | None:
    """Return the reference trajectory in ``roles``, or None if there is none, or if it cannot be read. ``path``: its folder."""
    if (table := roles.tables.get("reference")) is None:
        return None
    with suppress(InputError):
        options = parse_model(ReferenceFile, _table_settings("reference", table, roles, path), path)
        return read_reference(TableFolder(path), options, 0)
    return None


def _lengths(t: Array, counted: Array, reference: Trajectory) -> tuple[float, float]:
    """Return the path length of the ``reference`` [m], and the sum of the absolute changes of the encoder counts.

    ``t`` (N,): times [s]. ``counted`` (N,): encoder counts. If the times of both overlap, only the overlap is used."""
    during = (t >= reference.t[0]) & (t <= reference.t[-1])
    of_reference = (reference.t >= t[0]) & (reference.t <= t[-1])
    if not during.any() or not of_reference.any():
        during, of_reference = np.ones(len(t), dtype=bool), np.ones(len(reference.t), dtype=bool)
    steps = np.diff(_each_second(reference.t[of_reference], reference.poses[of_reference, :2]), axis=0)
    return float(np.sum(np.hypot(*steps.T))), float(np.sum(np.abs(np.diff(_each_second(t[during], counted[during])))))


def _each_second(t: Array, values: Array) -> Array:
    """Return the first of ``values`` (N, ...) in each interval of length :data:`WINDOW`. ``t`` (N,): the times [s]."""
    return np.asarray(values[np.unique(np.floor((t - t[0]) / WINDOW), return_index=True)[1]])


def _counted(table: Guess, sides: Sequence[str]) -> tuple[Array, Array]:
    """Return the counts (N,) of the left wheels and of the right wheels since the first row. Wrapped counters are unwrapped.

    ``sides``: the fields of the wheels in the table."""
    steps = {name: wheel_steps(table.values(name), 1.0) for name in sides}
    left, right = (np.mean([steps[name] for name in sides if side in name], axis=0) for side in ("left", "right"))
    return np.append(0.0, np.nancumsum(left)), np.append(0.0, np.nancumsum(right))


def _turns_of(reference: Trajectory) -> Turns:
    return Turns(reference.t, np.unwrap(reference.poses[:, 2]))


def _turns(role: str, roles: _Roles, path: Path) -> Turns | None:
    """Return the headings over time in the table ``roles.tables[role]``. Returns None if it has no headings.

    ``path``: the folder of the tables."""
    table = roles.tables[role]
    if role == "reference":
        reference = _reference(roles, path)
        return None if reference is None or not reference.has_heading else _turns_of(reference)
    if role == "odometry" and _wheel_fields(table)[:1] == ("left",):
        left, right = _counted(table, _wheel_fields(table))
        return Turns(table.times(), right - left)
    if table.has("heading"):
        period = 360.0 if table.units.get("heading") == "deg" else 2.0 * np.pi
        return Turns(table.times(), np.unwrap(table.values("heading"), period=period))
    if table.has("w"):
        return Turns(table.times(), np.append(0.0, np.nancumsum(table.values("w")[:-1] * np.diff(table.times()))))
    return None


def _add_clocks(options: dict[str, Any], roles: _Roles, path: Path) -> None:
    """Add clock offsets to the ``options`` of tables with times that do not overlap the times of most other tables.

    An offset aligns the turns of the robot in two tables. If no alignment is clearly best, the offset gives both tables
    the same first time.
    """
    starts = {role: float(np.nanmin(table.times())) for role, table in roles.tables.items() if table.has("t")}
    ends = {role: float(np.nanmax(roles.tables[role].times())) for role in starts}
    if not starts:
        return

    def agreeing(role: str) -> tuple[int, bool]:
        count = sum(ends[role] > start and starts[role] < ends[name] for name, start in starts.items())
        return count, role == "reference"

    usual = max(starts, key=agreeing)
    apart = {role for role in starts if starts[role] > ends[usual] + APART or ends[role] < starts[usual] - APART}
    by_clock = (_turns(role, roles, path) for role in starts if role not in apart)
    first = next((turns for turns in by_clock if turns is not None), None)
    for role, start in starts.items():
        if role in apart:
            second = _turns(role, roles, path)
            same = None if first is None or second is None else match(first, second)
            offset = None if same is None else same.offset
            options[role]["clock_offset"] = round(starts[usual] - start if offset is None else offset, 3)
            how = "begin at the same time; correct it if they did not" if offset is None else "show the same turns"
            roles.remarks.append(
                f"{roles.tables[role].name}: its clock differs from that of {roles.tables[usual].name}: "
                f"clock_offset makes both {how}"
            )
