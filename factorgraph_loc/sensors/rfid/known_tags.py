"""Converts RFID scans to likelihoods: reads and misses of the map's tags, signal strengths, and phases."""

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

CONFIRMED = 1.0  # s; a read updates the state of a tag only after this time; a wrong pose is detected earlier
CLEAR = math.log(0.99 / 0.01)  # minimum log-odds of a tag that is clearly dead, weak or moved
WIDENED = 4.0  # multiplies the standard deviations of the pose, because successive scans share its error
STANDING = np.zeros(3)  # velocity of a robot at rest
PASS_SIGMA = 0.1  # m; standard deviation of the position estimated by driving past one tag
EXACT = 0.2  # a survey is treated as exact if its standard deviation is below this fraction of PASS_SIGMA


def trust(sigmas: Array) -> float:
    """Return an exponent for the likelihood of reads, at most 1, that accounts for survey errors of the tags.

    ``sigmas`` (T,): standard deviations [m] of the surveyed positions. All reads of a tag share its survey error. The
    variance of the pose after driving past a tag is therefore its survey variance plus the square of
    :data:`PASS_SIGMA`.
    """
    counted = np.where(sigmas > EXACT * PASS_SIGMA, sigmas, 0.0)
    return float(np.mean(1.0 / (1.0 + (counted / PASS_SIGMA) ** 2))) if len(sigmas) else 1.0


@dataclass(frozen=True, eq=False)
class TagMap:
    """The T tags of a map. ``names``: the EPCs. ``tags``: positions and facings in the world frame. ``index``: the
    index of each tag by its EPC. ``sigmas`` (T,): standard deviations [m] of the surveyed positions, per coordinate."""

    names: tuple[str, ...]
    tags: TagArray
    index: dict[str, int]
    sigmas: Array


def tag_map(world: World, survey: SurveySettings, names: Collection[str] | None = None) -> TagMap:
    """Return the tags of the map ``world``, or only the tags with the EPCs ``names``. ``survey``: the transform from
    the frame of the survey to the world frame."""
    chosen = {name: tag for name, tag in world.tags.items() if names is None or name in names}
    points = np.array([(tag.x, tag.y, tag.z) for tag in chosen.values()]).reshape(-1, 3)
    facing = np.array([np.nan if tag.facing is None else tag.facing for tag in chosen.values()])
    transform = survey.transform()
    points[:, :2] = se2.transform_from(transform, points[:, :2])
    tags = TagArray(points, facing + transform[2])
    sigmas = np.array([math.sqrt(np.trace(tag.spread()) / 2.0) for tag in chosen.values()])
    return TagMap(tuple(chosen), tags, {name: i for i, name in enumerate(chosen)}, sigmas)


MARGIN = 1.0  # m; maximum distance of the robot from the bounding box of walls and tags
MARGIN_OF_TAGS = 3.0  # m; maximum distance of the robot from the bounding box of the tags if there are no walls


def extent(world: World, places: Array) -> Array:
    """Return the lower and the upper corner (2, 2) [m] of the area where the robot may be. This is the bounding box of
    walls and ``places`` (N, 2) with a margin, or zeros without walls and places."""
    ends = np.array(world.walls).reshape(-1, 2)
    margin = MARGIN if len(ends) else MARGIN_OF_TAGS
    points = np.concatenate((ends, places))
    if not len(points):
        return np.zeros((2, 2))
    return np.array((points.min(axis=0) - margin, points.max(axis=0) + margin))


def whole_scans(log: Log) -> list[RfidScan]:
    """Return all RFID scans of a log, or [] if it has none."""
    return [m for m in log.measurements(("rfid",)) if isinstance(m, RfidScan)]


@dataclass(frozen=True, eq=False)
class TagEvidence:
    """The likelihood of a scan for the state of each of U tags, which may be as surveyed, weak or moved.

    ``tags`` (U,): indices of the tags in the map. ``log_likelihoods`` (U, S): the log-likelihood of the reads and
    misses of each tag in each of S states, the rows of :attr:`.TagStates.hypotheses`. It is relative to that of a tag
    out of range that is never read. ``is_read`` (U,): True for tags that were read.
    """

    tags: Integers
    log_likelihoods: Array
    is_read: NDArray[np.bool_]


class KnownTags:
    """Converts scans to counts of reads of the tags in the map, and estimates which tags are dead, weak or moved.

    ``setup``: the result of :func:`~factorgraph_loc.sensors.rfid.installation.installed`. ``diagnostics``: counts reads
    that are ignored because the tag or antenna is unknown, and lists tags that are probably dead, weak or moved.
    ``states``: the estimated states of the tags. They are updated by :meth:`learn`, which requires a known pose.
    """

    def __init__(self, setup: Setup, diagnostics: Diagnostics) -> None:
        settings, self._diagnostics = setup.rig.of(RfidSettings), diagnostics
        self._antennas = {name: i for i, name in enumerate(settings.all_antennas())}
        self._rounds: dict[tuple[str, ...], tuple[list[int], Integers, Integers]] = {}
        self.map: TagMap = tag_map(setup.world, setup.rig.survey)
        model, self.trust = settings.model(), trust(self.map.sigmas)
        self._tempering = model.tempering
        self.likelihood = RfidLikelihood(replace(model, tempering=model.tempering * self.trust), self.map.tags)
        moved = 0.0 if model.fixed else settings.moved_tags  # tags on the robot do not move
        self.states = TagStates(len(self.map.names), settings.dead_tags, settings.weak_tags, moved)
        # for messages: where the antennas are listed, and where the tags are
        self._sources = ("map", "on the robot") if model.fixed else ("rig", "in the map")
        self._excluded: set[int | None] = set()  # indices of dead antennas
        self._waiting: deque[tuple[float, Integers, Array]] = deque()  # evidence from reads in the last CONFIRMED s

    @property
    def antennas(self) -> Sequence[str]:
        """The names of the antennas."""
        return list(self._antennas)

    @property
    def surveyed(self) -> Array:
        """The positions (N, 2) [m] of the tags in the building, or of the antennas if the tags are on the robot."""
        model = self.likelihood.model
        return np.array([(a.x, a.y) for a in model.antennas]) if model.fixed else self.map.tags.points[:, :2]

    def exclude(self, antenna: int) -> str:
        """Ignore the rounds of the antenna with index ``antenna`` until it reads a tag. Returns the antenna's name."""
        self._excluded.add(antenna)
        self._rounds = {}
        return self.antennas[antenna]

    def temper(self, tempering: float) -> None:
        """Set the exponent of the likelihood of reads to the smaller of ``tempering`` and the rig's value. It is then
        multiplied by the result of :func:`trust`, which accounts for survey errors."""
        new = min(self._tempering, tempering) * self.trust
        if new != self.likelihood.model.tempering:
            self.likelihood = self.likelihood.tempered(new)

    def read_counts(self, m: RfidScan, twist: Array = STANDING, *, count: bool = True) -> TagReadCounts | None:
        """Return the reads and misses of the scan ``m``, as a function of the pose at the time of the scan. Returns
        None if the map has no tags, or if the rig has none of the antennas.

        ``twist`` (3,): the velocity of the robot. ``count``: False if the same scan will be processed again, so that
        the diagnostics must not count its ignored reads.
        """
        diagnostics = self._diagnostics if count else Diagnostics()
        if self._excluded:
            active = {self._antennas.get(m.antennas[i]) for i in set(m.antenna.tolist())}
            if not self._excluded.isdisjoint(active):
                self._excluded, self._rounds = self._excluded - active, {}
        rows, used, rounds = self._rows_of_antennas(m.antennas)
        if -1 in rows:
            lacking = sum(name not in self._antennas for name in m.antennas)
            if lacking:
                diagnostics.ignore(f"antenna that the {self._sources[0]} lacks", lacking)
            if rows.count(-1) > lacking:
                diagnostics.ignore("dead antenna", rows.count(-1) - lacking)
        if not len(used) or not self.map.names:
            return None
        reads: list[tuple[int, int]] = []
        unknown = 0
        # several reads of a tag in one round count as one
        for number, name in dict.fromkeys(zip(m.antenna.tolist(), m.tags, strict=True)):
            place = self.map.index.get(name)
            if place is None:
                unknown += 1
            elif rows[number] >= 0:
                reads.append((rows[number], place))
        if unknown:
            diagnostics.ignore(f"tag not {self._sources[1]}", unknown)
        at, places = np.array(reads, dtype=np.int64).reshape(-1, 2).T
        self.states.hear(m.t, np.unique(places))
        self._report_suspects()
        tags = np.unique(np.concatenate((places, self.states.doubtful)))
        hits = np.zeros((len(used), len(tags)), dtype=np.int64)
        np.add.at(hits, (at, np.searchsorted(tags, places)), 1)
        odds = self.states.odds[tags]
        # the read of a tag that has probably moved (odds above 0) gives no information on an unknown pose
        elsewhere = np.where(hits.any(axis=0) & (odds <= 0.0), -np.inf, 0.0)
        prior = self.states.prior
        twists = np.tile(twist, (len(used), 1))
        return TagReadCounts(np.zeros((len(used), 3)), used, rounds, hits, odds, elsewhere, tags, prior, twists)

    def weigh_states(self, counts: TagReadCounts, pose: Array, covariance: Array, parameters: Array) -> TagEvidence:
        """Return the likelihood of reads and misses, ``counts``, for each possible state of the tags in range: as
        surveyed, weak or moved.

        ``pose`` (3,) with body-frame ``covariance`` (3, 3): the estimated pose before the scan corrects it.
        ``parameters`` (Q,): the estimated parameters of the read likelihood.
        """
        poses = sigma_poses(pose, np.ascontiguousarray(covariance), WIDENED * math.sqrt(3.0))
        places = self.states.hypotheses, FARTHEST, parameters, self.states.odds
        return TagEvidence(*self.likelihood.displaced(poses, counts, *places))

    def with_states(self, counts: TagReadCounts, evidence: TagEvidence) -> TagReadCounts:
        """Return a copy of ``counts`` with the current probabilities that tags are dead, weak or moved. ``evidence``:
        the result of :meth:`weigh_states` for the same scan."""
        elsewhere = self.states.expect(evidence.tags, evidence.log_likelihoods)
        return counts.with_states(evidence.tags, self.states.odds[evidence.tags], elsewhere)

    def without_doubtful(self, reads: TagReadCounts) -> TagReadCounts:
        """Return a copy of ``reads`` with tags that are clearly dead, weak or moved marked as such. These tags then
        have almost no effect on the likelihood of a pose."""
        clear = self.states.odds[reads.tags] > CLEAR
        if not clear.any():
            return reads
        return replace(
            reads, odds=np.where(clear, -math.log(1e-12), reads.odds), elsewhere=np.where(clear, 0.0, reads.elsewhere)
        )

    def learn(self, t: float, evidence: TagEvidence) -> None:
        """Update the states of tags with ``evidence`` from a scan at ``t`` [s], the result of :meth:`weigh_states`. The
        evidence of tags that were read is used :data:`CONFIRMED` seconds later, because a wrong pose is detected until
        then."""
        is_read, tags, log_likelihoods = evidence.is_read, evidence.tags, evidence.log_likelihoods
        self.states.learn(t, tags[~is_read], log_likelihoods[~is_read])
        self._waiting.append((t, tags[is_read], log_likelihoods[is_read]))
        while self._waiting[0][0] < t - CONFIRMED:
            self.states.learn(*self._waiting.popleft())
        self._report_suspects()

    def forget(self, since: float) -> None:
        """Undo all updates of the states of tags that used scans at or after the time ``since`` [s]."""
        self.states.forget(since)
        self._waiting = deque(row for row in self._waiting if row[0] < since)
        self._report_suspects()

    def silent(self) -> None:
        """Undo all updates of the states of tags after the last read. Call this if the reader has failed."""
        self.forget(math.nextafter(self.states.last_read, math.inf))

    def _report_suspects(self) -> None:
        """Write the names and probabilities of dead, weak and moved tags to the diagnostics."""
        for state, tags in self.states.suspects.items():
            names = map(self.map.names.__getitem__, tags)
            self._diagnostics.doubted[f"{state}_tags"] = dict(zip(names, tags.values(), strict=True))

    def _rows_of_antennas(self, names: tuple[str, ...]) -> tuple[list[int], Integers, Integers]:
        """Return three values for a table of counts with one row for each antenna that is used. First: the row of each
        antenna in ``names``, or -1 for unknown and dead antennas. Then: the antenna index and the number of rounds of
        each row."""
        if names not in self._rounds:
            antennas = [self._antennas.get(name, -1) for name in names]
            antennas = [-1 if antenna in self._excluded else antenna for antenna in antennas]
            used = sorted(set(antennas) - {-1})
            rows = [used.index(antenna) if antenna >= 0 else -1 for antenna in antennas]
            counts = [antennas.count(antenna) for antenna in used]
            self._rounds = {names: (rows, np.array(used, dtype=np.int64), np.array(counts, dtype=np.int64))}
        return self._rounds[names]

    def places(self, m: RfidScan) -> tuple[Integers, Integers]:
        """Return the antenna index (R,) and the tag index (R,) of each of the R reads in a scan. An antenna index is -1
        if the antenna is unknown. A tag index is -1 if the tag is unknown, or probably dead, weak or moved."""
        antennas = np.array([self._antennas.get(name, -1) for name in m.antennas], dtype=np.int64)
        tags = np.array([self.map.index.get(name, -1) for name in m.tags], dtype=np.int64)
        tags[(tags >= 0) & (self.states.odds[tags] > 0.0)] = -1
        return antennas[m.antenna], tags


M = TypeVar("M", RssiModel, PhaseModel)
Row = tuple[float, int, int, float, float]  # time of the read, antenna, tag, phase, frequency


class TagSignals:
    """Converts scans to signal strengths and to time windows of phases, if a run uses the sensors "rssi" and "phase".

    A window contains the phases of the last ``window`` seconds. A new window ends at least ``step`` seconds after the
    previous one. Both are settings of the rig.
    """

    def __init__(self, setup: Setup, tags: KnownTags) -> None:
        settings, self._tags = setup.rig.of(RfidSettings), tags
        self.strength: RssiLikelihood | None = None
        self.phase: PhaseLikelihood | None = None
        self._rows: deque[tuple[float, Row]] = deque()  # reads with a phase, each after the time of its scan
        self._ended: deque[float] = deque()  # end times [s] of windows
        self._window = self._step = 0.0
        self._newest = -np.inf
        antennas = tags.likelihood.model.antennas
        if settings.rssi is not None and "rssi" in setup.sensors:
            self.strength = RssiLikelihood(_tempered(settings.rssi.model(antennas), tags.trust), tags.map.tags)
        if settings.phase is not None and "phase" in setup.sensors:
            self.phase = PhaseLikelihood(_tempered(settings.phase.model(antennas), tags.trust), tags.map.tags)
            self._window, self._step = settings.phase.window, settings.phase.step

    def strengths(self, m: RfidScan) -> RssiReads | None:
        """Return the signal strengths of the reads in the scan ``m``, as a function of the pose at the time of the
        scan. Returns None if the run does not use them or the scan has none."""
        if self.strength is None:
            return None
        antennas, tags = self._tags.places(m)
        rows = np.flatnonzero((antennas >= 0) & (tags >= 0) & np.isfinite(m.rssi))
        if not len(rows):
            return None
        return RssiReads(np.zeros((len(rows), 3)), antennas[rows], tags[rows], m.rssi[rows])

    def keep(self, m: RfidScan) -> bool:
        """Store the phases of the reads in the scan ``m``. Returns True if a time window ends with this scan."""
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
        """Return the times (R,) [s] of the reads in the current time window of phases."""
        return np.array([row[0] for row in self._of_window()])

    def phases(self, offsets: Array, pose: Array) -> RfidFactor | None:
        """Return the phases of the R reads in the current time window as a factor on the robot's pose. Returns None if
        too few reads are near their tags. ``pose`` (3,): the predicted pose. ``offsets`` (R, 3): the robot's poses at
        the reads, in the frame of ``pose``."""
        if self.phase is None:
            return None
        _, antennas, tags, phase, frequency = (np.array(column) for column in zip(*self._of_window(), strict=True))
        windows = np.zeros(len(phase), dtype=np.int64)
        reads = self.phase.near(pose, PhaseReads(offsets, antennas, tags, phase, frequency, windows))
        return RfidFactor(self.phase, reads) if len(reads.phase) else None

    def forget(self, since: float) -> None:
        """Delete all reads in scans at or after ``since`` [s]. Call this before these scans are processed again."""
        while self._rows and self._rows[-1][0] >= since:
            self._rows.pop()
        while self._ended and self._ended[-1] >= since:
            self._ended.pop()

    def clear(self) -> None:
        """Delete all reads."""
        self._rows.clear()
        self._ended.clear()

    def _of_window(self) -> list[Row]:
        return [row for _, row in self._rows if row[0] >= self._newest - self._window]


def _tempered(model: M, trust: float) -> M:
    return replace(model, tempering=model.tempering * trust)
