"""The stream of an RFID reader."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.model.measurement import Measurement, Stream
from factorgraph_loc.sensors.rfid.measurement import RfidScan
from factors.se2 import Array


@dataclass(frozen=True)
class RfidStream(Stream):
    """One row per read of a tag, and one with an empty EPC for a round without reads.

    ``t`` (N,): end of the inventory round; rows of one timestamp form a scan. ``round`` (N,): number of the round, unique within a
    timestamp. ``antenna`` and ``epc``: N names; ``age`` (N,) [s]: time from the read to ``t``; ``rssi`` (N,) [dBm], ``phase`` (N,)
    [rad], ``frequency`` (N,) [Hz]: NaN if unknown.
    """

    round: NDArray[np.int64]
    antenna: Sequence[str]
    epc: Sequence[str]
    age: Array
    rssi: Array
    phase: Array
    frequency: Array

    def measurements(self, offset: float) -> Iterator[Measurement]:
        for i, j in self.scans():
            rounds: dict[int, int] = {}
            names: list[str] = []
            for number, antenna in zip(self.round[i:j].tolist(), self.antenna[i:j], strict=True):
                if number not in rounds:
                    rounds[number] = len(names)
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
