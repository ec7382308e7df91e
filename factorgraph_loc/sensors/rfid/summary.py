"""Summary of the RFID reads in a log, with warnings."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.interfaces import Paragraph, Summary
from factorgraph_loc.sensors.rfid.settings import RfidSettings
from factorgraph_loc.sensors.rfid.stream import RfidStream
from factorgraph_loc.text import listed

STOPPED = 10.0  # s; an antenna without rounds for longer before the end has stopped
CLOCK_STEP = 1.0  # s
SHOWN = 5  # names in a line


@dataclass(frozen=True)
class AntennaSummary:
    """An antenna: numbers of reads and rounds, rounds per second, rounds without a read, and timestamps [s] of the last round and
    read (or None)."""

    reads: int
    rounds: int
    rate: float
    silent: int
    last: float
    last_read: float | None


@dataclass(frozen=True)
class RfidSummary:
    """All reads. ``known``: number of tags of the map that are read; ``unread``: tags that are never read; ``unknown``: reads by
    EPC that the map lacks; ``late``: number of rounds with a timestamp older than one before, and the largest step back [s]."""

    reads: int
    scans: int
    rounds: int
    antennas: Mapping[str, AntennaSummary]
    known: int
    unread: tuple[str, ...]
    unknown: Mapping[str, int]
    late: tuple[int, float]


def summarize(log: Log) -> Summary:
    """``rfid``: a :class:`RfidSummary`, or None if the log lacks the stream."""
    found, in_map = summarize_rfid(log), {"tags": len(log.world.tags)}
    if found is None:
        return Summary({"rfid": None}, in_map)
    return Summary({"rfid": found}, in_map, rfid_problems(log, found), (_told(found),))


def _told(found: RfidSummary) -> Paragraph:
    unknown = f"{len(found.unknown)} others" if found.unknown else "no others"
    header = ("antenna", "reads", "rounds", "rounds per s", "without a read", "last [s]")
    rows = [
        (name, str(a.reads), str(a.rounds), f"{a.rate:.2f}", str(a.silent), f"{a.last:.1f}")
        for name, a in found.antennas.items()
    ]
    return Paragraph(
        f"RFID: {found.reads} reads of {found.known} tags of the map and of {unknown}, in {found.rounds} rounds, "
        f"{found.scans} scans",
        header,
        tuple(rows),
    )


def summarize_rfid(log: Log) -> RfidSummary | None:
    """Summary of the stream ``rfid``, or None."""
    stream = log.streams.get("rfid")
    if not isinstance(stream, RfidStream):
        return None
    scan = np.cumsum(np.diff(stream.t, prepend=np.nan) != 0.0)
    _, first = np.unique(np.column_stack((scan, stream.round)), axis=0, return_index=True)
    first.sort()  # the first row of each round
    is_read = np.array([bool(epc) for epc in stream.epc], dtype=bool)
    antenna = np.array(stream.antenna, dtype=str)
    read_rounds = set(zip(scan[is_read].tolist(), stream.round[is_read].tolist(), strict=True))
    silent = np.array([(int(scan[i]), int(stream.round[i])) not in read_rounds for i in first], dtype=bool)
    antennas = {}
    for name in dict.fromkeys(stream.antenna):
        mine = antenna[first] == name
        t, reads = stream.t[first[mine]], stream.t[is_read & (antenna == name)]
        span = float(t.max() - t.min())
        antennas[name] = AntennaSummary(
            reads=len(reads),
            rounds=len(t),
            rate=(len(t) - 1) / span if span > 0.0 else 0.0,
            silent=int(np.count_nonzero(silent & mine)),
            last=float(t.max()),
            last_read=float(reads.max()) if len(reads) else None,
        )
    counts = Counter(epc for epc in stream.epc if epc)
    t = stream.t[first]
    late = np.maximum.accumulate(t) - t if len(t) else t
    return RfidSummary(
        reads=int(np.count_nonzero(is_read)),
        scans=int(scan[-1]) if len(scan) else 0,
        rounds=len(first),
        antennas=antennas,
        known=sum(epc in counts for epc in log.world.tags),
        unread=tuple(epc for epc in log.world.tags if epc not in counts),
        unknown={epc: count for epc, count in counts.most_common() if epc not in log.world.tags},
        late=(int(np.count_nonzero(late)), float(late.max(initial=0.0))),
    )


def rfid_problems(log: Log, found: RfidSummary) -> list[str]:
    """Warnings about the reads."""
    out = []
    if found.unread:
        out.append(
            f"{len(found.unread)} of {len(log.world.tags)} tags of the map are never read: {listed(found.unread, SHOWN)}"
        )
    if found.unknown:
        reads = sum(found.unknown.values())
        out.append(f"{reads} reads are of {len(found.unknown)} tags that the map lacks: {listed(found.unknown, SHOWN)}")
    carried = log.rig.of(RfidSettings).all_antennas() if log.rig.find(RfidSettings) else {}
    out += [
        f"antenna {name} is not on the rig: {antenna.reads} reads, {antenna.rounds} rounds"
        for name, antenna in found.antennas.items()
        if name not in carried
    ]
    out += [f"antenna {name} of the rig is never active" for name in carried if name not in found.antennas]
    last = max((antenna.last for antenna in found.antennas.values()), default=0.0)
    for name, antenna in found.antennas.items():
        if antenna.last < last - STOPPED:
            out.append(f"antenna {name} stops at {antenna.last:.1f} s, {last - antenna.last:.1f} s before the others")
        elif antenna.last_read is None:
            out.append(f"antenna {name} reads nothing")
        elif antenna.last_read < last - STOPPED:
            out.append(f"antenna {name} reads nothing after {antenna.last_read:.1f} s")
    return out + _clock_trouble(log, found)


def _clock_trouble(log: Log, found: RfidSummary) -> list[str]:
    out = []
    count, step = found.late
    if step > CLOCK_STEP:
        out.append(
            f"{count} rounds have stamps up to {step:.1f} s before an earlier one: did the clock of the reader jump?"
        )
    odometry = log.streams.get("odometry")
    if odometry is None or not len(odometry.t) or not found.rounds:
        return out
    t = log.streams["rfid"].t + log.rig.time_offset("rfid")
    wheels = odometry.t + log.rig.time_offset("odometry")
    for side, excess in (("before", wheels.min() - t.min()), ("after", t.max() - wheels.max())):
        if excess > CLOCK_STEP:
            out.append(f"the reads reach {excess:.1f} s {side} the odometry: do their clocks agree?")
    return out
