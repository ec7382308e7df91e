"""Pushed tag reads and their validation."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import bad_field
from factorgraph_loc.files.columns import PURE, Column
from factorgraph_loc.files.values import integers, items_of, names, numbers, seconds_of, within
from factorgraph_loc.sensors.rfid.columns import READS, RFID
from factorgraph_loc.sensors.rfid.measurement import RfidScan
from factorgraph_loc.text import listed, plain

PLACE = Column("antenna", "whole", PURE, -(2.0**53), 2.0**53, False, "index in antennas")


@dataclass(frozen=True)
class RfidRead:
    """A read of a tag: name of the antenna and EPC; ``t`` [s]: time of the read, None for the end of the round. ``rssi`` [dBm],
    ``phase`` [rad] as the reader reports it, ``frequency`` [Hz] of the carrier: NaN if unknown. ``round``: index of the round in
    the list of antennas that are pushed together, or None. In that case the first read of a tag by an antenna belongs to the
    antenna's first round, the next one to its next round, as a tag responds once per round."""

    antenna: str
    epc: str
    t: float | None = None
    rssi: float = math.nan
    phase: float = math.nan
    frequency: float = math.nan
    round: int | None = None


def scan_of(t: float, antennas: Iterable[str], reads: Iterable[RfidRead]) -> RfidScan:
    """The scan of rounds of ``antennas`` that ended at ``t``; InputError if a read is invalid, or names another antenna or a round
    of another antenna."""
    t = seconds_of("RfidScan", t)
    where = f"RfidScan at {t:.3f} s"
    antenna_names = names(where, "antennas", items_of(where, "antennas", antennas))
    rows = items_of(where, "reads", reads)
    for read in rows:
        if not isinstance(read, RfidRead):
            raise bad_field(where, "read", read, "an RfidRead")
    return RfidScan(
        t,
        antenna_names,
        _rounds(where, t, antenna_names, rows),
        tuple(read.epc for read in rows),
        np.array([0.0 if read.t is None else t - seconds_of(where, read.t, "time of a read") for read in rows]),
        *(numbers(where, name, [getattr(read, name) for read in rows]) for name in ("rssi", "phase", "frequency")),
    )


def _rounds(where: str, t: float, names: tuple[str, ...], reads: Sequence[RfidRead]) -> NDArray[np.int64]:
    """The round of each read (R,). If a read does not name it: the first round of its antenna in which the tag was not read yet, in
    order of time, or the last round."""
    out = np.full(len(reads), -1, dtype=np.int64)
    for i, read in enumerate(reads):
        if not isinstance(read.antenna, str) or read.antenna not in names:
            raise bad_field(where, "antenna", read.antenna, f"one of the active antennas: {listed(names)}")
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


def check(m: RfidScan, where: str) -> dict[str, Any]:
    """The fields of a scan; InputError names the first invalid one."""
    tags, antennas = names(where, "tags", m.tags), names(where, "antennas", m.antennas)
    antenna = integers(where, PLACE, m.antenna, len(tags))
    if np.any((antenna < 0) | (antenna >= len(antennas))):
        raise bad_field(where, "antenna", antenna.tolist(), f"indices of its {len(antennas)} antennas, from 0")
    told = {column.name: within(where, column, getattr(m, column.name), (len(tags),)) for column in READS.columns}
    return {"tags": tags, "antennas": antennas, "antenna": antenna, **told}
