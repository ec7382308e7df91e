"""Assignment of reads to inventory rounds, from the gaps between reads or from logged rounds.

Misses are as informative as reads, so reads must be assigned correctly.
"""

from collections.abc import Sequence

import numpy as np

from factorgraph_loc.sensors.rfid.stream import RfidStream
from factors.se2 import Array, Integers

OUTSIDE = -1


def rounds_from_gaps(t_ns: Integers, antenna: Sequence[str], gap: float) -> Integers:
    """Round numbers (N,) from 0 of reads at sorted ``t_ns`` (N,) by N antennas.

    A round ends with a read of another antenna, or after ``gap`` seconds without a read. Rounds without reads cannot be detected.
    """
    names = np.asarray(antenna, dtype=str)
    first = np.ones(len(t_ns), dtype=bool)
    first[1:] = (np.diff(t_ns) > round(gap * 1e9)) | (names[1:] != names[:-1])
    return np.asarray(np.cumsum(first) - 1, dtype=np.int64)


def rounds_from_inventories(
    t_ns: Integers, antenna: Sequence[str], end_ns: Integers, inventory_antenna: Sequence[str], duration_ns: Integers
) -> Integers:
    """Index of the inventory among R for each of N reads, :data:`OUTSIDE` if none of its antenna contains its timestamp.

    An inventory contains the timestamps from ``end_ns - duration_ns`` to ``end_ns``, inclusive; on a border the earlier one is
    used.
    """
    names, listening = np.asarray(antenna, dtype=str), np.asarray(inventory_antenna, dtype=str)
    out = np.full(len(t_ns), OUTSIDE, dtype=np.int64)
    for name in np.unique(names):
        reads = np.flatnonzero(names == name)
        mine = np.flatnonzero(listening == name)
        if not len(mine):
            continue
        mine = mine[np.argsort(end_ns[mine], kind="stable")]
        found = np.searchsorted(end_ns[mine], t_ns[reads], side="left")
        inventory = mine[np.minimum(found, len(mine) - 1)]
        begin = end_ns[inventory] - duration_ns[inventory]
        holds = (found < len(mine)) & (t_ns[reads] >= begin)
        out[reads[holds]] = inventory[holds]
    return out


def ends_of(t_ns: Integers, number: Integers, gap: float) -> Integers:
    """Times (R,) at which R rounds of :func:`rounds_from_gaps` were complete: at the next read of another antenna, or ``gap``
    seconds after the last read."""
    last = np.flatnonzero(np.diff(number, append=number[-1:] + 1))
    following = np.append(t_ns, np.iinfo(np.int64).max)[last + 1]
    return np.asarray(np.minimum(t_ns[last] + round(gap * 1e9), following), dtype=np.int64)


def make_rfid_stream(
    t_ns: Integers,
    number: Integers,
    epc: Sequence[str],
    columns: tuple[Array, Array, Array],
    end_ns: Integers,
    inventory_antenna: Sequence[str],
    t0_ns: int,
) -> RfidStream:
    """The stream of N reads in rounds ``number`` (N,) of R, in the order of the rounds.

    ``columns``: RSSI, phase and frequency, each (N,). ``end_ns`` (R,) and ``inventory_antenna`` (R): the rounds in order of
    arrival. Reads of a round keep their order; a round without reads becomes a row without an EPC.
    """
    silent = np.setdiff1d(np.arange(len(end_ns)), number)
    rounds = np.concatenate((number, silent))
    order = np.argsort(rounds, kind="stable")
    rounds = rounds[order]
    ages = np.concatenate(((end_ns[number] - t_ns) / 1e9, np.zeros(len(silent))))
    nothing = np.full(len(silent), np.nan)
    rssi, phase, frequency = (np.concatenate((column, nothing))[order] for column in columns)
    names = [*epc, *[""] * len(silent)]
    return RfidStream(
        t=np.asarray((end_ns[rounds] - t0_ns) / 1e9),
        round=rounds,
        antenna=[inventory_antenna[i] for i in rounds.tolist()],
        epc=[names[i] for i in order.tolist()],
        age=ages[order],
        rssi=rssi,
        phase=phase,
        frequency=frequency,
    )
