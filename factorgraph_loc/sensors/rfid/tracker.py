"""Scans of RFID tags as a particle filter takes them in.

While the place is known a scan weighs the particles by what was read and not read, and by the strength of the reads; a window of
phases weighs them once more, each second (:class:`~factorgraph_loc.sensors.rfid.signals.TagSignals`). A silence of the reader
is no evidence (:class:`~factorgraph_loc.sensors.rfid.monitor.Silence`). Where scans alone tell the place, they find it
(:class:`~factorgraph_loc.fusion.scan_finder.ScanFinder`) at an unknown start, and once a track is doubted. Only what was read
and not read is weighed there: the phase has many optima, and between places it tells nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from factorgraph_loc.fusion.cloud import Cloud
from factorgraph_loc.fusion.known_position import KnownPosition
from factorgraph_loc.fusion.scan_finder import ScanFinder
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.sensors.odometry.motion import Motion
from factorgraph_loc.sensors.rfid import known_tags as tags
from factorgraph_loc.sensors.rfid.measurement import RfidScan
from factorgraph_loc.sensors.rfid.monitor import ScanMonitor, Silence
from factorgraph_loc.sensors.rfid.signals import TagSignals
from factorgraph_loc.sensors.rfid.tag_map import extent
from factors import se2
from factors.motion import ChainState
from factors.rfid import update as rfid_update
from factors.rfid.phase import PhaseLikelihood, PhaseReads
from factors.se2 import Array

KEPT = 90.0  # s of odometry, for a search among the last scans

# from times (R,) to where the robot was then, (R, 3), in the frame of its pose
Places = Callable[[Array], Array]
# weighs the particles by a log-likelihood (N,) of a cloud, and returns the log of its mean
Weigh = Callable[[Callable[[Cloud], Array]], float]


class ScanTracker:
    """What scans make of a cloud; see the module. ``finds``: they alone tell the place."""

    def __init__(self, setup: Setup, motion: Motion, diagnostics: Diagnostics, *, finds: bool) -> None:
        self._motion, self._diagnostics, self._rng = motion, diagnostics, setup.rng
        self._tags = tags.KnownTags(setup, diagnostics)
        self._signals = TagSignals(setup, self._tags)
        self._monitor = ScanMonitor()
        self._silence = Silence()
        self._heard = -np.inf
        self._finder: ScanFinder | None = None
        if finds and self._tags.likelihood is not None:
            motion.keep(KEPT)
            self._finder = ScanFinder(
                self._tags.likelihood, motion, extent(setup.world, self._tags.map.tags), setup.rng
            )

    @property
    def finds(self) -> bool:
        """Whether scans alone tell the place."""
        return self._finder is not None

    @property
    def doubts(self) -> bool:
        """Whether the track or the reader is under suspicion."""
        return self._monitor.suspicious_since is not None or self._silence.lasts

    @property
    def silent(self) -> bool:
        """Whether no tag is read where some should be."""
        return self._silence.lasts

    def seek_from(self, start: KnownPosition | None) -> None:
        """Seek the heading of a start whose position is known; None: that is over."""
        if self._finder is not None and start is not None:
            self._finder.begin(start)

    def seek(self, m: RfidScan, odometry: ChainState) -> bool:
        """Take a scan while the place is not known; False where it tells nothing."""
        looks = self._tags.looks(m)
        return self._finder is not None and looks is not None and self._finder.add(odometry, looks)

    def sought(self, count: int) -> tuple[Array, bool]:
        """Poses (N, 3) drawn from what was found so far, and whether it is one place."""
        assert self._finder is not None
        return self._finder.sample(self._rng, count), self._finder.best is not None

    def start(self, *, found: bool) -> None:
        """A track begins: where scans ``found`` it, or where it was said to."""
        self._monitor.clear()
        if self._finder is not None and found:
            self._finder.start()
        elif self._finder is not None:
            self._finder.rest()

    def track(self, m: RfidScan, odometry: ChainState, cloud: Cloud, weigh: Weigh) -> bool:
        """Take a scan while the place is known; False if it tells nothing of it."""
        looks, likelihood = self._tags.looks(m), self._tags.likelihood
        if looks is None or likelihood is None:
            return False
        mean, covariance = cloud.moments[0], se2.world_to_body(*cloud.moments)
        update = rfid_update.update(likelihood, looks, mean, covariance, iterations=1)
        self._diagnostics.innovation("rfid", m.t, update.nis, update.dof)
        reads = int(looks.hits.sum())
        # a scan without reads that comes again, as the filter went back, counts once
        if reads or m.t > self._heard:
            lasted = self._silence.lasts
            if self._silence.add(reads, update.evidence) and not lasted:
                self._tags.silent()
            self._heard = max(self._heard, m.t)
        if self._silence.lasts:
            self._diagnostics.reject(Silence.REJECTED, len(m.antennas))
            return False
        # the finder's evidence is of what was read and not read, and so is the track's
        evidence = weigh(lambda cloud: likelihood.log_likelihood(cloud.poses, looks))
        if self._finder is not None:
            self._finder.add(odometry, looks, evidence)
            self._monitor.add(m.t, update.surprise, update.variance)
        if cloud.localized and not self.doubts:
            self._tags.miss(m.t, looks, mean, covariance)
        strength, strengths = self._signals.strength, self._signals.strengths(m)
        if strength is not None and strengths is not None:
            weigh(lambda cloud: strength.log_likelihood(cloud.poses, strengths))
        return True

    def go_back(self, t: float) -> None:
        """The filter goes back to ``t``: later scans come again."""
        self._tags.forget(math.nextafter(t, math.inf))

    def take_phases(self, m: RfidScan, cloud: Cloud, places: Places, weigh: Weigh) -> None:
        """Keep the phases of a scan, and take the window of them that ends with it, if one does.

        Scans from its time on that were taken before, as the filter went back, are forgotten.
        """
        self._signals.forget(m.t)
        if not self._signals.keep(m):
            return
        window = self._signals.phases(places(self._signals.times()), cloud.moments[0])
        if window is None:
            return
        likelihood, reads = window.likelihood, window.seen
        assert isinstance(likelihood, PhaseLikelihood)
        assert isinstance(reads, PhaseReads)
        weigh(lambda cloud: likelihood.log_likelihood(cloud.poses, reads))

    def refuted_since(self, cloud: Cloud, places: Places) -> float | None:
        """Since when the robot must have been elsewhere, as another place explains the scans; None where none does. ``places`` as
        for phases. A suspicion that the scans deny, as they alone lead to where the cloud is, is dropped."""
        since = self._monitor.suspicious_since
        if self._finder is None:
            return None
        if since is None:
            self._finder.rest()
            return None
        self._finder.seek(since)
        mean, covariance = cloud.moments
        track = mean, se2.world_to_body(mean, covariance)
        if self._finder.confirms(*track):
            self._monitor.accept()
            self._finder.rest()
        if not self._finder.refutes(*track):
            return None
        found = self._finder.best
        assert found is not None
        here = found.pose
        change = self._finder.change(lambda t: np.asarray(se2.compose(here, places(np.array([t]))[0])))
        self._tags.forget(change)
        return change
