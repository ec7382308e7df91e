"""Inventory rounds of RFID antennas, as all estimators take them in."""

import math
from dataclasses import replace

import numpy as np

from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.sensors.rfid.measurement import RfidScan
from factorgraph_loc.sensors.rfid.tag_map import TagMap, tag_map
from factors.rfid.detection import RfidLikelihood, TagReadCounts
from factors.rfid.tag_states import TagStates
from factors.se2 import Array, Integers

EXACT = 0.2  # a survey that is so much better than what a pass tells (as a share of that) is taken as exact


def trust(sigmas: Array, pass_sigma: float) -> float:
    """The exponent that a likelihood of tags is due whose places have errors of these ``sigmas`` (T,) [m].

    Such an error is the same each time that a tag is passed, so that no number of reads tells the pose better. A pass by itself
    tells it with a variance of ``pass_sigma`` squared, and with the sum of both where the tag's place is not exact.
    """
    counted = np.where(sigmas > EXACT * pass_sigma, sigmas, 0.0)
    return float(np.mean(1.0 / (1.0 + (counted / pass_sigma) ** 2))) if len(sigmas) else 1.0


class KnownTags:
    """Turns scans into looks at the tags of the map; what the map or the rig lacks is counted as ignored.

    It also keeps what the scans told of the ``states`` of the tags: that one was read shows when it is looked at, that one was not
    only from where the robot was, if that is known (:meth:`miss`). Tags that are believed dead stand in the diagnostics.
    """

    def __init__(self, setup: Setup, diagnostics: Diagnostics) -> None:
        settings = setup.rig.rfid if "rfid" in setup.sensors else None
        self._diagnostics = diagnostics
        self._antennas = {} if settings is None else {name: i for i, name in enumerate(settings.all_antennas())}
        self._rounds: dict[tuple[str, ...], tuple[list[int], Integers, Integers]] = {}
        self.map: TagMap = tag_map(setup.world, setup.rig.survey)
        self.likelihood, self.trust = None, 1.0
        if settings is not None:
            model, self.trust = settings.model(), trust(self.map.sigmas, settings.pass_sigma)
            self.likelihood = RfidLikelihood(replace(model, tempering=model.tempering * self.trust), self.map.tags)
        self.states = TagStates(len(self.map.names), 0.0 if settings is None else settings.dead_tags)

    def looks(self, m: RfidScan, *, count: bool = True) -> TagReadCounts | None:
        """What the antennas of the rig read, and did not read, of the tags of the map, all from the pose at the scan's time.

        ``count`` off: what is ignored is not counted, as the scan will be looked at once more.
        """
        diagnostics = self._diagnostics if count else Diagnostics()
        if self.likelihood is None:
            diagnostics.ignore("rfid", len(m.antennas))
            return None
        rows, used, rounds = self._listening(m.antennas)
        if -1 in rows:
            diagnostics.ignore("antenna that the rig lacks", rows.count(-1))
        if not len(used) or not self.map.names:
            return None
        hits, odds = np.zeros((len(used), len(self.map.names)), dtype=np.int64), self.states.odds
        unknown = 0
        # a tag counts once a round, as often as it may answer in it
        for number, name in dict.fromkeys(zip(m.antenna.tolist(), m.tags, strict=True)):
            place = self.map.index.get(name)
            if place is None:
                unknown += 1
            elif rows[number] >= 0:
                hits[rows[number], place] += 1
        if unknown:
            diagnostics.ignore("tag not in the map", unknown)
        self.states.hear(m.t, np.flatnonzero(hits.any(axis=0)))
        self._tell()
        return TagReadCounts(np.zeros((len(used), 3)), used, rounds, hits, odds)

    def miss(self, t: float, looks: TagReadCounts, pose: Array, covariance: Array) -> None:
        """Learn of the tags that were not read at ``t``. ``pose`` (3,) with body-frame ``covariance`` (3, 3): that of the looks, as
        it was predicted before them."""
        if self.likelihood is not None:
            self.states.miss(t, self.likelihood.silence(pose, covariance, looks))
            self._tell()

    def forget(self, since: float) -> None:
        """Take back what scans from then on told of tags that were not read."""
        self.states.forget(since)
        self._tell()

    def silent(self) -> None:
        """The reader or all tags have failed since a tag was last read: that tells nothing of each of them."""
        self.forget(math.nextafter(self.states.heard, math.inf))

    def _tell(self) -> None:
        believed, told = self.states.believed_dead, self._diagnostics.dead_tags
        told.clear()
        if len(believed):
            told.update(zip((self.map.names[i] for i in believed), self.states.dead[believed].tolist(), strict=True))

    def _listening(self, names: tuple[str, ...]) -> tuple[list[int], Integers, Integers]:
        """Of antennas that listened: the rows of their looks, -1 of those that the rig lacks; of each row its antenna's place in
        the rig, and how many rounds there were. It is kept, as scan after scan is of the same antennas."""
        if names not in self._rounds:
            antennas = [self._antennas.get(name, -1) for name in names]
            used = sorted(set(antennas) - {-1})
            rows = [used.index(antenna) if antenna >= 0 else -1 for antenna in antennas]
            counts = [antennas.count(antenna) for antenna in used]
            self._rounds = {names: (rows, np.array(used, dtype=np.int64), np.array(counts, dtype=np.int64))}
        return self._rounds[names]

    def places(self, m: RfidScan) -> tuple[Integers, Integers]:
        """Of each read of a scan the places of its antenna in the rig and of its tag in the map, -1 where these lack it."""
        antennas = np.array([self._antennas.get(name, -1) for name in m.antennas], dtype=np.int64)
        tags = np.array([self.map.index.get(name, -1) for name in m.tags], dtype=np.int64)
        return antennas[m.antenna], tags


# The parts of an update that are linear algebra of three rows: compiled, as NumPy takes ten times as long for so few. So is the
# whole update by what was read and not read, which comes often.
