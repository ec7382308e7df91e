"""Measurements from a running program: checked and copied, so that whoever made them may use the arrays again."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.measurements import (
    BearingRange,
    CameraFrame,
    Exteroceptive,
    IncrementOdometry,
    Odometry,
    PixelSightings,
    RfidScan,
    Twist,
    VelocityOdometry,
    YawRate,
)
from factorgraph_loc.text import listed
from factors.se2 import Array

M = TypeVar("M", bound=Odometry | Exteroceptive)
# sensors as a rig and a log name them
SENSORS: dict[type, str] = {
    VelocityOdometry: "odometry",
    IncrementOdometry: "odometry",
    YawRate: "imu",
    Twist: "twist",
    BearingRange: "bearing_range",
    RfidScan: "rfid",
    PixelSightings: "sightings",
    CameraFrame: "camera",
}
ALL_SENSORS = (*dict.fromkeys(SENSORS.values()), "sightings_right", "rssi", "phase")
# fields that name something, of which each has a row in the fields that are not numbers of their own
NAMES: dict[type, str] = {BearingRange: "landmarks", RfidScan: "tags", PixelSightings: "points"}
MAY_LACK = ("range", "bearing", "rssi", "phase", "frequency")  # NaN: not measured
ABOVE_ZERO = ("range", "frequency")
WIDTHS = {"pixels": 2}


@dataclass(frozen=True)
class RfidRead:
    """A tag that was read: by the antenna of that name, its EPC; ``t`` [s]: when, None for the end of the round. ``rssi`` [dBm],
    ``phase`` [rad] as the reader reports it, ``frequency`` [Hz] of the carrier: NaN where unknown. ``round``: in which of the
    rounds that are pushed together, as its place in their list of antennas, from 0. None where only the antenna is known: a tag
    answers once in a round, so that the first read of a tag by an antenna is of its first round, the next of its next."""

    antenna: str
    epc: str
    t: float | None = None
    rssi: float = math.nan
    phase: float = math.nan
    frequency: float = math.nan
    round: int | None = None


def sensor_of(m: Odometry | Exteroceptive) -> str:
    """The name of the sensor that a measurement is of; InputError if it is no measurement."""
    if type(m) not in SENSORS:
        raise InputError(
            f"{type(m).__name__} is no measurement, expected one of {', '.join(k.__name__ for k in SENSORS)}"
        )
    return "sightings_right" if isinstance(m, PixelSightings) and m.right else SENSORS[type(m)]


def scan_of(t: float, antennas: Iterable[str], reads: Iterable[RfidRead]) -> RfidScan:
    """The scan of rounds that ended at ``t``, in which ``antennas`` listened; InputError if a read is of another antenna, or of
    another one's round."""
    names, rows = tuple(antennas), tuple(reads)
    return RfidScan(
        t,
        names,
        _rounds(f"RfidScan at {t:.3f} s", t, names, rows),
        tuple(read.epc for read in rows),
        np.array([0.0 if read.t is None else t - read.t for read in rows]),
        np.array([read.rssi for read in rows]),
        np.array([read.phase for read in rows]),
        np.array([read.frequency for read in rows]),
    )


def _rounds(where: str, t: float, names: tuple[str, ...], reads: Sequence[RfidRead]) -> NDArray[np.int64]:
    """Which of the rounds each read (R,) belongs to.

    Where a read does not tell it, that is the first round of its antenna in which the tag was not read yet, by the order of time,
    and the last one if there are more reads than rounds.
    """
    out = np.full(len(reads), -1, dtype=np.int64)
    for i, read in enumerate(reads):
        if read.antenna not in names:
            raise bad_field(where, "antenna", read.antenna, f"one that listened: {listed(names)}")
        if read.round is None:
            continue
        own = [k for k, name in enumerate(names) if name == read.antenna]
        if read.round not in own:
            expected = f"one of antenna {read.antenna}: {listed(own)}"
            raise bad_field(where, "round", read.round, expected)
        out[i] = read.round
    taken = {(read.epc, int(k)) for read, k in zip(reads, out, strict=True) if k >= 0}
    untold = [i for i in range(len(reads)) if out[i] < 0]
    for i in sorted(untold, key=lambda i: t if (at := reads[i].t) is None else at):
        mine = [k for k, name in enumerate(names) if name == reads[i].antenna]
        out[i] = next((k for k in mine if (reads[i].epc, k) not in taken), mine[-1])
        taken.add((reads[i].epc, int(out[i])))
    return out


def checked(m: M) -> M:
    """The same measurement with arrays of its own; InputError names the first field that cannot be, its value, and what can."""
    sensor_of(m)
    if not isinstance(m.t, (int, float, np.number)) or not math.isfinite(m.t):
        raise bad_field(type(m).__name__, "t", m.t, "a finite number of seconds")
    where = f"{type(m).__name__} at {m.t:.3f} s"
    names: Sequence[str] | None = getattr(m, NAMES[type(m)]) if type(m) in NAMES else None
    count = len(m.pixels) if isinstance(m, CameraFrame) else None if names is None else len(names)
    new: dict[str, Any] = {"t": float(m.t)}
    for field in fields(m):
        value = getattr(m, field.name)
        if field.name in ("t", "feature", "right"):
            continue
        if field.name in ("landmarks", "tags", "points", "antennas"):
            new[field.name] = _names(where, field.name, value)
        elif field.name in ("antenna", "tracks"):
            new[field.name] = _integers(where, field.name, value, count)
        elif field.name == "descriptors":
            new[field.name] = _descriptors(where, value, count)
        elif count is not None:
            new[field.name] = _column(where, field.name, value, count)
        elif isinstance(m, Twist):
            new[field.name] = _finite(where, field.name, _shaped(where, field.name, value, (3,)))
        else:
            new[field.name] = float(_finite(where, field.name, _shaped(where, field.name, value, ())))
    if isinstance(m, RfidScan):
        _check_rounds(where, m, new["antenna"], new["age"])
    return replace(m, **new)


def _names(where: str, field: str, value: object) -> tuple[str, ...]:
    if isinstance(value, str) or not isinstance(value, Sequence) or not all(isinstance(name, str) for name in value):
        raise bad_field(where, field, value, "names")
    return tuple(value)


def _integers(where: str, field: str, value: object, count: int | None) -> Any:
    found = np.asarray(value)
    if found.shape != (count,) or (count and found.dtype.kind not in "iu"):
        raise bad_field(where, field, value, f"{count} whole numbers")
    return found.astype(np.int64)


def _descriptors(where: str, value: object, count: int | None) -> Any:
    rows = np.array(value)
    if rows.ndim != 2 or len(rows) != count:
        raise InputError(f"{where}: descriptors has shape {rows.shape}, expected ({count}, D)")
    return rows


def _column(where: str, field: str, value: object, count: int) -> Array:
    """Numbers (N,), or (N, 2) of pixels."""
    width = WIDTHS.get(field)
    column = _shaped(where, field, value, (count,) if width is None else (count, width))
    known = column[~np.isnan(column)] if field in MAY_LACK else column
    _finite(where, field, known)
    if field in ABOVE_ZERO and np.any(known <= 0.0):
        raise bad_field(where, field, float(known[known <= 0.0][0]), "more than 0, NaN where not measured")
    return column


def numbers(where: str, field: str, value: object) -> Array:
    """A new array of ``value``; InputError if it is not of numbers."""
    try:
        return np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"{where}: {field} is {' '.join(repr(value).split())}, expected numbers") from None


def _shaped(where: str, field: str, value: object, shape: tuple[int, ...]) -> Array:
    found = numbers(where, field, value)
    if found.shape != shape:
        raise InputError(f"{where}: {field} has shape {found.shape}, expected {shape}")
    return found


def _finite(where: str, field: str, values: Array) -> Array:
    bad = values[~np.isfinite(values)]
    if bad.size:
        raise bad_field(where, field, float(bad.flat[0]), "a finite number")
    return values


def _check_rounds(where: str, m: RfidScan, antenna: Any, age: Any) -> None:
    if np.any((antenna < 0) | (antenna >= len(m.antennas))):
        raise bad_field(where, "antenna", antenna.tolist(), f"places in its {len(m.antennas)} antennas, from 0")
    if np.any(age < 0.0):
        raise bad_field(where, "age", float(age.min()), "a read that is not after the end of its round")
