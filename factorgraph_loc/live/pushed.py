"""Measurements from a running program: checked and copied, so that whoever made them may use the arrays again."""

import contextlib
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.columns import SECONDS, Column
from factorgraph_loc.model.measurement import Exteroceptive, Odometry
from factorgraph_loc.sensors.camera.columns import FEATURES, SIGHTINGS
from factorgraph_loc.sensors.camera.measurement import PixelSightings
from factorgraph_loc.sensors.landmarks.columns import BEARING_RANGE
from factorgraph_loc.sensors.landmarks.measurement import BearingRange
from factorgraph_loc.sensors.odometry.columns import IMU, INCREMENTS, VELOCITIES
from factorgraph_loc.sensors.odometry.measurement import IncrementOdometry, VelocityOdometry, YawRate
from factorgraph_loc.sensors.rfid.columns import READS, RFID
from factorgraph_loc.sensors.rfid.measurement import RfidScan
from factorgraph_loc.sensors.twist.columns import TWIST
from factorgraph_loc.sensors.twist.measurement import Twist
from factorgraph_loc.text import listed, plain
from factorgraph_loc.vision.frame import CameraFrame
from factors.se2 import Array

M = TypeVar("M", bound=Odometry | Exteroceptive)
# sensors as a rig and a log name them
KINDS = (VelocityOdometry, IncrementOdometry, YawRate, Twist, BearingRange, RfidScan, PixelSightings, CameraFrame)
ALL_SENSORS = (
    "odometry",
    "imu",
    "twist",
    "bearing_range",
    "rfid",
    "sightings",
    "camera",
    "sightings_right",
    "rssi",
    "phase",
)
# fields that name something, of which each has a row in the fields that are not numbers of their own
NAMES: dict[type, str] = {BearingRange: "landmarks", RfidScan: "tags", PixelSightings: "points"}
# fields that hold numbers, and their bounds
COLUMNS: dict[type, dict[str, Column]] = {
    VelocityOdometry: {name: VELOCITIES[name] for name in ("v", "w")},
    IncrementOdometry: {name: INCREMENTS[name] for name in ("dx", "dy", "dtheta")},
    YawRate: {"w": IMU["w"]},
    Twist: {name: TWIST[name] for name in ("v", "w")},
    BearingRange: {"range": BEARING_RANGE["range"].measured, "bearing": BEARING_RANGE["bearing"]},
    RfidScan: {column.name: column for column in READS.columns},
    PixelSightings: {"pixels": SIGHTINGS["u"]},
    CameraFrame: {name: FEATURES[name] for name in ("pixels", "sizes")},
}
NUMBER = (int, float, np.integer, np.floating)
BYTE = replace(FEATURES["descriptors"], kind="whole", low=0.0, high=255.0)


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
    if type(m) not in KINDS:
        raise InputError(
            f"{type(m).__name__} is no measurement, expected one of {', '.join(k.__name__ for k in KINDS)}"
        )
    return m.sensor


def scan_of(t: float, antennas: Iterable[str], reads: Iterable[RfidRead]) -> RfidScan:
    """The scan of rounds that ended at ``t``, in which ``antennas`` listened; InputError if a read is of another antenna, or of
    another one's round, or is none."""
    t = seconds_of("RfidScan", t)
    where = f"RfidScan at {t:.3f} s"
    names = _names(where, "antennas", _listed(where, "antennas", antennas))
    rows = _listed(where, "reads", reads)
    for read in rows:
        if not isinstance(read, RfidRead):
            raise bad_field(where, "read", read, "an RfidRead")
    return RfidScan(
        t,
        names,
        _rounds(where, t, names, rows),
        tuple(read.epc for read in rows),
        np.array([0.0 if read.t is None else t - seconds_of(where, read.t, "time of a read") for read in rows]),
        *(numbers(where, name, [getattr(read, name) for read in rows]) for name in ("rssi", "phase", "frequency")),
    )


def _listed(where: str, field: str, values: object) -> tuple[Any, ...]:
    found = None
    if isinstance(values, Iterable) and not isinstance(values, str):
        with contextlib.suppress(TypeError):  # an array without rows
            found = tuple(values)
    if found is None:
        raise bad_field(where, field, values, "a list of them")
    return found


def _rounds(where: str, t: float, names: tuple[str, ...], reads: Sequence[RfidRead]) -> NDArray[np.int64]:
    """Which of the rounds each read (R,) belongs to.

    Where a read does not tell it, that is the first round of its antenna in which the tag was not read yet, by the order of time,
    and the last one if there are more reads than rounds.
    """
    out = np.full(len(reads), -1, dtype=np.int64)
    for i, read in enumerate(reads):
        if not isinstance(read.antenna, str) or read.antenna not in names:
            raise bad_field(where, "antenna", read.antenna, f"one that listened: {listed(names)}")
        if not isinstance(read.epc, str):
            raise bad_field(where, "epc", read.epc, RFID["epc"].doc)
        if read.round is None:
            continue
        own = [k for k, name in enumerate(names) if name == read.antenna]
        if not isinstance(read.round, (int, np.integer)) or read.round not in own:
            expected = f"one of antenna {plain(read.antenna)}: {listed(own)}"
            raise bad_field(where, "round", read.round, expected)
        out[i] = read.round
    taken = {(read.epc, int(k)) for read, k in zip(reads, out, strict=True) if k >= 0}
    untold = [i for i in range(len(reads)) if out[i] < 0]
    for i in sorted(untold, key=lambda i: t if (at := reads[i].t) is None else seconds_of(where, at, "time of a read")):
        mine = [k for k, name in enumerate(names) if name == reads[i].antenna]
        out[i] = next((k for k in mine if (reads[i].epc, k) not in taken), mine[-1])
        taken.add((reads[i].epc, int(out[i])))
    return out


def checked(m: M) -> M:
    """The same measurement with arrays of its own; InputError names the first field that cannot be, its value, and what can."""
    sensor_of(m)
    kind = type(m)
    t = seconds_of(kind.__name__, m.t)
    where = f"{kind.__name__} at {t:.3f} s"
    new: dict[str, Any] = {"t": t}
    count = None
    if kind in NAMES:
        new[NAMES[kind]] = _names(where, NAMES[kind], getattr(m, NAMES[kind]))
        count = len(new[NAMES[kind]])
    elif isinstance(m, CameraFrame):
        new["pixels"] = numbers(where, "pixels", m.pixels)
        if new["pixels"].ndim != 2:
            raise InputError(f"{where}: pixels has shape {new['pixels'].shape}, expected (K, 2)")
        count = len(new["pixels"])
    for field in fields(m):
        name, value = field.name, getattr(m, field.name)
        if name in COLUMNS[kind]:
            shape = (3,) if kind is Twist else () if count is None else (count, 2) if name == "pixels" else (count,)
            new[name] = _within(where, COLUMNS[kind][name], name, value, shape)
        elif name == "antennas":
            new[name] = _names(where, name, value)
        elif name in ("antenna", "tracks"):
            new[name] = _integers(where, name, value, count)
        elif name == "descriptors":
            new[name] = _descriptors(where, value, count, getattr(m, "feature", ""))
        elif name == "feature" and not isinstance(value, str):
            raise bad_field(where, name, value, "the name of a feature")
        elif name == "right":
            new[name] = _truth(where, name, value)
        if isinstance(m, RfidScan) and name == "antenna":
            _check_rounds(where, m, new[name])
    return replace(m, **new)


def seconds_of(where: str, value: object, name: str = "t") -> float:
    """A time [s]; InputError if it is none, or is further away than stamps can be."""
    found = math.nan
    if isinstance(value, NUMBER) and not isinstance(value, bool):
        with contextlib.suppress(OverflowError):
            found = float(value)
    if SECONDS.outside(np.array(found)):
        raise bad_field(where, name, value, SECONDS.expected)
    return found


def numbers(where: str, field: str, value: object) -> Array:
    """A new array of ``value``; InputError if it is not of real numbers."""
    try:
        found = np.array(value)
        if found.dtype.kind == "O" and all(
            isinstance(item, NUMBER) and not isinstance(item, bool) for item in found.flat
        ):
            found = found.astype(float)
    except (TypeError, ValueError, OverflowError):  # rows of different lengths, whole numbers of hundreds of digits
        raise bad_field(where, field, value, "numbers") from None
    if found.dtype.kind not in "iuf" and found.size:
        raise bad_field(where, field, value, "numbers")
    return np.asarray(found, dtype=float)


def _within(where: str, column: Column, field: str, value: object, shape: tuple[int, ...]) -> Any:
    """Numbers of a shape within the bounds of their column: a float where the shape is ()."""
    found = numbers(where, field, value)
    if found.shape != shape:
        raise InputError(f"{where}: {field} has shape {found.shape}, expected {shape}")
    if (bad := column.outside(found)).any():
        lack = ", or NaN where not measured" if column.may_lack else ""
        raise bad_field(where, field, float(found[bad].flat[0]), column.expected + lack)
    return found if shape else float(found)


def _truth(where: str, field: str, value: object) -> bool:
    if not isinstance(value, (bool, np.bool_)):
        raise bad_field(where, field, value, "True or False")
    return bool(value)


def _names(where: str, field: str, value: object) -> tuple[str, ...]:
    if isinstance(value, str) or not isinstance(value, Sequence) or not all(isinstance(name, str) for name in value):
        raise bad_field(where, field, value, "names")
    return tuple(value)


def _integers(where: str, field: str, value: object, count: int | None) -> Any:
    found = numbers(where, field, value)
    if found.shape != (count,) or (count and np.asarray(value).dtype.kind not in "iu"):
        raise bad_field(where, field, value, f"{count} whole numbers")
    if (bad := FEATURES["tracks"].outside(found)).any():
        raise bad_field(where, field, float(found[bad][0]), FEATURES["tracks"].expected)
    return found.astype(np.int64)


def _descriptors(where: str, value: object, count: int | None, feature: str) -> Any:
    """Descriptors (K, D), bytes of a feature that is compared by bits."""
    rows = numbers(where, "descriptors", value)
    if rows.ndim != 2 or len(rows) != count:
        raise InputError(f"{where}: descriptors has shape {rows.shape}, expected ({count}, D)")
    binary = feature == "orb"
    column = BYTE if binary else FEATURES["descriptors"]
    if (bad := column.outside(rows)).any():
        raise bad_field(where, "descriptors", float(rows[bad][0]), column.expected)
    return rows.astype(np.uint8 if binary else np.float32)


def _check_rounds(where: str, m: RfidScan, antenna: Any) -> None:
    if np.any((antenna < 0) | (antenna >= len(m.antennas))):
        raise bad_field(where, "antenna", antenna.tolist(), f"places in its {len(m.antennas)} antennas, from 0")
