"""Reads and writes the RFID tables of the native format: ``rfid.csv`` with a row per read, ``inventories.csv`` with a
row per round.

A read belongs to the round that it names, or to the round of its antenna that contains its timestamp. Without
inventories, rounds are derived from the gaps between reads, and rounds without reads are unknown. Misses are as
informative as reads, so each read must be assigned to the correct round.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files import checks
from factorgraph_loc.files.tables import TableRows
from factorgraph_loc.sensors.rfid.settings import RfidSettings
from factorgraph_loc.sensors.rfid.stream import RfidStream
from factorgraph_loc.sensors.tables import Columns, Reading, Writing
from factorgraph_loc.text import Notice, notice
from factors.se2 import Array, Integers

OUTSIDE = -1  # the round of a read that is in no inventory


def rounds_from_gaps(t_ns: Integers, antenna: Sequence[str], gap: float) -> Integers:
    """Return the index (N,) of the inventory round of each of N reads, from 0, if the log has no table of rounds.

    ``t_ns`` (N,), ``antenna`` (N): time [ns] and antenna of each read, in order of time. A round ends when another
    antenna reads a tag, or after ``gap`` [s] without a read. Rounds without reads cannot be detected.
    """
    names = np.asarray(antenna, dtype=str)
    first = np.ones(len(t_ns), dtype=bool)
    first[1:] = (np.diff(t_ns) > round(gap * 1e9)) | (names[1:] != names[:-1])
    return np.asarray(np.cumsum(first) - 1, dtype=np.int64)


def rounds_from_inventories(
    t_ns: Integers, antenna: Sequence[str], end_ns: Integers, inventory_antenna: Sequence[str], duration_ns: Integers
) -> Integers:
    """Return the index (N,) of the inventory round of each of N reads, :data:`OUTSIDE` for reads in no round.

    ``t_ns`` (N,), ``antenna`` (N): time [ns] and antenna of each read. ``end_ns``, ``duration_ns`` (R,),
    ``inventory_antenna`` (R): end [ns], duration [ns] and antenna of R rounds. A round contains the reads of its
    antenna from its beginning to its end, inclusive. A read on the border of two rounds belongs to the earlier one.
    """
    names, listening = np.asarray(antenna, dtype=str), np.asarray(inventory_antenna, dtype=str)
    out = np.full(len(t_ns), OUTSIDE, dtype=np.int64)
    for name in np.unique(names):
        reads = np.flatnonzero(names == name)
        mine = np.flatnonzero(listening == name)
        if not len(mine):
            continue
        mine = mine[np.argsort(end_ns[mine], kind="stable")]
        nearest = np.searchsorted(end_ns[mine], t_ns[reads], side="left")
        inventory = mine[np.minimum(nearest, len(mine) - 1)]
        begin = end_ns[inventory] - duration_ns[inventory]
        holds = (nearest < len(mine)) & (t_ns[reads] >= begin)
        out[reads[holds]] = inventory[holds]
    return out


def ends_of(t_ns: Integers, number: Integers, gap: float) -> Integers:
    """Return the end (R,) [ns] of R rounds from :func:`rounds_from_gaps`. It is the time of the next read, but at most
    ``gap`` [s] after the last read of the round. ``t_ns``, ``number`` (N,): time [ns] and round index of each read."""
    last = np.flatnonzero(np.diff(number, append=number[-1:] + 1))
    following = np.append(t_ns, np.iinfo(np.int64).max)[last + 1]
    return np.asarray(np.minimum(t_ns[last] + round(gap * 1e9), following), dtype=np.int64)


SIGNALS = ("rssi", "phase", "frequency")  # optional columns of reads
ROUND_GAP: float = RfidSettings.model_fields["round_gap"].default


@dataclass(frozen=True)
class ReadsByRound:
    """N reads in R rounds.

    ``t_ns`` (N,), ``epc`` (N), ``number`` (N,): time [ns], EPC and round index of each read. ``columns``: RSSI, phase
    and frequency of each read, each (N,). ``end_ns`` (R,), ``antenna`` (R): end [ns] and antenna of each round.
    """

    t_ns: Integers
    number: Integers
    epc: list[str]
    columns: tuple[Array, Array, Array]
    end_ns: Integers
    antenna: list[str]

    def stream(self, t0_ns: int) -> RfidStream:
        """Return the reads as a stream, in the order of the rounds. A round without reads becomes a row without an EPC.
        ``t0_ns``: the absolute time of t = 0 [ns]."""
        silent = np.setdiff1d(np.arange(len(self.end_ns)), self.number)
        rounds = np.concatenate((self.number, silent))
        order = np.argsort(rounds, kind="stable")
        rounds = rounds[order]
        ages = np.concatenate(((self.end_ns[self.number] - self.t_ns) / 1e9, np.zeros(len(silent))))
        nothing = np.full(len(silent), np.nan)
        rssi, phase, frequency = (np.concatenate((column, nothing))[order] for column in self.columns)
        names = [*self.epc, *[""] * len(silent)]
        return RfidStream(
            t=np.asarray((self.end_ns[rounds] - t0_ns) / 1e9),
            round=rounds,
            antenna=[self.antenna[i] for i in rounds.tolist()],
            epc=[names[i] for i in order.tolist()],
            age=ages[order],
            rssi=rssi,
            phase=phase,
            frequency=frequency,
        )


def assemble(rows: Mapping[str, TableRows], reading: Reading) -> RfidStream:
    """Return the reads of a log as a stream. Without the table "inventories", gaps between reads separate inventory
    rounds. ``rows``: the rows by table name. ``reading``: rig, time origin, and a list to append warnings to."""
    settings = reading.rig.find(RfidSettings)
    gap = ROUND_GAP if settings is None else settings.round_gap
    return read_rounds(rows.get("rfid"), rows.get("inventories"), gap, reading.warnings).stream(reading.t0_ns)


def read_rounds(
    reads: TableRows | None, inventories: TableRows | None, gap: float, warnings: list[Notice]
) -> ReadsByRound:
    """Return the reads of a log, assigned to inventory rounds. Without ``inventories``, a ``gap`` [s] ends a round.

    Reads in none of the ``inventories`` are skipped, and a warning is appended to ``warnings``. Raises InputError with
    file, row and field for an invalid value.
    """
    if inventories is not None:
        return _from_inventories(reads, inventories, warnings)
    assert reads is not None
    checks.arrivals(reads.path, reads.rows, reads.t_ns, warnings, reads.rules)
    order = np.argsort(reads.t_ns, kind="stable")
    antenna = [reads.names["antenna"][i] for i in order.tolist()]
    t_ns = reads.t_ns[order]
    number = rounds_from_gaps(t_ns, antenna, gap)
    end_ns = ends_of(t_ns, number, gap)
    first = np.searchsorted(number, np.arange(len(end_ns)))
    return _rounds(reads, order, number, end_ns, [antenna[i] for i in first.tolist()])


def _from_inventories(reads: TableRows | None, inventories: TableRows, warnings: list[Notice]) -> ReadsByRound:
    """Return the reads, assigned to the rounds in the table ``inventories``. A warning about reads outside of all
    rounds is appended to ``warnings``."""
    end_ns, antenna = inventories.t_ns, inventories.names["antenna"]
    duration = inventories.numbers["duration"]
    # timestamps may decrease, because the clock of a reader may jump; estimators drop late scans
    checks.arrivals(inventories.path, inventories.rows, end_ns, warnings, max_late_ns=None)
    if reads is None:
        nothing = np.zeros(0)
        none = np.zeros(0, dtype=np.int64)
        return ReadsByRound(none, none, [], (nothing, nothing, nothing), end_ns, antenna)
    if "inventory" in reads.numbers:
        if inventories.rules is not None and not inventories.rules.refuse:
            _require_all(inventories)
        number = _named_rounds(reads, end_ns, antenna)
    else:
        duration_ns = np.rint(duration * 1e9).astype(np.int64)
        number = rounds_from_inventories(reads.t_ns, reads.names["antenna"], end_ns, antenna, duration_ns)
    keep = np.flatnonzero(number != OUTSIDE)
    if left := len(number) - len(keep):
        sentence = "{source}: {outside} of {reads} reads lie outside of every inventory and are skipped"
        warnings.append(notice("outside_inventories", sentence, reads.path, left, len(number)))
    return _rounds(reads, keep, number[keep], end_ns, antenna)


def _require_all(inventories: TableRows) -> None:
    """Raise InputError if rows of ``inventories`` were skipped or sorted, because reads refer to these rows by
    number."""
    first, rows = int(inventories.rows.min(initial=2)), inventories.rows
    if first > 2 or np.any(rows != np.arange(first, first + len(rows))):
        raise InputError(
            f"{inventories.path}: some rows were skipped or sorted, but the reads refer to these rows by row number: "
            "correct the rows, or remove the column 'inventory' from the reads"
        )


def _named_rounds(reads: TableRows, end_ns: Integers, antenna: list[str]) -> Integers:
    """Return the round index (N,) of each read, from the row numbers (from 1) in the column ``inventory`` of ``reads``.
    ``end_ns``, ``antenna``: end and antenna of each row of the table of inventories. Raises InputError if a row does
    not exist, has another antenna, or ends before the read."""
    named = reads.numbers["inventory"]
    with np.errstate(invalid="ignore"):
        bad = ~((named >= 1.0) & (named <= len(end_ns)) & (named == np.floor(named)))
    expected = f"the number of a row of inventories, 1 to {len(end_ns)}"
    if not bad.any():
        number = named.astype(np.int64) - 1
        bad = np.array([antenna[k] for k in number.tolist()], dtype=str) != np.array(reads.names["antenna"], dtype=str)
        bad |= end_ns[number] < reads.t_ns
        expected = "an inventory of the same antenna that ends after the read"
    if bad.any():
        i = int(np.flatnonzero(bad)[0])
        raise bad_field(reads.path, "inventory", float(named[i]), expected, row=int(reads.rows[i]))
    return number


def _rounds(reads: TableRows, rows: Integers, number: Integers, end_ns: Integers, antenna: list[str]) -> ReadsByRound:
    """Return the reads in ``rows`` (N,) of the table ``reads``. ``number`` (N,): the index of the round of each read.
    ``end_ns`` (R,), ``antenna`` (R): end [ns] and antenna of each round."""
    epc = [reads.names["epc"][i] for i in rows.tolist()]
    unknown = np.full(len(reads.t_ns), np.nan)
    rssi, phase, frequency = (reads.numbers.get(name, unknown)[rows] for name in SIGNALS)
    return ReadsByRound(reads.t_ns[rows], number, epc, (rssi, phase, frequency), end_ns, antenna)


def disassemble(stream: RfidStream, writing: Writing) -> dict[str, Columns]:
    """Return the columns of the tables "rfid" and "inventories". The duration of a round begins at its first read.
    ``writing``: the time origin."""
    number, first = stream.number, stream.first_rows
    end_ns = checks.absolute(stream.t, writing.t0_ns)
    age_ns = np.rint(stream.age * 1e9).astype(np.int64)
    order = np.argsort(number, kind="stable")
    reads = order[np.array([bool(stream.epc[i]) for i in order.tolist()], dtype=bool)]
    duration_ns = np.zeros(len(first), dtype=np.int64)
    np.maximum.at(duration_ns, number[reads], age_ns[reads])
    return {
        "rfid": {
            "t_ns": end_ns[reads] - age_ns[reads],
            "antenna": [stream.antenna[i] for i in reads.tolist()],
            "epc": [stream.epc[i] for i in reads.tolist()],
            **{name: getattr(stream, name)[reads] for name in SIGNALS},
            "inventory": number[reads] + 1,
        },
        "inventories": {
            "t_ns": end_ns[first],
            "antenna": [stream.antenna[i] for i in first.tolist()],
            "duration": duration_ns / 1e9,
        },
    }
