"""What an RFID reader reports."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from factors.se2 import Array


@dataclass(frozen=True, slots=True)
class RfidScan:
    """Inventory rounds of one or several antennas that ended at one time, with the R tags that were read in them.

    ``antennas``: A names of those that listened; a name may stand there twice, for two rounds. A tag of the map that none of the
    rows names was not read by an antenna that listened. ``antenna`` (R,): which of ``antennas`` read the row; ``tags``: R EPCs, one
    of them as often as it was read; ``age`` (R,) [s]: how long before ``t``; ``rssi`` (R,) [dBm], ``phase`` (R,) [rad] as the
    reader reports it, and ``frequency`` (R,) [Hz] of the carrier: NaN where unknown.
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
        """How many rounds there were."""
        return len(self.antennas)
