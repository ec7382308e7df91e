"""Joint estimation of tag positions and robot trajectory from odometry and reads.

The trajectory is built in sections, to limit the drift of the odometry. After each section, all poses and mapped tags are optimised
(:class:`factors.rfid.factor.RfidTagFactor`). Then the other tags are searched (:mod:`factorgraph_loc.mapping.tag_search`). A tag is
added to the map if a single position explains its reads. At the end all tags are searched again along the whole trajectory. If the
position of a tag has changed significantly, the problem is solved again.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError, RunFailedError
from factorgraph_loc.fusion.graph.problem import IndeterminateError, Problem
from factorgraph_loc.mapping.tag_search import TagPosterior, of_tags, reach, search
from factorgraph_loc.model.belief import LearntPoint, PosePrior
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.measurement import TURN
from factorgraph_loc.model.scoring import TICK_GAP
from factorgraph_loc.sensors.motion import whole_motion
from factorgraph_loc.sensors.registry import moving
from factorgraph_loc.sensors.rfid.known_tags import tag_map, whole_scans
from factorgraph_loc.sensors.rfid.settings import RfidSettings, SurveySettings
from factorgraph_loc.sensors.rfid.stream import RfidScan
from factorgraph_loc.text import listed
from factors import se2
from factors.graph import Factor, PriorFactor, Values, VectorPriorFactor, constants_key, landmark_key, pose_key
from factors.motion import Increment
from factors.odometry import kernels
from factors.odometry.factor import OdometryFactor
from factors.rfid.detection import RfidLikelihood, TagArray, TagReadCounts
from factors.rfid.factor import RfidFactor, RfidTagFactor
from factors.rfid.model import RfidModel
from factors.se2 import Array

INTERVAL = 1.0  # s between keyframes
SECTION = 15  # keyframes per section of the trajectory
WINDOW = 90  # new tags are searched with the reads of this number of last keyframes
# m: missed reads of a tag are ignored if its distance exceeds the reach of the antennas plus this margin
MARGIN = 1.0
ITERATIONS, FINAL_ITERATIONS = 4, 40  # of the optimization after each section, and at the end
ROUNDS = 3  # largest number of times that all tags are searched again at the end
MOVED_GATE = 13.8  # squared Mahalanobis distance of a significant move: 99.9 % of chi-square, two degrees of freedom

Factors = list[tuple[Factor, tuple[int, ...]]]


@dataclass(frozen=True, eq=False)
class TagObservations:
    """K antenna observations of T tags, ordered by time. Each is what one antenna read in some inventory rounds.

    ``names``: the EPCs of the T tags. ``t`` (K,) [s]: times. ``antennas`` (K,): indices in the reader's ``model``.
    ``rounds`` (K,): the number of inventory rounds. ``hits`` (K, T): the number of these rounds that read each tag.
    ``heights`` (T,) [m]: the heights of the tags. ``has_height`` (T,): False where the height is only assumed.
    ``facing`` (T,) [rad]: the directions of the tags' fronts in the world frame, NaN where unknown. ``positions`` (T,
    2) [m]: from the log's map, NaN where the map lacks the tag.
    """

    model: RfidModel
    names: tuple[str, ...]
    t: Array
    antennas: NDArray[np.int64]
    rounds: NDArray[np.int64]
    hits: NDArray[np.int64]
    heights: Array
    facing: Array
    positions: Array
    has_height: NDArray[np.bool_]

    def along(self, poses: Array, which: NDArray[np.bool_] | slice = slice(None)) -> TagReadCounts:
        """Return the read counts of L selected observations, with robot poses. ``which``: a mask (K,) or a slice that
        selects them. ``poses`` (L, 3): the robot poses at their times, in the world frame."""
        return TagReadCounts(poses, self.antennas[which], self.rounds[which], self.hits[which])


def tag_observations(log: Log, height: float | None = None) -> TagObservations:
    """Return the antenna observations of all tags that a log read or that its map contains.

    Heights and directions of tags are from the log's map. Tags that are not in the map have an unknown direction and
    the height ``height`` [m]. If ``height`` is None, they have the mean height of the antennas.

    Raises InputError if the log has no reads, or no reads by an antenna of its rig.
    """
    scans = whole_scans(log)
    read_tags = {epc for scan in scans for epc in scan.tags}
    if not read_tags:
        raise InputError(f"{log.name}: has no reads of tags (rfid), so there is nothing to map")
    settings = log.rig.find(RfidSettings)
    if settings is None or settings.tags:
        raise InputError(
            f"{log.name}: its rig has no antennas: add [rfid.antennas] with their mounting and detection model"
        )
    antennas = {name: i for i, name in enumerate(log.rig.of(RfidSettings).all_antennas())}
    model = log.rig.of(RfidSettings).model()
    given = tag_map(log.world, log.rig.of(SurveySettings))
    names = (*given.names, *sorted(read_tags - set(given.names)))
    index = {name: i for i, name in enumerate(names)}
    rows = [row for m in scans for row in _rows(m, antennas, index)]
    if not rows:
        raise InputError(
            f"{log.name}: no read is by an antenna of its rig, which has {listed(antennas)}: "
            "use the names of the log in [rfid.antennas]"
        )
    rows.sort(key=lambda row: row[0])
    t, antenna, rounds, hits = zip(*rows, strict=True)
    unmapped = len(names) - len(given.names)
    has_height = np.append(np.ones(len(given.names), dtype=bool), np.full(unmapped, height is not None))
    if height is None:
        height = float(np.mean([a.z for a in model.antennas]))
    return TagObservations(
        model,
        names,
        np.array(t),
        np.array(antenna, dtype=np.int64),
        np.array(rounds, dtype=np.int64),
        np.array(hits, dtype=np.int64),
        np.concatenate((given.tags.points[:, 2], np.full(unmapped, height))),
        np.concatenate((given.tags.facing, np.full(unmapped, np.nan))),
        np.concatenate((given.tags.points[:, :2], np.full((unmapped, 2), np.nan))),
        has_height,
    )


def _rows(
    m: RfidScan, antennas: dict[str, int], index: dict[str, int]
) -> list[tuple[float, int, int, NDArray[np.int64]]]:
    """Return (time [s], antenna, rounds, reads) per antenna that measured in the scan ``m``. ``antenna``: its index.
    ``rounds``: its number of inventory rounds. ``reads`` (T,): how many of these read each tag. ``antennas``,
    ``index``: the indices of antennas and of T tags by name."""
    places = [antennas.get(name, -1) for name in m.antennas]
    out = {a: (m.t, a, places.count(a), np.zeros(len(index), dtype=np.int64)) for a in sorted(set(places) - {-1})}
    # a tag counts once per round, even if it answers several times
    for number, name in dict.fromkeys(zip(m.antenna.tolist(), m.tags, strict=True)):
        if places[number] >= 0:
            out[places[number]][3][index[name]] += 1
    return list(out.values())


@dataclass(frozen=True)
class TagSlam:
    """The estimated trajectory and map of tags.

    ``t`` (M,) [s], ``poses`` (M, 3): times and poses of the keyframes. ``tags``: the estimated positions of located
    tags, by index. ``facing`` (T,) [rad]: the directions of all T tags' fronts, NaN where unknown. ``posteriors``: the
    search results of all T tags.
    """

    t: Array
    poses: Array
    tags: dict[int, LearntPoint]
    facing: Array
    posteriors: list[TagPosterior]


def tag_slam(
    log: Log,
    observations: TagObservations,
    prior: PosePrior,
    known: NDArray[np.bool_],
    progress: Callable[[float], None],
) -> TagSlam:
    """Return the positions of tags and the trajectory of the robot, estimated together.

    ``log``: supplies odometry and rig. ``observations``: the reads of T tags by antennas. ``prior``: the start pose, in
    the frame of the result. ``known`` (T,): mask of the tags that are fixed at ``observations.positions``.
    ``progress``: a function that is called with the completed fraction, 0 to 1.
    """
    problem = _Problem(log, observations, prior, known)
    count = len(problem.t)
    for end in (*range(SECTION, count, SECTION), count):
        problem.extend(end)
        problem.solve(ITERATIONS)
        problem.add_located(problem.search(~problem.mapped, max(0, end - WINDOW)))
        progress(end / count)
    for _ in range(ROUNDS):
        problem.solve(FINAL_ITERATIONS)
        posteriors = problem.search(~known, 0)
        if not problem.add_located(posteriors):
            break
    return problem.result(posteriors)


class _Problem:
    """The least-squares problem of keyframe poses and tag positions, with the current estimates of both."""

    def __init__(self, log: Log, observations: TagObservations, prior: PosePrior, known: NDArray[np.bool_]) -> None:
        self._observations, self._prior, self._known = observations, prior, known
        self._constants = log.rig.estimated("odometry")
        self._places = np.array(self._constants.indices, dtype=np.int64)
        wheels = moving(log.streams)
        motion = whole_motion(log, (*wheels, *(name for name in moving(log.rig.sensors, TURN) if not moving((name,)))))
        last = max(float(observations.t[-1]), prior.t)
        self.t = _keyframes(prior.t, last, np.concatenate((observations.t, *(log.streams[name].t for name in wheels))))
        states = [motion.state(float(t)) for t in self.t]
        self._steps = [motion.relative(a, b) for a, b in pairwise(states)]
        self._used = observations.t >= prior.t
        self._keyframe = np.searchsorted(self.t, observations.t, side="right") - 1
        self._offsets = np.zeros((len(observations.t), 3))
        for k in np.flatnonzero(self._used):
            self._offsets[k] = motion.relative(states[self._keyframe[k]], motion.state(float(observations.t[k]))).delta
        self._reach = reach(observations.model) + MARGIN
        self._facing = observations.facing.copy()
        self.mapped = known.copy()
        self._values: Values = {pose_key(0): np.array(prior.pose)}
        if self._constants.names:
            self._values[constants_key(0)] = np.zeros(len(self._constants.names))
        self._count = 1

    def extend(self, count: int) -> None:
        """Add keyframes until there are ``count`` in all. Their poses are predicted by odometry."""
        for i in range(self._count, count):
            step = self._recalibrated(self._steps[i - 1])
            self._values[pose_key(i)] = se2.compose(self._values[pose_key(i - 1)], step)
        self._count = max(self._count, count)

    def search(self, wanted: NDArray[np.bool_], first: int) -> list[TagPosterior]:
        """Return a search result for each of T tags along the current poses. The result has no modes if the tag is not
        searched.

        ``wanted`` (T,): mask of the tags to search. ``first``: the index of the first keyframe with observations that
        are used.
        """
        which = self._used & (self._keyframe >= first) & (self._keyframe < self._count)
        poses = se2.compose(self._poses()[self._keyframe[which]], self._offsets[which])
        along = self._observations.along(poses, which)
        tags = np.flatnonzero(wanted)
        out = [TagPosterior((), 0, 0.0) for _ in wanted]
        if len(tags) and len(poses):
            mine = of_tags(along, tags)
            posteriors = search(
                self._observations.model, mine, self._observations.heights[tags], self._observations.facing[tags]
            )
            for tag, posterior in zip(tags.tolist(), posteriors, strict=True):
                out[tag] = posterior
        return out

    def add_located(self, posteriors: list[TagPosterior]) -> bool:
        """Add to the map the tags that ``posteriors`` (search results of all tags) locate. Move a mapped tag if its new
        position differs significantly. Returns True if the map changed."""
        changed = False
        for tag, posterior in enumerate(posteriors):
            if self._known[tag] or not posterior.is_located:
                continue
            mode, key = posterior.modes[0], landmark_key(tag)
            if self.mapped[tag]:
                off = mode.position - self._values[key]
                if off @ np.linalg.solve(mode.covariance, off) < MOVED_GATE:
                    continue
            self._values[key] = mode.position
            self.mapped[tag], changed = True, True
            if np.isnan(self._observations.facing[tag]):
                self._facing[tag] = mode.facing
        return changed

    def solve(self, iterations: int) -> None:
        self._values = self._problem().solve(self._values, iterations).values

    def result(self, posteriors: list[TagPosterior]) -> TagSlam:
        tags = np.flatnonzero(self.mapped & ~self._known).tolist()
        keys = [landmark_key(i) for i in tags]
        try:
            covariances = self._problem().covariances(self._values, keys).by_key
        except IndeterminateError as error:
            raise RunFailedError(
                f"{len(tags)} tags were located, but the reads do not determine their covariances"
            ) from error
        learnt = {i: LearntPoint(self._values[key], covariances[key]) for i, key in zip(tags, keys, strict=True)}
        return TagSlam(self.t, self._poses(), learnt, self._facing, posteriors)

    def _poses(self) -> Array:
        return np.array([self._values[pose_key(i)] for i in range(self._count)])

    def _recalibrated(self, increment: Increment) -> Array:
        if not self._constants.names:
            return increment.delta
        delta: Array = kernels.recalibrated(
            increment.delta, increment.moving, self._values[constants_key(0)], self._places
        )
        return delta

    def _problem(self) -> Problem:
        body = se2.world_to_body(self._prior.pose, self._prior.covariance)
        factors: Factors = [(PriorFactor(self._prior.pose, body), (pose_key(0),))]
        shared: tuple[int, ...] = ()
        if self._constants.names:
            shared = (constants_key(0),)
            factors.append((VectorPriorFactor(np.zeros(len(self._constants.names)), self._constants.sigmas), shared))
        for i in range(1, self._count):
            step = OdometryFactor(self._steps[i - 1], self._constants.indices)
            factors.append((step, (pose_key(i - 1), pose_key(i), *shared)))
        return Problem(factors + self._tag_factors())

    def _tag_factors(self) -> Factors:
        observations, out = self._observations, list[tuple[Factor, tuple[int, ...]]]()
        points = np.column_stack((np.nan_to_num(observations.positions), observations.heights))
        everything = RfidLikelihood(observations.model, TagArray(points, self._facing))
        fixed = np.flatnonzero(self._known)
        map_ = RfidLikelihood(observations.model, TagArray(points[fixed], self._facing[fixed]))
        variable = np.flatnonzero(self.mapped & ~self._known)
        places = np.array([self._values[landmark_key(i)] for i in variable.tolist()]).reshape(-1, 2)
        order = np.flatnonzero(self._used & (self._keyframe < self._count))
        bounds = np.searchsorted(self._keyframe[order], np.arange(self._count + 1))
        for i in range(self._count):
            rows = order[bounds[i] : bounds[i + 1]]
            if not len(rows):
                continue
            hits = observations.hits[rows]
            counts = TagReadCounts(self._offsets[rows], observations.antennas[rows], observations.rounds[rows], hits)
            if len(fixed):
                out.append((RfidFactor(map_, of_tags(counts, fixed)), (pose_key(i),)))
            near = np.hypot(*(places - self._values[pose_key(i)][:2]).T) < self._reach
            for tag in variable[near | hits[:, variable].any(axis=0)].tolist():
                out.append((RfidTagFactor(everything, tag, counts), (pose_key(i), landmark_key(tag))))
        return out


def _keyframes(begin: float, end: float, stamps: Array) -> Array:
    """Return the times [s] of keyframes at intervals of ``INTERVAL`` from ``begin`` to ``end``. ``stamps`` [s]: the
    times of measurements. Times inside of long gaps between these are left out, except the last time before the end of
    a gap."""
    measured = np.unique(np.concatenate(((begin, end), stamps[(stamps > begin) & (stamps < end)])))
    gaps = np.flatnonzero(np.diff(measured) > TICK_GAP)
    firsts = np.append(0, ((measured[gaps + 1] - begin) / INTERVAL).astype(np.int64))
    lasts = ((np.append(measured[gaps], end) - begin) / INTERVAL).astype(np.int64)
    numbers = [np.arange(first, last + 1) for first, last in zip(firsts.tolist(), lasts.tolist(), strict=True)]
    return np.asarray(begin + INTERVAL * np.concatenate(numbers))
