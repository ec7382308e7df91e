"""The rows of an RFID reader."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.model.stream import Stream
from factorgraph_loc.sensors.rfid.measurement import RfidScan
from factors.se2 import Array


@dataclass(frozen=True)
class RfidStream(Stream):
    """One row a read of a tag, and one with an empty EPC for a round in which an antenna read nothing.

    ``t`` (N,): the end of the inventory round, when its content is known; rows of one stamp make one scan. ``round`` (N,): the
    number of the round that a row belongs to, unique within a stamp. ``antenna`` and ``epc``: N names; ``age`` (N,) [s]: how long
    before ``t`` the tag was read; ``rssi`` (N,) [dBm], ``phase`` (N,) [rad], ``frequency`` (N,) [Hz]: NaN where unknown.
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
