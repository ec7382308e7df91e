"""Scans as likelihoods: reads and misses of the tags of the map, signal strength and phase."""

import math
from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.measurement import GOING_BACK
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.rfid.settings import RfidSettings, SurveySettings
from factorgraph_loc.sensors.rfid.stream import RfidScan
from factors import se2
from factors.rfid.detection import RfidLikelihood, TagArray, TagReadCounts
from factors.rfid.factor import RfidFactor
from factors.rfid.signals import (
    PhaseLikelihood,
    PhaseModel,
    PhaseReads,
    RssiLikelihood,
    RssiModel,
    RssiReads,
)
from factors.rfid.tag_states import FARTHEST, TagStates, sigma_poses
from factors.se2 import Array, Integers

CONFIRMED = (
    1.0  # s until a read counts as evidence on the state of its tag: a track that it contradicts may be doubted by then
)
CLEAR = math.log(0.99 / 0.01)  # log-odds of a tag that is clearly not as surveyed
WIDENED = 4.0  # factor of the pose's sigmas for evidence on tags, because consecutive scans share the pose error
STANDING = np.zeros(3)  # velocity
PASS_SIGMA = 0.1  # m: accuracy of the pose from one pass of a tag
EXACT = 0.2  # a survey is exact if its sigma is below this share of that


def trust(sigmas: Array) -> float:
    """The exponent of a likelihood of tags whose positions have standard deviations ``sigmas`` (T,) [m].

    The survey error is the same in all reads of a tag, so reads cannot average it out. A pass of a tag determines the pose with
    variance :data:`PASS_SIGMA` squared, and with the sum of both variances if the survey is inexact.
    """
    counted = np.where(sigmas > EXACT * PASS_SIGMA, sigmas, 0.0)
    return float(np.mean(1.0 / (1.0 + (counted / PASS_SIGMA) ** 2))) if len(sigmas) else 1.0


@dataclass(frozen=True, eq=False)
class TagMap:
    """``names``: T EPCs; ``tags``: in the world frame, with the survey transform applied; ``index``: by EPC; ``sigmas`` (T,) [m]:
    standard deviations of their survey along an axis."""

    names: tuple[str, ...]
    tags: TagArray
    index: dict[str, int]
    sigmas: Array


def tag_map(world: World, survey: SurveySettings, names: Collection[str] | None = None) -> TagMap:
    """The tags of a map, or those of them in ``names``."""
    chosen = {name: tag for name, tag in world.tags.items() if names is None or name in names}
    points = np.array([(tag.x, tag.y, tag.z) for tag in chosen.values()]).reshape(-1, 3)
    facing = np.array([np.nan if tag.facing is None else tag.facing for tag in chosen.values()])
    transform = survey.transform()
    points[:, :2] = se2.transform_from(transform, points[:, :2])
    tags = TagArray(points, facing + transform[2])
    sigmas = np.array([math.sqrt(np.trace(tag.spread()) / 2.0) for tag in chosen.values()])
    return TagMap(tuple(chosen), tags, {name: i for i, name in enumerate(chosen)}, sigmas)


MARGIN = 1.0  # m; distance from walls and tags at which the robot may be
MARGIN_OF_TAGS = 3.0  # m; without walls


def extent(world: World, tags: TagArray) -> Array:
    """The area of the robot: lower and upper corner (2, 2) [m], from the walls, or from the tags without walls."""
    ends = np.array(world.walls).reshape(-1, 2)
    margin = MARGIN if len(ends) else MARGIN_OF_TAGS
    points = np.concatenate((ends, tags.points[:, :2])) if len(tags.points) else ends
    if not len(points):
        return np.zeros((2, 2))
    return np.array((points.min(axis=0) - margin, points.max(axis=0) + margin))


def whole_scans(log: Log) -> list[RfidScan]:
    """All RFID scans in order of arrival; empty without a reader."""
    return [m for m in log.measurements(("rfid",)) if isinstance(m, RfidScan)]


@dataclass(frozen=True, eq=False)
class TagEvidence:
    """The evidence of a scan on the states of U ``tags``, see :meth:`~factors.rfid.tag_states.TagStates.expect`; ``is_read`` (U,):
    whether it read them."""

    tags: Integers
    log_likelihoods: Array
    is_read: NDArray[np.bool_]


class KnownTags:
    """Turns scans into read counts of the map's tags. Tags and antennas that map or rig lack are counted as ignored.

    It also tracks the ``states`` of the tags. A read shows that a tag is not dead; other evidence of a scan requires a known
    pose (:meth:`weigh_states`, :meth:`learn`). Tags that are believed dead, weak or moved are listed in the diagnostics.
    """

    def __init__(self, setup: Setup, diagnostics: Diagnostics) -> None:
        settings, self._diagnostics = setup.rig.of(RfidSettings), diagnostics
        self._antennas = {name: i for i, name in enumerate(settings.all_antennas())}
        self._rounds: dict[tuple[str, ...], tuple[list[int], Integers, Integers]] = {}
        self.map: TagMap = tag_map(setup.world, setup.rig.survey)
        model, self.trust = settings.model(), trust(self.map.sigmas)
        self._tempering = model.tempering
        self.likelihood = RfidLikelihood(replace(model, tempering=model.tempering * self.trust), self.map.tags)
        self.states = TagStates(len(self.map.names), settings.dead_tags, settings.weak_tags, settings.moved_tags)
        self._excluded: set[int | None] = set()  # antennas that are dead
        self._waiting: deque[tuple[float, Integers, Array]] = deque()  # evidence of reads since `CONFIRMED` ago

    @property
    def antennas(self) -> Sequence[str]:
        """The names of the rig's antennas."""
        return list(self._antennas)

    def exclude(self, antenna: int) -> str:
        """Ignore the rounds of an antenna, which is dead, until it reads a tag; returns its name."""
        self._excluded.add(antenna)
        self._rounds = {}
        return self.antennas[antenna]

    def temper(self, tempering: float) -> None:
        """Use this exponent of the likelihood where it is less than that of the rig."""
        new = min(self._tempering, tempering) * self.trust
        if new != self.likelihood.model.tempering:
            self.likelihood = self.likelihood.tempered(new)

    def read_counts(self, m: RfidScan, twist: Array = STANDING, *, count: bool = True) -> TagReadCounts | None:
        """Reads and misses of the map's tags by the rig's antennas, relative to the pose at the scan's time, with the robot's
        velocity ``twist`` (3,). Without ``count``, ignored reads are not counted, because the scan will be processed again."""
        diagnostics = self._diagnostics if count else Diagnostics()
        if self._excluded:
            active = {self._antennas.get(m.antennas[i]) for i in set(m.antenna.tolist())}
            if not self._excluded.isdisjoint(active):
                self._excluded, self._rounds = self._excluded - active, {}
        rows, used, rounds = self._listening(m.antennas)
        if -1 in rows:
            lacking = sum(name not in self._antennas for name in m.antennas)
            if lacking:
                diagnostics.ignore("antenna that the rig lacks", lacking)
            if rows.count(-1) > lacking:
                diagnostics.ignore("dead antenna", rows.count(-1) - lacking)
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
        at, places = np.array(reads, dtype=np.int64).reshape(-1, 2).T
        self.states.hear(m.t, np.unique(places))
        self._report_suspects()
        tags = np.unique(np.concatenate((places, self.states.doubtful)))
        hits = np.zeros((len(used), len(tags)), dtype=np.int64)
        np.add.at(hits, (at, np.searchsorted(tags, places)), 1)
        odds = self.states.odds[tags]
        # reads of a tag that has probably moved do not inform an unknown pose
        elsewhere = np.where(hits.any(axis=0) & (odds <= 0.0), -np.inf, 0.0)
        prior = self.states.prior
        twists = np.tile(twist, (len(used), 1))
        return TagReadCounts(np.zeros((len(used), 3)), used, rounds, hits, odds, elsewhere, tags, prior, twists)

    def weigh_states(self, counts: TagReadCounts, pose: Array, covariance: Array, parameters: Array) -> TagEvidence:
        """The evidence of ``counts`` on the states of tags in reach.

        ``pose`` (3,): predicted, with body-frame ``covariance`` (3, 3). ``parameters`` (Q,): of the likelihood, as estimated.
        """
        poses = sigma_poses(pose, np.ascontiguousarray(covariance), WIDENED * math.sqrt(3.0))
        places = self.states.hypotheses, FARTHEST, parameters, self.states.odds
        return TagEvidence(*self.likelihood.displaced(poses, counts, *places))

    def with_states(self, counts: TagReadCounts, evidence: TagEvidence) -> TagReadCounts:
        """The counts with the states of tags that may be dead or moved, given their ``evidence``."""
        elsewhere = self.states.expect(evidence.tags, evidence.log_likelihoods)
        return counts.with_states(evidence.tags, self.states.odds[evidence.tags], elsewhere)

    def without_doubtful(self, reads: TagReadCounts) -> TagReadCounts:
        """The counts with the effect of tags removed that are clearly not as surveyed."""
        clear = self.states.odds[reads.tags] > CLEAR
        if not clear.any():
            return reads
        return replace(
            reads, odds=np.where(clear, -math.log(1e-12), reads.odds), elsewhere=np.where(clear, 0.0, reads.elsewhere)
        )

    def learn(self, t: float, evidence: TagEvidence) -> None:
        """Learn of the tags that were not read at ``t``, and of those that were read :data:`CONFIRMED` ago."""
        is_read, tags, log_likelihoods = evidence.is_read, evidence.tags, evidence.log_likelihoods
        self.states.learn(t, tags[~is_read], log_likelihoods[~is_read])
        self._waiting.append((t, tags[is_read], log_likelihoods[is_read]))
        while self._waiting[0][0] < t - CONFIRMED:
            self.states.learn(*self._waiting.popleft())
        self._report_suspects()

    def forget(self, since: float) -> None:
        """Take back what was learnt since ``since``."""
        self.states.forget(since)
        self._waiting = deque(row for row in self._waiting if row[0] < since)
        self._report_suspects()

    def silent(self) -> None:
        """Take back what was learnt since the last read, because the reader or all tags have failed."""
        self.forget(math.nextafter(self.states.last_read, math.inf))

    def _report_suspects(self) -> None:
        for state, tags in self.states.suspects.items():
            names = map(self.map.names.__getitem__, tags)
            self._diagnostics.doubted[f"{state}_tags"] = dict(zip(names, tags.values(), strict=True))

    def _listening(self, names: tuple[str, ...]) -> tuple[list[int], Integers, Integers]:
        """The active antennas: row of each, -1 if the rig lacks it; antenna index and number of rounds of each row. Cached, because
        consecutive scans have the same antennas."""
        if names not in self._rounds:
            antennas = [self._antennas.get(name, -1) for name in names]
            antennas = [-1 if antenna in self._excluded else antenna for antenna in antennas]
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


M = TypeVar("M", RssiModel, PhaseModel)
Row = tuple[float, int, int, float, float]  # time of the read, antenna, tag, phase, frequency


class TagSignals:
    """Turns scans into strength observations and windows of phases, if these sensors are used.

    Windows of the rig's ``window`` seconds end at least ``step`` seconds apart.
    """

    def __init__(self, setup: Setup, tags: KnownTags) -> None:
        settings, self._tags = setup.rig.of(RfidSettings), tags
        self.strength: RssiLikelihood | None = None
        self.phase: PhaseLikelihood | None = None
        self._rows: deque[tuple[float, Row]] = deque()  # with the scan's time
        self._ended: deque[float] = deque()
        self._window = self._step = 0.0
        self._newest = -np.inf
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
        complete = (antennas >= 0) & (tags >= 0) & np.isfinite(m.phase) & np.isfinite(m.frequency)
        for i in np.flatnonzero(complete).tolist():
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
