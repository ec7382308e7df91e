"""How much of a process's time is compilation by numba, told to another process through a small file."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba.core import event


class Seconds(NamedTuple):
    """Processor time and wall-clock time [s]."""

    processor: float
    wall: float


class CompilationClock(event.Listener):
    """Adds up the time of this process's compilations, and writes it into ``path`` when one begins and ends."""

    def __init__(self, path: Path) -> None:
        self._depth = 0  # a function is compiled while another one is
        # what has ended, and when the present one began
        self._file = np.memmap(path, dtype=float, mode="w+", shape=(2, 2))
        self._file[:] = (0.0, 0.0), (math.nan, math.nan)
        event.register("numba:compile", self)

    def on_start(self, event: Any) -> None:
        if self._depth == 0:
            self._file[1] = time.process_time(), time.monotonic()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        self._depth -= 1
        if self._depth == 0:
            self._file[0] += np.array((time.process_time(), time.monotonic())) - self._file[1]
            self._file[1] = math.nan


def compiled(path: Path, processor_seconds: float) -> Seconds:
    """How long the process that writes ``path`` has compiled; ``processor_seconds``: what it has used in all until now."""
    if not path.exists():
        return Seconds(0.0, 0.0)
    ended, began = np.fromfile(path, dtype=float).reshape(2, 2)
    present = np.array((processor_seconds, time.monotonic())) - began
    processor, wall = ended + np.where(np.isnan(present), 0.0, np.maximum(present, 0.0))
    return Seconds(float(processor), float(wall))
