"""Options of this benchmark."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from benchmarking.report import Options


@dataclass(frozen=True)
class CameraOptions(Options):
    """``duration`` [s] of simulated drives, None for each section's default; ``cache``: folder of rendered drives, None for one
    below ``out``."""

    duration: float | None = None
    cache: Path | None = None

    def seconds(self, usual: float) -> float:
        return usual if self.duration is None else self.duration

    @property
    def drives(self) -> Path:
        return self.out / "drives" if self.cache is None else self.cache
