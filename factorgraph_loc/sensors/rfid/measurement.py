"""Measurements of an RFID reader."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from factors.se2 import Array


@dataclass(frozen=True, slots=True)
class RfidScan:
    """Inventory rounds of one or several antennas that ended at one time, with R tag reads.

    ``antennas``: A names of the active antennas; a name may occur twice, for two rounds. A tag of the map without a read was missed
    by all active antennas. ``antenna`` (R,): index in ``antennas``; ``tags``: R EPCs; ``age`` (R,) [s]: time from the read to
    ``t``; ``rssi`` (R,) [dBm], ``phase`` (R,) [rad] as the reader reports it, and ``frequency`` (R,) [Hz] of the carrier: NaN if
    unknown.
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

    @property
    def count(self) -> int:
        """Number of rounds."""
        return len(self.antennas)
