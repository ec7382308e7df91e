"""Scans of an RFID reader: their types, the columns of their files, and checks of live scans."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files import values
from factorgraph_loc.files.columns import (
    ANGLE,
    DURATION,
    FREQUENCY,
    FULL_TURN,
    POWER,
    PURE,
    STAMP,
    Column,
    Table,
    named,
    number,
)
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.measurement import Measurement, Stream
from factorgraph_loc.text import listed, plain
from factors.rfid.signals import PhaseReads
from factors.se2 import Array, Integers

MAX_GAP = 0.1  # s; longest interpolated gap between reference poses
PHASE_WINDOW = 2.0  # s; length of the time windows for the comparison of phases

ANTENNA = named("antenna", "the name of an antenna")
RFID = Table(
    "rfid",
    (
        STAMP,
        ANTENNA,
        named("epc", "the EPC of a tag"),
        number("rssi", POWER, -200.0, 200.0, "signal strength; readers differ in its zero point", may_lack=True),
        number("phase", ANGLE, -FULL_TURN, FULL_TURN, "phase as the reader reports it", may_lack=True),
        number("frequency", FREQUENCY, 1e8, 1e10, "frequency of the carrier", may_lack=True),
        Column("inventory", "whole", PURE, 1.0, 2.0**53, False, "the number of the round's row in inventories"),
    ),
    is_scan=True,
    optional=(("rssi",), ("phase", "frequency"), ("inventory",)),
)
INVENTORIES = Table(
    "inventories",
    (STAMP, ANTENNA, number("duration", DURATION, 0.0, 3600.0, "duration of the round, which ends at the timestamp")),
    is_scan=True,
)
# the index of a read's antenna in a scan
PLACE = Column("antenna", "whole", PURE, -(2.0**53), 2.0**53, False, "index in antennas")
# the fields of reads in a stream or scan; times are relative to the end of the round
READS = Table(
    "reads",
    (
        number("age", DURATION, 0.0, 3600.0, "time from the read to the end of its round"),
        *(RFID[name] for name in ("rssi", "phase", "frequency")),
    ),
    stream="factorgraph_loc.sensors.rfid.stream:RfidStream",
    is_scan=True,
)


@dataclass(frozen=True, slots=True)
class RfidScan:
    """Inventory rounds of A antennas that ended at the time ``t`` [s], with R tag reads.

    ``antennas``: the antenna of each round. Tags that a round did not read count as missed by this antenna. ``antenna``
    (R,): the index in ``antennas`` of the round of each read. ``tags``: R EPCs. ``age`` (R,): time [s] from the read to
    ``t``. ``rssi`` (R,) [dBm], ``phase`` (R,) [rad] as reported, carrier ``frequency`` (R,) [Hz]: NaN if unknown.
    """

    sensor: ClassVar[str] = "rfid"
    modality: ClassVar[str] = "rfid"
    is_motion: ClassVar[bool] = False
    t: float
    antennas: tuple[str, ...]
    antenna: NDArray[np.int64]
    tags: tuple[str, ...]
    age: Array
    rssi: Array
    phase: Array
    frequency: Array
    source: str = field(default=modality, kw_only=True)

    @property
    def count(self) -> int:
        """The number A of rounds."""
        return len(self.antennas)


@dataclass(frozen=True)
class RfidStream(Stream):
    """All reads of a log, one per row. A round without reads has one row with an empty EPC.

    ``t`` (N,): end of the inventory round [s]. Rows with equal ``t`` form a scan. ``round`` (N,): index of the round in
    the scan. ``antenna``, ``epc``: N names. ``age`` (N,): time [s] from the read to ``t``. ``rssi`` (N,) [dBm],
    ``phase`` (N,) [rad], ``frequency`` (N,) [Hz]: NaN if unknown.
    """

    kind: ClassVar[type[Any]] = RfidScan
    round: NDArray[np.int64]
    antenna: Sequence[str]
    epc: Sequence[str]
    age: Array
    rssi: Array
    phase: Array
    frequency: Array

    @cached_property
    def number(self) -> Integers:
        """The index (N,) of the round of each row, from 0 to R - 1 for the R rounds of the log."""
        scan = np.cumsum(np.diff(self.t, prepend=np.nan) != 0.0).tolist()
        numbers: dict[tuple[int, int], int] = {}
        keys = zip(scan, self.round.tolist(), strict=True)
        return np.array([numbers.setdefault(key, len(numbers)) for key in keys], dtype=np.int64)

    @property
    def first_rows(self) -> Integers:
        """The index (R,) of the first row of each of R rounds."""
        return np.asarray(np.unique(self.number, return_index=True)[1])

    def hits(self, tags: Mapping[str, int]) -> NDArray[np.bool_]:
        """Return a mask (R, T) that is True if round r has read tag t. ``tags``: the column t of each tag by EPC."""
        out = np.zeros((len(self.first_rows), len(tags)), dtype=bool)
        columns = np.array([tags.get(epc, -1) for epc in self.epc], dtype=np.int64)
        out[self.number[columns >= 0], columns[columns >= 0]] = True
        return out

    def measurements(self, offset: float) -> Iterator[Measurement]:
        for i, j in self.scans():
            rounds: dict[int, int] = {}
            names: list[str] = []
            for index, antenna in zip(self.round[i:j].tolist(), self.antenna[i:j], strict=True):
                if index not in rounds:
                    rounds[index] = len(names)
                    names.append(antenna)
            rows = [k for k in range(i, j) if self.epc[k]]
            yield RfidScan(
                float(self.t[i]) + offset,
                tuple(names),
                np.array([rounds[int(self.round[k])] for k in rows], dtype=np.int64),
                tuple(self.epc[k] for k in rows),
                self.age[rows],
                self.rssi[rows],
                self.phase[rows],
                self.frequency[rows],
            )


@dataclass(frozen=True)
class RfidRead:
    """One read of a tag, an argument of :func:`scan_of`.

    ``antenna``: the name of the antenna. ``epc``: the EPC of the tag. ``t``: time of the read [s], None for the end of
    the round. ``rssi`` [dBm], ``phase`` [rad] as the reader reports it, ``frequency`` of the carrier [Hz]: NaN if
    unknown. ``round``: the index of the round among ``antennas`` of :func:`scan_of`. If it is None, the k-th read of a
    tag by an antenna is assigned to the k-th round of the antenna.
    """

    antenna: str
    epc: str
    t: float | None = None
    rssi: float = math.nan
    phase: float = math.nan
    frequency: float = math.nan
    round: int | None = None


def scan_of(t: float, antennas: Iterable[str], reads: Iterable[RfidRead]) -> RfidScan:
    """Return the scan of inventory rounds that ended at ``t`` [s], with the given ``reads``. ``antennas``: the antenna
    of each round. Raises InputError if a read is invalid, or if its antenna or its round is not in the scan."""
    t = values.seconds_of("RfidScan", t)
    where = f"RfidScan at {t:.3f} s"
    antenna_names = values.names(where, "antennas", values.items_of(where, "antennas", antennas))
    rows = values.items_of(where, "reads", reads)
    for read in rows:
        if not isinstance(read, RfidRead):
            raise bad_field(where, "read", read, "an RfidRead")
    times = [t if read.t is None else values.seconds_of(where, read.t, "time of a read") for read in rows]
    return RfidScan(
        t,
        antenna_names,
        _rounds(where, times, antenna_names, rows),
        tuple(read.epc for read in rows),
        t - np.array(times),
        *(
            values.numbers(where, name, [getattr(read, name) for read in rows])
            for name in ("rssi", "phase", "frequency")
        ),
    )


def _rounds(where: str, times: Sequence[float], names: tuple[str, ...], reads: Sequence[RfidRead]) -> NDArray[np.int64]:
    """Return the index (R,) of the round of each of R reads. ``times``: times of the reads [s]. ``names``: the antenna
    of each round. ``where``: the name of the scan in error messages.

    Reads are assigned in order of time. A read with an unknown round is assigned to the first round of its antenna
    without a read of the same tag. If there is no such round, it is assigned to the last round.
    """
    own = {name: [k for k, antenna in enumerate(names) if antenna == name] for name in names}
    out = np.full(len(reads), -1, dtype=np.int64)
    for i, read in enumerate(reads):
        if not isinstance(read.antenna, str) or read.antenna not in names:
            raise bad_field(where, "antenna", read.antenna, f"one of the active antennas: {listed(names)}")
        if not isinstance(read.epc, str):
            raise bad_field(where, "epc", read.epc, RFID["epc"].doc)
        if read.round is None:
            continue
        if not isinstance(read.round, (int, np.integer)) or read.round not in own[read.antenna]:
            expected = f"one of antenna {plain(read.antenna)}: {listed(own[read.antenna])}"
            raise bad_field(where, "round", read.round, expected)
        out[i] = read.round
    taken = {(read.epc, int(k)) for read, k in zip(reads, out, strict=True) if k >= 0}
    for i in sorted(np.flatnonzero(out < 0).tolist(), key=times.__getitem__):
        rounds, epc = own[reads[i].antenna], reads[i].epc
        out[i] = next((k for k in rounds if (epc, k) not in taken), rounds[-1])
        taken.add((epc, int(out[i])))
    return out


def check(m: RfidScan, where: str) -> dict[str, Any]:
    """Return the validated fields of ``m`` by name. Raises InputError for the first invalid field. ``where``: the name
    of the measurement in error messages."""
    tags, antennas = values.names(where, "tags", m.tags), values.names(where, "antennas", m.antennas)
    antenna = values.integers(where, PLACE, m.antenna, len(tags))
    if np.any((antenna < 0) | (antenna >= len(antennas))):
        raise bad_field(where, "antenna", antenna.tolist(), f"indices of its {len(antennas)} antennas, from 0")
    columns = {
        column.name: values.within(where, column, getattr(m, column.name), (len(tags),)) for column in READS.columns
    }
    return {"tags": tags, "antennas": antennas, "antenna": antenna, **columns}


def along_reference(
    log: Log, tags: Mapping[str, int], antennas: Mapping[str, int]
) -> tuple[RfidStream, Integers, Array, Array, Integers, Integers]:
    """Return the R reads of a log with known tag, antenna and reference pose, as six values.

    They are the stream, the row indices (R,) of the reads in it, and the times (R,) [s] of the reads. Then follow the
    robot's poses (R, 3), antenna indices (R,), and tag indices (R,). ``tags``, ``antennas``: the index of each tag by
    EPC, and of each antenna by name. Raises InputError if the log has no reference or no reads.
    """
    if log.reference is None:
        raise InputError(f"{log.name}: has no reference trajectory, which the calibration needs")
    stream = log.streams.get("rfid")
    if not isinstance(stream, RfidStream):
        raise InputError(f"{log.name}: has no RFID reads (stream rfid)")
    t = stream.t - stream.age + log.rig.time_offset("rfid")
    tag = np.array([tags.get(name, -1) for name in stream.epc], dtype=np.int64)
    antenna = np.array([antennas.get(name, -1) for name in stream.antenna], dtype=np.int64)
    poses = log.reference.at(t, max_gap=MAX_GAP)
    rows = np.flatnonzero((tag >= 0) & (antenna >= 0) & np.isfinite(poses[:, 0]))
    return stream, rows, t[rows], poses[rows], antenna[rows], tag[rows]


def phase_reads(
    log: Log, tags: Mapping[str, int], antennas: Mapping[str, int], window: float = PHASE_WINDOW, first_window: int = 0
) -> PhaseReads:
    """Return the reads with a phase along the reference of a log, with poses in the world frame.

    ``tags``, ``antennas``: the index of each tag by EPC, and of each antenna by name. ``window``: the length [s] of the
    time windows. Phases are only compared within a window. ``first_window``: the index of the first window in the
    result. Raises InputError if the log has no reference or no reads.
    """
    stream, rows, t, poses, antenna, tag = along_reference(log, tags, antennas)
    windows = first_window + np.floor((t - t.min(initial=np.inf)) / window).astype(np.int64)
    reads = PhaseReads(poses, antenna, tag, stream.phase[rows], stream.frequency[rows], windows)
    return reads.chosen(np.isfinite(reads.phase) & np.isfinite(reads.frequency))
