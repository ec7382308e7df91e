"""Guesses the content of a table of another program: separator, header, and the field and the unit of each column.

The name of a column decides first, and its values second. A guess by values comes with its reason.
"""

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_loc.files.cells import iso_nanoseconds
from factorgraph_loc.files.column_mapping import parsed, split_comments
from factorgraph_loc.files.columns import LENGTH, RATE, SPEED, STAMPS, unit_since_1970
from factorgraph_loc.files.models import read_text
from factorgraph_loc.text import quoted
from factors.se2 import Array

TRUTH = re.compile(
    r"truth|(^|[/_.])gt($|[/_.])|reference|mocap|vicon|optitrack|qualisys|total_station|leica", re.IGNORECASE
)
# common names that other programs have for each field of an RFID read, without separators and units
READ: dict[str, tuple[str, ...]] = {
    "epc": ("epc", "epchex", "tagepc", "tagid", "epcid", "uid", "tag", "serial", "tagserial"),
    "antenna": ("antenna", "antennaid", "antennaport", "antennaname", "ant", "port", "portnumber", "readerport"),
    "rssi": ("rssi", "peakrssi", "signalstrength", "power"),
    "phase": ("phase", "phaseangle", "rfphase", "rfphaseangle"),
    "frequency": ("frequency", "freq", "carrier", "channelfrequency", "channelmhz", "channelkhz"),
    "stamp": ("firstseen", "firstseentimestamp", "firstseentimestamputc", "readtime", "timestamp"),
}
# common names of columns with the landmark and the range in a table of ranges, the likeliest first
LANDMARK = ("anchorid", "anchor", "anchorname", "responderid", "beaconid", "beacon", "landmarkid", "nodeid", "id")
RANGE = ("range", "distance", "dist", "dis", "rangem", "distancem")
UNIT = re.compile(r"(deg(rees)?|rad(ians)?|[mk]?hz|[mun]s|dbm)$")
SEPARATORS = ("\t", ";", ",", " ")
LOOKED_AT = 50  # number of lines that decide on separator and header
TIME = re.compile(r"^(t|time.*|.*time|.*stamp|when|date.*|millis|uptime|clock|secs?|seconds|finished|end(ed)?|begin)$")
BRACKETS = re.compile(r"\s*[\[(]\s*([^\])]+?)\s*[\])]\s*$")
WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
POSE = {
    "x": ("x", "px", "posx", "positionx", "east", "easting"),
    "y": ("y", "py", "posy", "positiony", "north", "northing"),
    "z": ("z", "pz", "posz", "positionz", "height", "up"),
    "heading": ("heading", "theta", "yaw", "th", "phi"),
    **{f"q{axis}": (f"q{axis}", f"quat{axis}", f"orientation{axis}", f"o{axis}") for axis in "xyzw"},
}
MOTION = {
    "v": ("v", "vx", "speed", "velocity", "vel", "linear", "linearx", "linearvelocity", "forward"),
    "w": ("w", "wz", "omega", "yawrate", "turnrate", "turn", "angular", "angularz", "angularvelocity", "gyroz", "rotz"),
}
OTHERS = {
    "landmark": ("landmark", "anchor", "beacon", "marker", *LANDMARK[:-1], "name", "id"),
    "range": RANGE,
    "bearing": ("bearing", "azimuth"),
    "duration": ("duration", "len", "length"),
    "facing": ("facing", "faces", "direction", "facingdirection"),
}
NAMES: dict[str, Sequence[str]] = {**{k: v for k, v in READ.items() if k != "stamp"}, **POSE, **MOTION, **OTHERS}
# for each kind of field: endings of column names that state a unit, such as "sec", and the unit that they mean
SECONDS = {"s": "s", "sec": "s", "ms": "ms", "us": "us", "ns": "ns", "millis": "ms", "micros": "us", "nanos": "ns"}
LENGTHS = {unit: unit for unit in LENGTH}
ANGLES = {"deg": "deg", "degrees": "deg", "rad": "rad", "radians": "rad"}
SPEEDS = {unit: unit for unit in SPEED} | {"mps": "m/s", "kmh": "km/h"}
RATES = {unit: unit for unit in RATE} | {"dps": "deg/s"}
ENDS: dict[str, Mapping[str, str]] = {
    **dict.fromkeys(("t", "duration"), SECONDS),
    **dict.fromkeys(("x", "y", "z", "range"), LENGTHS),
    **dict.fromkeys(("heading", "bearing", "facing", "phase"), ANGLES),
    "v": SPEEDS,
    "w": RATES,
    "frequency": {"hz": "Hz", "khz": "kHz", "mhz": "MHz"},
}
TEXTS = ("epc", "antenna", "landmark")  # fields whose values need not be numbers
FASTEST = 15.0  # m/s above which a speed is assumed to be in another unit
# possible units of each field, with the largest plausible value in the unit; the first plausible unit is used
LARGER: dict[str, tuple[tuple[str, float], ...]] = {
    **dict.fromkeys(("heading", "bearing", "facing"), (("rad", 6.4), ("deg", np.inf))),
    "w": (("rad/s", 12.0), ("deg/s", np.inf)),
    "v": (("m/s", FASTEST), ("mm/s", np.inf)),
    "phase": (("rad", 6.4), ("deg", 360.0), ("turn/4096", 4096.0)),
    "frequency": (("MHz", 1e4), ("kHz", 1e7)),
    "rssi": (("dBm", 200.0), ("cdBm", 2e4)),
}
OURS = ("rad", "rad/s", "m/s", "dBm")
REAR = {"rear", "back", "rl", "rr", "bl", "br"}  # words in names of rear wheels, if there are front ones
EPC = re.compile(r"(0x)?[0-9A-Fa-f]{8,}$")


@dataclass
class Guess:
    """A table of another program and what its columns are guessed to mean.

    ``separator``, ``decimal``: the separator of columns and the decimal mark.
    ``header``: True if the first row has the names of the columns.
    ``columns``: the texts of each column by its name, or by its number from 1 if the table has no header.
    ``fields``: the guessed column of each field, a quantity of this project such as ``t`` or ``epc``.
    ``units``: the guessed unit of each field. ``reasons``: explanations of guesses that follow from values.
    """

    path: Path
    separator: str
    decimal: str
    header: bool
    columns: Mapping[str, Sequence[str]]
    fields: dict[str, str] = field(default_factory=dict)
    units: dict[str, str | float] = field(default_factory=dict)
    reasons: list[str] = field(default_factory=list)

    @property
    def name(self) -> str:
        """The name of the file."""
        return self.path.name

    def numbers(self, name: str) -> Array | None:
        """Return the numbers (N,) of a column, NaN for empty cells. ``name``: the name of the column in the file.

        Returns None if a cell is not a number, or if all cells are empty.
        """
        texts = self.columns[name]
        with suppress(ValueError):
            values = np.array([float(t.replace(self.decimal, ".")) if t else np.nan for t in texts])
            return values if np.isfinite(values).any() else None
        return None

    def values(self, name: str) -> Array:
        """Return the numbers (N,) of the field ``name``, or an empty array if its column is not numeric."""
        values = self.numbers(self.fields[name])
        return np.empty(0) if values is None else values

    def times(self) -> Array:
        """Return the timestamps (N,) [s]. Returns an empty array if the table has no times."""
        unit = self.units.get("t")
        if unit == "iso":
            return np.array([iso_nanoseconds(text) / 1e9 for text in self.columns[self.fields["t"]]])
        return self.values("t") * (STAMPS[str(unit)] / STAMPS["s"]) if unit else np.empty(0)

    @property
    def is_tum(self) -> bool:
        """True if the table is a trajectory in TUM format."""
        return not self.header and self.separator == " " and self.has("qw") and self.units.get("t") == "s"

    def has(self, *names: str) -> bool:
        """True if the table has all fields ``names``."""
        return all(name in self.fields for name in names)

    def mapping(self, names: Sequence[str]) -> dict[str, Any]:
        """Return settings that describe the table in a manifest: file, separators, and columns and units of the fields
        ``names``."""
        out: dict[str, Any] = {"file": self.name}
        if self.is_tum:
            return out | {"format": "tum"}
        out |= {} if self.separator == "," else {"separator": self.separator}
        out |= {} if self.decimal == "." else {"decimal": self.decimal}
        out |= {} if self.header else {"header": False}
        out["columns"] = {name: self.fields[name] for name in names if name in self.fields}
        if units := {name: self.units[name] for name in out["columns"] if name in self.units}:
            out["units"] = units
        return out


def plain(name: str) -> str:
    """Return a name in lower case, without spaces, underscores, hyphens and dots."""
    return re.sub(r"[\s_\-.]", "", name).lower()


def rank(name: str, known: Sequence[str]) -> int | None:
    """Return the index of ``name`` in ``known``, the known spellings in order of preference, or None if it is unknown.

    ``name`` is in lower case and without separators. A unit at its end is ignored.
    """
    return next((known.index(text) for text in (name, UNIT.sub("", name)) if text in known), None)


def guess(path: Path) -> Guess | None:
    """Return the guessed fields and units of a table, or None if the file is not a table with rows and columns."""
    numbered = [(row, line) for row, line in enumerate(read_text(path).splitlines(), start=1) if line.strip()]
    comments, content = split_comments(numbered)
    for separator in SEPARATORS:
        first = list(parsed(path, content[:LOOKED_AT], separator))
        widths = {len(parts) for _, parts in first}
        if len(first) > 1 and len(widths) == 1 and widths != {1}:
            break
    else:
        return None
    width, body = widths.pop(), [parts for _, parts in parsed(path, content, separator)]
    named = next(parsed(path, comments[-1:], separator), (0, []))[1]
    names: Sequence[str] = [str(i) for i in range(1, width + 1)]
    if len(named) == width or not any(_is_value(text) for text in body[0]):
        names, body = (named, body) if len(named) == width else (body[0], body[1:])
    rows = [parts for parts in body if len(parts) == width]
    if not rows or len(set(names)) < width:
        return None
    columns = {name: [parts[i] for parts in rows] for i, name in enumerate(names)}
    cells = " ".join(text for parts in rows[:LOOKED_AT] for text in parts)
    decimal = "," if separator != "," and re.search(r"\d,\d", cells) and not re.search(r"\d\.\d", cells) else "."
    return _guess_fields(Guess(path, separator, decimal, not names[0].isdecimal(), columns))


def _is_value(text: str) -> bool:
    """True if a text is a number or a time, and therefore not the name of a column."""
    return bool(re.match(r"[-+]?[\d.,]+(e[-+]?\d+)?$", text, re.IGNORECASE)) or _is_time(text)


def _is_time(text: str) -> bool:
    with suppress(ValueError):
        return len(text) > len("2026-01-31") and iso_nanoseconds(text) > 0
    return False


def _guess_fields(out: Guess) -> Guess:
    """Guess the fields and units of the table ``out`` from its columns. Return ``out`` with these guesses."""
    _add_time(out)
    if not out.header:
        _add_tum(out)
        return out
    taken = set(out.fields.values())
    for name in out.columns:
        text, end = _split(name)
        ranked = [(at, f) for f, known in NAMES.items() if (at := rank(plain(text), known)) is not None]
        if name in taken or not ranked:
            continue
        best = min(ranked)[1]
        if best not in out.fields and (best in TEXTS or out.numbers(name) is not None):
            out.fields[best] = name
            if unit := ENDS.get(best, {}).get(end):
                out.units[best] = unit
    for name, texts in out.columns.items():
        if "epc" not in out.fields and name not in taken and all(EPC.match(text) for text in texts[:LOOKED_AT]):
            out.fields["epc"] = name
            out.reasons.append(f"{quoted(name)} is used as the EPC: it has hexadecimal numbers")
    _add_wheels(out)
    _add_units(out)
    return out


def _split(name: str) -> tuple[str, str]:
    """Return the name of a column without its unit, and the unit in lower case, "" if there is none."""
    if bracket := BRACKETS.search(name):
        return name[: bracket.start()], bracket[1].lower()
    words = WORDS.findall(name)
    end = words[-1].lower() if len(words) > 1 else ""
    known = any(end in ends for ends in ENDS.values())
    return (name[: name.rfind(words[-1])], end) if known else (name, "")


def _add_time(out: Guess) -> None:
    """Add the column of the time and its unit to ``out``.

    Columns with a name such as "time" are tried first, then the first column. The values must be times, or numbers
    that increase from row to row with few exceptions."""
    names = list(out.columns)
    named = [name for name in names if TIME.match(plain(_split(name)[0]))] if out.header else names[:1]
    for name in [*named, *names[:1]]:
        texts = out.columns[name]
        if all(map(_is_time, texts)):
            out.fields["t"], out.units["t"] = name, "iso"
            return
        values = out.numbers(name)
        if (
            values is None
            or not np.isfinite(values).all()
            or np.mean(np.diff(values) < 0.0) > 0.2
            or not np.ptp(values)
        ):
            continue
        end = _split(name)[1] or plain(name)
        out.fields["t"] = name
        out.units["t"] = SECONDS.get(end) or _unit_of_times(values)
        if end not in SECONDS and out.header:
            out.reasons.append(f"{quoted(name)} is in {out.units['t']}: it begins with {texts[0]}")
        return


def _unit_of_times(values: Array) -> str:
    """Return the guessed unit of timestamps: by their size if they count from 1970, else by the median step."""
    if (unit := unit_since_1970(float(values[0]))) is not None:
        return unit
    step = float(np.median(np.diff(np.unique(values))))
    whole = bool(np.all(values == np.floor(values)))
    return "s" if not whole or step <= 1.0 else "ms" if step < 1e4 else "us" if step < 1e7 else "ns"


def _add_tum(out: Guess) -> None:
    """Add the fields of a TUM file, if the table has its eight columns: time, position, and a quaternion of length 1."""
    names = list(out.columns)
    values = [out.numbers(name) for name in names]
    if len(names) != 8 or any(v is None for v in values):
        return
    length = np.linalg.norm(np.column_stack([v for v in values[4:] if v is not None]), axis=1)
    if np.nanmax(np.abs(length - 1.0)) < 1e-2:
        out.fields |= dict(zip(("x", "y", "z", "qx", "qy", "qz", "qw"), names[1:], strict=True))


def _add_wheels(out: Guess) -> None:
    """Add the fields of two or four wheels, if the table has them: their speeds, rates, angles, distances or encoder counts."""
    words = {name: [word.lower() for word in WORDS.findall(name)] for name in out.columns}
    sides = {
        side: [
            name
            for name, parts in words.items()
            if {side, side[0], f"f{side[0]}", f"r{side[0]}", f"b{side[0]}"} & set(parts)
        ]
        for side in ("left", "right")
    }
    if not sides["left"] or len(sides["left"]) != len(sides["right"]):
        return
    rear = {side: [name for name in names if REAR & set(words[name])] for side, names in sides.items()}
    front = {side: [name for name in names if name not in rear[side]] or names for side, names in sides.items()}
    pairs = {"": front} | ({"rear_": rear} if rear["left"] and rear["right"] and front != rear else {})
    if len(pairs) == 2:
        out.reasons.append(
            "there are four wheels: if they are mecanum wheels, set base [m] of odometry, the distance between the axles"
        )
    left, right = (front[side][0] for side in ("left", "right"))
    if out.numbers(left) is None or out.numbers(right) is None:
        return
    parts = set(words[left])
    kind = next(
        (
            end
            for end, known in (
                ("_rate", {"rate", "rpm", "omega"}),
                ("_speed", {"speed", "velocity", "vel", "v", "mps"}),
                ("_angle", {"angle", "rad", "position"}),
            )
            if known & parts
        ),
        "",
    )
    for where, names in pairs.items():
        out.fields |= {f"{where}{side}{kind}": names[side][0] for side in ("left", "right")}
        if "rpm" in parts:
            out.units |= {f"{where}left_rate": "rpm", f"{where}right_rate": "rpm"}


def _add_units(out: Guess) -> None:
    """Add units that follow from the size of values, such as degrees for large angles and millimetres for large positions."""
    for name, sizes in LARGER.items():
        size = np.nanmax(np.abs(out.values(name)), initial=0.0) if out.has(name) else 0.0
        if size > 0.0 and name not in out.units:
            unit = next((unit for unit, most in sizes if size <= most), None)
            if unit is not None and unit not in OURS:
                _set_unit(out, name, unit, f"has values up to {size:.0f}")
    t = out.times()
    if out.has("x", "y") and len(t) > 1 and not {"x", "y"} & set(out.units):
        steps = np.hypot(np.diff(out.values("x")), np.diff(out.values("y")))
        speed = float(np.nansum(steps) / max(t[-1] - t[0], 1e-9))
        if speed > FASTEST:
            for name in ("x", "y", *(("z",) if out.has("z") else ())):
                _set_unit(out, name, "mm", f"would move at {speed:.0f} m/s in metres")


def _set_unit(out: Guess, name: str, unit: str, why: str) -> None:
    out.units[name] = unit
    out.reasons.append(f"{quoted(out.fields[name])} is in {unit}: it {why}")
