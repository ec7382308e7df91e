"""Observations of signal strength and phase of RFID reads."""

from collections import deque
from dataclasses import replace
from typing import TypeVar

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.measurement import GOING_BACK
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.sensors.rfid.known_tags import KnownTags
from factorgraph_loc.sensors.rfid.measurement import RfidScan
from factors.rfid.factor import RfidFactor
from factors.rfid.phase import PhaseLikelihood, PhaseModel, PhaseReads
from factors.rfid.strength import RssiLikelihood, RssiModel, RssiReads
from factors.se2 import Array

M = TypeVar("M", RssiModel, PhaseModel)
Row = tuple[float, int, int, float, float]  # time of the read, antenna, tag, phase, frequency


class TagSignals:
    """Turns scans into strength observations and windows of phases, if these sensors are used. InputError if the rig lacks a model.

    Windows of the rig's ``window`` seconds end at least ``step`` seconds apart.
    """

    def __init__(self, setup: Setup, tags: KnownTags) -> None:
        settings, self._tags = setup.rig.rfid, tags
        for sensor in ("rssi", "phase"):
            if sensor in setup.sensors and getattr(settings, sensor, None) is None:
                raise InputError(f"the rig has no [rfid.{sensor}], which the sensor {sensor} needs")
        self.strength: RssiLikelihood | None = None
        self.phase: PhaseLikelihood | None = None
        self._rows: deque[tuple[float, Row]] = deque()  # with the scan's time
        self._ended: deque[float] = deque()
        self._window = self._step = 0.0
        self._newest = -np.inf
        if settings is None or tags.likelihood is None:
            return
        antennas = tags.likelihood.model.antennas
        if settings.rssi is not None and "rssi" in setup.sensors:
            self.strength = RssiLikelihood(_tempered(settings.rssi.model(antennas), tags.trust), tags.map.tags)
        if settings.phase is not None and "phase" in setup.sensors:
            self.phase = PhaseLikelihood(_tempered(settings.phase.model(antennas), tags.trust), tags.map.tags)
            self._window, self._step = settings.phase.window, settings.phase.step

    def strengths(self, m: RfidScan) -> RssiReads | None:
        """The reads with a strength, relative to the pose at the scan's time."""
        if self.strength is None:
            return None
        antennas, tags = self._tags.places(m)
        rows = np.flatnonzero((antennas >= 0) & (tags >= 0) & np.isfinite(m.rssi))
        if not len(rows):
            return None
        return RssiReads(np.zeros((len(rows), 3)), antennas[rows], tags[rows], m.rssi[rows])

    def keep(self, m: RfidScan) -> bool:
        """Add the phases of a scan; True if a window ends with it."""
        if self.phase is None:
            return False
        antennas, tags = self._tags.places(m)
        told = (antennas >= 0) & (tags >= 0) & np.isfinite(m.phase) & np.isfinite(m.frequency)
        for i in np.flatnonzero(told).tolist():
            t = m.t - float(m.age[i])
            self._rows.append((m.t, (t, int(antennas[i]), int(tags[i]), float(m.phase[i]), float(m.frequency[i]))))
        while self._rows and self._rows[0][0] < m.t - self._window - GOING_BACK:
            self._rows.popleft()
        self._newest = m.t
        if not self._of_window() or (self._ended and m.t < self._ended[-1] + self._step):
            return False
        self._ended.append(m.t)
        return True

    def times(self) -> Array:
        """Times (R,) [s] of the reads of the window."""
        return np.array([row[0] for row in self._of_window()])

    def phases(self, offsets: Array, pose: Array) -> RfidFactor | None:
        """The window as a factor on a pose predicted as ``pose`` (3,); ``offsets`` (R, 3): robot poses at the reads relative to it.
        None if too few reads are near their tags."""
        if self.phase is None:
            return None
        _, antennas, tags, phase, frequency = (np.array(column) for column in zip(*self._of_window(), strict=True))
        windows = np.zeros(len(phase), dtype=np.int64)
        reads = self.phase.near(pose, PhaseReads(offsets, antennas, tags, phase, frequency, windows))
        return RfidFactor(self.phase, reads) if len(reads.phase) else None

    def forget(self, since: float) -> None:
        """Forget scans since ``since``, at most :data:`GOING_BACK` ago; they will be processed again."""
        while self._rows and self._rows[-1][0] >= since:
            self._rows.pop()
        while self._ended and self._ended[-1] >= since:
            self._ended.pop()

    def clear(self) -> None:
        """Forget all reads."""
        self._rows.clear()
        self._ended.clear()

    def _of_window(self) -> list[Row]:
        return [row for _, row in self._rows if row[0] >= self._newest - self._window]


def _tempered(model: M, trust: float) -> M:
    return replace(model, tempering=model.tempering * trust)
