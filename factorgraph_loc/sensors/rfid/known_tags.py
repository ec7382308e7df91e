"""Reads and misses of the tags of the map."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.sensors.rfid.measurement import RfidScan
from factorgraph_loc.sensors.rfid.tag_map import TagMap, tag_map
from factors import positive
from factors.rfid.counts import TagReadCounts, union
from factors.rfid.detection import RfidLikelihood
from factors.rfid.tag_states import FARTHEST, TagStates, sigma_poses
from factors.se2 import Array, Integers

CONFIRMED = (
    1.0  # s until a read counts as evidence on the state of its tag: a track that it contradicts may be doubted by then
)
WIDENED = 4.0  # times the standard deviations of the pose for what scans tell of tags: scans in a row have its error in common
EXACT = 0.2  # a survey is exact if its sigma is below this share of `pass_sigma`


def trust(sigmas: Array, pass_sigma: float) -> float:
    """The exponent of a likelihood of tags whose positions have standard deviations ``sigmas`` (T,) [m].

    The survey error is the same in all reads of a tag, so reads cannot average it out. A pass of a tag determines the pose with
    variance ``pass_sigma`` squared, and with the sum of both variances if the survey is inexact.
    """
    counted = np.where(sigmas > EXACT * pass_sigma, sigmas, 0.0)
    return float(np.mean(1.0 / (1.0 + (counted / pass_sigma) ** 2))) if len(sigmas) else 1.0


@dataclass(frozen=True, eq=False)
class TagEvidence:
    """What a scan tells of the states of U ``tags`` (U,), see :meth:`~factors.rfid.tag_states.TagStates.expect`; ``heard`` (U,):
    whether it read them."""

    tags: Integers
    told: Array
    heard: NDArray[np.bool_]


class KnownTags:
    """Turns scans into read counts of the map's tags. Tags and antennas that map or rig lack are counted as ignored.

    It also tracks the ``states`` of the tags: reads show at once that a tag is not dead; else a scan tells of them only with a
    known pose (:meth:`told`, :meth:`learn`). Tags that are believed dead or moved are listed in the diagnostics.
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
            self._tempering = model.tempering
            self.likelihood = RfidLikelihood(replace(model, tempering=model.tempering * self.trust), self.map.tags)
        dead, moved = (0.0, 0.0) if settings is None else (settings.dead_tags, settings.moved_tags)
        self.states = TagStates(len(self.map.names), dead, moved)
        self._waiting: deque[tuple[float, Integers, Array]] = deque()  # what reads told since `CONFIRMED` ago

    @property
    def antennas(self) -> Sequence[str]:
        """The names of the rig's antennas."""
        return list(self._antennas)

    def temper(self, tempering: float) -> bool:
        """Use this exponent of the likelihood where it is less than that of the rig; whether it is another one."""
        assert self.likelihood is not None
        new = min(self._tempering, tempering) * self.trust
        if new == self.likelihood.model.tempering:
            return False
        self.likelihood = self.likelihood.tempered(new)
        return True

    def looks(self, m: RfidScan, *, count: bool = True) -> TagReadCounts | None:
        """Reads and misses of the map's tags by the rig's antennas, relative to the pose at the scan's time. Without ``count``,
        ignored reads are not counted, because the scan will be processed again."""
        diagnostics = self._diagnostics if count else Diagnostics()
        if self.likelihood is None:
            diagnostics.ignore("rfid", len(m.antennas))
            return None
        rows, used, rounds = self._listening(m.antennas)
        if -1 in rows:
            diagnostics.ignore("antenna that the rig lacks", rows.count(-1))
        if not len(used) or not self.map.names:
            return None
        reads: list[tuple[int, int]] = []
        unknown = 0
        # count a tag once per round
        for number, name in dict.fromkeys(zip(m.antenna.tolist(), m.tags, strict=True)):
            place = self.map.index.get(name)
            if place is None:
                unknown += 1
            elif rows[number] >= 0:
                reads.append((rows[number], place))
        if unknown:
            diagnostics.ignore("tag not in the map", unknown)
        self.states.hear(m.t, np.array(sorted({place for _, place in reads}), dtype=np.int64))
        self._tell()
        tags = np.array(sorted({*(place for _, place in reads), *self.states.doubtful.tolist()}), dtype=np.int64)
        number = {place: i for i, place in enumerate(tags.tolist())}
        hits = np.zeros((len(used), len(tags)), dtype=np.int64)
        for row, place in reads:
            hits[row, number[place]] += 1
        odds = self.states.odds[tags]
        # what is read of a tag that is believed to have moved tells nothing of an unknown pose
        elsewhere = np.where(hits.any(axis=0) & (odds <= 0.0), -np.inf, 0.0)
        prior = self.states.prior
        return TagReadCounts(np.zeros((len(used), 3)), used, rounds, hits, odds, elsewhere, tags, prior)

    def told(self, looks: TagReadCounts, pose: Array, covariance: Array, parameters: Array) -> TagEvidence:
        """What looks tell of the tags in reach at a predicted ``pose`` (3,) with body-frame ``covariance`` (3, 3); ``parameters``
        (2 M,): the detection models as they are estimated to be."""
        assert self.likelihood is not None
        poses = sigma_poses(pose, WIDENED * math.sqrt(3.0) * positive.root(covariance))
        places = self.states.places, FARTHEST, parameters, self.states.odds
        return TagEvidence(*self.likelihood.displaced(poses, looks, *places))

    def with_states(self, looks: TagReadCounts, evidence: TagEvidence) -> TagReadCounts:
        """The looks at tags that may be dead or moved, of which they tell ``evidence``."""
        looks = looks.listing(union(looks.listed, evidence.tags))
        at = np.searchsorted(looks.listed, evidence.tags)
        odds, elsewhere = looks.odds.copy(), looks.elsewhere.copy()
        odds[at] = self.states.odds[evidence.tags]
        elsewhere[at] = self.states.expect(evidence.tags, evidence.told)
        return replace(looks, odds=odds, elsewhere=elsewhere)

    def learn(self, t: float, evidence: TagEvidence) -> None:
        """Learn of the tags that were not read at ``t``, and of those that were read :data:`CONFIRMED` ago."""
        heard, tags, told = evidence.heard, evidence.tags, evidence.told
        self.states.learn(t, tags[~heard], told[~heard])
        self._waiting.append((t, tags[heard], told[heard]))
        while self._waiting[0][0] < t - CONFIRMED:
            self.states.learn(*self._waiting.popleft())
        self._tell()

    def forget(self, since: float) -> None:
        """Take back what was learnt since ``since``."""
        self.states.forget(since)
        self._waiting = deque(row for row in self._waiting if row[0] < since)
        self._tell()

    def silent(self) -> None:
        """Take back what was learnt since the last read, because the reader or all tags have failed."""
        self.forget(math.nextafter(self.states.heard, math.inf))

    def _tell(self) -> None:
        dead, moved = self._diagnostics.dead_tags, self._diagnostics.moved_tags
        dead.clear()
        moved.clear()
        for i, p in self.states.suspects.items():
            (moved if self.states.was_read(i) else dead)[self.map.names[i]] = p

    def _listening(self, names: tuple[str, ...]) -> tuple[list[int], Integers, Integers]:
        """The active antennas: row of each, -1 if the rig lacks it; antenna index and number of rounds of each row. Cached, because
        consecutive scans have the same antennas."""
        if names not in self._rounds:
            antennas = [self._antennas.get(name, -1) for name in names]
            used = sorted(set(antennas) - {-1})
            rows = [used.index(antenna) if antenna >= 0 else -1 for antenna in antennas]
            counts = [antennas.count(antenna) for antenna in used]
            self._rounds = {names: (rows, np.array(used, dtype=np.int64), np.array(counts, dtype=np.int64))}
        return self._rounds[names]

    def places(self, m: RfidScan) -> tuple[Integers, Integers]:
        """Antenna and tag indices of each read of a scan, -1 if the rig or the map lacks them, or if the tag is believed not to be
        where the map has it."""
        antennas = np.array([self._antennas.get(name, -1) for name in m.antennas], dtype=np.int64)
        tags = np.array([self.map.index.get(name, -1) for name in m.tags], dtype=np.int64)
        tags[(tags >= 0) & (self.states.odds[tags] > 0.0)] = -1
        return antennas[m.antenna], tags


# The linear algebra of an update has three rows only, for which NumPy is ten times slower than compiled code. The update by
# reads and misses, which is frequent, is compiled as a whole.
