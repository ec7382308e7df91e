"""Scans of RFID tags that wait on the newest keyframe of a graph until the next one comes."""

from collections.abc import Callable
from dataclasses import replace

from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.sensors.rfid.known_tags import KnownTags
from factorgraph_loc.sensors.rfid.measurement import RfidScan
from factorgraph_loc.sensors.rfid.monitor import Silence
from factorgraph_loc.sensors.rfid.signals import TagSignals
from factors.rfid import update as rfid_update
from factors.rfid.detection import Looks, together
from factors.rfid.factor import RfidFactor
from factors.rfid.update import TagUpdate
from factors.se2 import Array


class WaitingScans:
    """Turns scans into factors on a pose and updates the pose by each, as a filter would, until they are gathered into a few."""

    def __init__(self, setup: Setup, diagnostics: Diagnostics) -> None:
        self.tags = KnownTags(setup, diagnostics)
        self._diagnostics = diagnostics
        self._signals = TagSignals(setup, self.tags)
        self._silence = Silence()
        self._waiting: list[RfidFactor] = []

    @property
    def silent(self) -> bool:
        """Whether no tag is read where some should be."""
        return self._silence.lasts

    def factors(self, m: RfidScan, looks: Looks) -> list[RfidFactor]:
        """What a scan tells of a pose, of which ``looks`` are the reads and misses: these, then the strengths."""
        assert self.tags.likelihood is not None
        factors = [RfidFactor(self.tags.likelihood, looks)]
        strengths = self._signals.strengths(m)
        if strengths is not None and self._signals.strength is not None:
            factors.append(RfidFactor(self._signals.strength, strengths.moved(looks.offsets[0])))
        return factors

    def late_factors(self, m: RfidScan, looks: Looks, pose: Array, covariance: Array) -> list[RfidFactor]:
        """The :meth:`factors` of a late scan, which do not wait; its innovation is that of a pose (3,) with body-frame covariance
        (3, 3)."""
        detection, *strengths = self.factors(m, looks)
        update = rfid_update.updated([detection], pose, covariance, iterations=1)
        self._diagnostics.innovation("rfid", m.t, update.nis, update.dof)
        return [detection, *strengths]

    def update(self, m: RfidScan, looks: Looks, pose: Array, covariance: Array) -> TagUpdate | None:
        """What the :meth:`factors` of a scan make of a pose (3,) with body-frame covariance (3, 3); they wait from now on. None in
        a silence, which is no evidence.

        What is told of the innovation, and the evidence, are those of what was read and not read: other places are judged by that
        alone, in a :class:`~factorgraph_loc.fusion.search.Seeker`.
        """
        detection, *strengths = factors = self.factors(m, looks)
        update = rfid_update.updated([detection], pose, covariance)
        self._diagnostics.innovation("rfid", m.t, update.nis, update.dof)
        lasted = self._silence.lasts
        if self._silence.add(int(looks.hits.sum()), update.evidence):
            self._diagnostics.reject(Silence.REJECTED, len(m.antennas))
            if not lasted:
                self._diagnostics.events.append((m.t, Silence.EVENT))
                self.tags.silent()
            return None
        self._waiting += factors
        if strengths:
            placed = rfid_update.updated(strengths, update.pose, update.covariance)
            update = replace(update, pose=placed.pose, covariance=placed.covariance)
        return update

    def update_by_phases(
        self, m: RfidScan, places: Callable[[Array], Array], pose: Array, covariance: Array
    ) -> TagUpdate | None:
        """Keep the phases of a scan. If a window of them ends with it, what that makes of the pose, from which ``places`` tells at
        times (R,) where the robot was, (R, 3); the window waits from now on."""
        if not self._signals.keep(m):
            return None
        window = self._signals.phases(places(self._signals.times()), pose)
        if window is None:
            return None
        self._waiting.append(window)
        return rfid_update.updated([window], pose, covariance)

    def gather(self) -> list[RfidFactor]:
        """What waits, which waits no longer."""
        factors, self._waiting = self.waiting(), []
        return factors

    def waiting(self) -> list[RfidFactor]:
        """What waits: all reads and misses as one factor."""
        looks = [factor.seen for factor in self._waiting if isinstance(factor.seen, Looks)]
        factors = [factor for factor in self._waiting if not isinstance(factor.seen, Looks)]
        if looks and self.tags.likelihood is not None:
            factors.append(RfidFactor(self.tags.likelihood, together(looks)))
        return factors

    def clear(self) -> None:
        """The track begins anew: nothing waits, and no phase is kept."""
        self._waiting = []
        self._signals.clear()
