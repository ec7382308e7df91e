"""The graph estimators: the smoother, which is a factor graph over the run, and the batch solution.

By default, causal estimates come from a window: poses older than 10 s are marginalised. The whole problem is solved at
the end. Other modes are settings:

- ``lag = "all"`` keeps the whole history in iSAM2. This is the default if landmarks or points are estimated, because a loop may
  close at any time.
- ``lag`` in seconds sets the length of the window. The final trajectory has each pose's estimate from when the pose left
  the window.
- ``final_only``, as in the batch, builds the graph with rough estimates and solves it only at the end. If points are estimated,
  rough estimates drift too far to associate sightings with points, so iSAM2 solves the graph during the run.

When the search rejects the track and finds another pose, the graph is cut at the time when the track became wrong. It
continues at the new pose, after a step of unknown length. Later measurements are replayed in slices of fixed cost, so
that results do not depend on the machine. The status is not ``localized`` before the replay has ended.
"""

from __future__ import annotations

import bisect
import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_loc.fusion.base import record_each
from factorgraph_loc.fusion.graph.batch import AtTheEnd
from factorgraph_loc.fusion.graph.graph import NOTHING_KNOWN, STATE, Graph, Keyframe, Mapper
from factorgraph_loc.fusion.graph.isam import Incremental
from factorgraph_loc.fusion.graph.keyframes import Backend, Builder
from factorgraph_loc.fusion.graph.settings import BatchSettings, SmootherSettings
from factorgraph_loc.fusion.layout import learnt_from
from factorgraph_loc.fusion.search import DURATION
from factorgraph_loc.fusion.timeline import Taken, Timeline
from factorgraph_loc.fusion.tracking import FOUND, JUMPED, Refuted, Tracked, Tracking, is_known
from factorgraph_loc.model.belief import Learnt, PoseEstimate, PosePrior, Status
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.measurement import Measurement, Tick
from factorgraph_loc.model.setup import Calibration, Setup
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.plugins import MAPPERS
from factorgraph_loc.sensors.base import Binding
from factorgraph_loc.sensors.known_position import KnownPosition
from factorgraph_loc.sensors.motion import MOTION, Motion
from factorgraph_loc.sensors.registry import bound_sensors
from factors import se2
from factors.motion import ChainState, Increment, poses_between
from factors.se2 import Array

__all__ = ["Batch", "BatchSettings", "Smoother", "SmootherSettings"]


REPLAYED, TICK = 300, 2  # computing cost of one slice of a replay, and of one tick, in the unit of `Sensor.work`


@dataclass(frozen=True)
class _Conclusion:
    """The final solution of a graph. ``graph``: a copy of it, with the final values. ``poses`` (M, 3), ``covariances``
    (M, 3, 3): of all keyframes, covariances in the body frame."""

    graph: Graph
    poses: Array
    covariances: Array


class Smoother(Timeline):
    """An incremental factor graph (iSAM2) over the last ``lag`` seconds, or over the whole run if ``lag`` is "all"."""

    # True because the setting `landmarks` can make this class estimate points that the map lacks
    estimates_points = True

    def __init__(self, setup: Setup, settings: SmootherSettings) -> None:
        self._settings = settings
        diagnostics = Diagnostics()
        calibration: Calibration = "all" if settings.self_calibration else "none"
        motion = Motion(setup.rig, setup.sensors, diagnostics, self_calibration=settings.self_calibration)
        super().__init__(motion, diagnostics, settings.max_delay)
        use = settings.landmarks
        self._sensors = sensors = bound_sensors(Binding(setup, motion, diagnostics, use, use, calibration))
        mapper: Mapper = MAPPERS["points"](sensors, self.diagnostics, settings)
        self._graph = Graph(self._motion, sensors, mapper, self.diagnostics)
        self._search = self._seeking = Tracking(sensors, self._motion, setup.rng, diagnostics)
        self._search.remember()
        # estimated landmarks cannot determine an unknown start
        self.supports_unknown_start = settings.landmarks == "known"
        self._backend: Backend
        if settings.final_only and not mapper.estimates:
            self._backend = AtTheEnd(self._graph)
        else:
            self._backend = Incremental(self._graph, settings)
        self._builder = Builder(self._graph, self._backend, self._search, settings)
        # the integrated odometry at the last measurement
        self._odometry = ChainState(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        self._behind: deque[Measurement] = deque()  # measurements that wait for the replay
        self._conclusion: _Conclusion | None = None  # the final solution, discarded at each measurement

    def initialize(self, prior: PosePrior) -> None:
        """Start from a Gaussian prior of the pose. If the prior has no heading, the graph starts when measurements have
        determined the heading."""
        if not prior.has_heading:
            self._seek_heading(prior, self._search)
            return
        self._t = self._begun = prior.t
        self._search.begin_track(by_search=False)
        self._backend.begin(self._graph.begin(prior))

    def _renew(self, m: Measurement) -> None:
        self._conclusion = None

    def _process(self, m: Measurement) -> None:
        on_time = m.t >= self._t
        if self._behind:
            self._behind.append(m)
            self._t = max(self._t, m.t)
            self._catch_up()
        else:
            self._take(m)
        if on_time and not self._behind:
            self._doubt(m)

    def _estimate_at(self, t: float | None) -> PoseEstimate:
        """Return the pose predicted by odometry from the newest keyframe to the current time or, if later, to ``t``
        [s]. With the setting ``final_only``, this is a rough estimate with the status ``unlocalized``."""
        at = self._t if t is None else max(t, self._t)
        pose, _, covariance = self._graph.moved(at)
        return PoseEstimate(at, pose, covariance, self._status(covariance))

    def _status(self, covariance: Array) -> Status:
        """Return the status of an estimate with this ``covariance`` (3, 3) of (x, y, heading) at the current time."""
        if self._settings.final_only:
            return "unlocalized"
        doubted = self._behind or self._search.doubts or self._search.is_unsure(self._t, covariance)
        return "ambiguous" if doubted else "localized"

    def record(self, ticks: Sequence[float]) -> list[PoseEstimate]:
        """Return one estimate for each of ``ticks``, increasing times [s] at which a run records the pose."""
        estimates: list[PoseEstimate] = []
        while len(estimates) < len(ticks):
            rest = ticks[len(estimates) :]
            simple = rest[: self._simple(rest)]
            estimates += self._record(simple) if simple else record_each(self, rest[:1])
        return estimates

    def _simple(self, ticks: Sequence[float]) -> int:
        """Return how many of the first ``ticks`` [s] need only a prediction of the pose. The number is 0 while a search
        is running, and no counted tick needs a new keyframe."""
        waits = self._begun == math.inf or self._behind or self._search.waits or not self._graph.is_anchored
        if waits or ticks[0] <= max(self._t, self._graph.newest.t):
            return 0
        return bisect.bisect_left(ticks, True, key=self._builder.is_due)

    def _record(self, ticks: Sequence[float]) -> list[PoseEstimate]:
        self._conclusion = None
        doubts_model = any(sensor.doubts_model for sensor in self._sensors.values())
        states, poses, _, covariances = self._graph.all_moved(ticks)
        estimates = []
        for t, state, pose, covariance in zip(ticks, states.tolist(), poses, covariances, strict=True):
            self._t, self._odometry = t, ChainState(*state)
            self._builder.pass_time(self._odometry)
            self._remember(Taken(Tick(t)), DURATION)
            estimates.append(PoseEstimate(t, pose, covariance, self._status(covariance), doubts_model))
        return estimates

    def learnt(self) -> Learnt:
        """Return the estimated sensor constants, landmarks and points of the final solution, with covariances."""
        if self._graph.prior is None:
            return _learnt(self._graph)
        end = self._concluded()
        return _learnt(end.graph, end.poses, end.covariances)

    def trajectory(self) -> Trajectory:
        """Return the final estimates of all poses since the start, at the times at which the run recorded the pose. The
        trajectory is empty if the start pose was never found."""
        if self._graph.prior is None:
            return Trajectory(np.empty(0), np.empty((0, 3)), np.empty((0, 3, 3)))
        end = self._concluded()
        return _trajectory(end.graph, end.poses, end.covariances)

    def final_diagnostics(self) -> Diagnostics:
        """Return the diagnostics of the run, including those of the final solution."""
        return self.diagnostics if self._graph.prior is None else self._concluded().graph.diagnostics

    def forget(self, until: float) -> None:
        """Delete the trajectory before the time ``until`` [s], but nothing in the window of the last ``lag`` seconds.
        If the setting ``lag`` is "all" or not set, nothing is deleted."""
        if isinstance(self._backend, Incremental):
            self._backend.forget(min(until, self._taken_until - self._settings.max_delay))

    def _concluded(self) -> _Conclusion:
        """Return the final solution, computed on a copy of the graph. The original graph does not change."""
        if self._conclusion is None:
            graph = self._graph.copy()
            graph.newest.nodes += self._builder.waiting()
            self._conclusion = _Conclusion(graph, *self._backend.final(graph))
        return self._conclusion

    def _take(self, m: Measurement) -> None:
        added = self.diagnostics.record()
        if not self._graph.is_anchored:
            self._graph.anchor()
        self._t, self._odometry = max(self._t, m.t), self._motion.state(m.t)
        if isinstance(m, Tick):
            self._builder.pass_time(self._odometry)
        elif not self._builder.take(m, self._odometry):
            self._drop_late(m)
        self.diagnostics.added = None
        self._remember(Taken(m, added=added), DURATION)

    def _prior(self, t: float, best: PosePrior, moved: Increment, start: KnownPosition | None) -> PosePrior:
        pose = self._placed(t, best)
        return PosePrior(t, pose, FOUND) if start is None else start.facing(float(pose[2]))

    def _doubt(self, m: Measurement) -> None:
        """Check after the measurement ``m`` whether recent observations contradict the estimated poses. If they do,
        continue at the pose that a global search has found."""
        graph, odometry = self._graph, self._odometry

        def track() -> Tracked:
            if m.t <= graph.newest.t:
                return Tracked(odometry, graph.pose, graph.covariance)
            return Tracked(odometry, *graph.moved(m.t)[:2])

        def back(t: float, pose: Array) -> Array:
            return self._placed(t, PosePrior(m.t, pose, FOUND))

        refuted = self._search.refuted(m, track, back)
        best = None if refuted is None else self._search.best
        if refuted is not None and best is not None:
            self.diagnostics.event(self._t, "lost", JUMPED, why=refuted.why, since=refuted.since)
            self._go_on(refuted, best)

    def _go_on(self, refuted: Refuted, best: PosePrior) -> None:
        """Remove the keyframes since ``refuted.since``, the time when the estimated pose became wrong. Then process
        their measurements again, beginning at the pose ``best``."""
        graph, since = self._graph, refuted.since
        first = graph.newest.index + 1  # the number of the first keyframe to remove
        while first > 1 and graph.keyframes[first - 1].t >= since and self._backend.is_open(first - 2):
            first -= 1
        replay = self._take_back(max(since, graph.keyframes[first - 1].t))
        t = replay[0].t
        graph.cut(first, t)
        pose, last = self._placed(t, best), graph.newest.causal
        assert last is not None
        jump = Increment(se2.between(last[0], pose), FOUND, t - graph.newest.t)
        keyframe = Keyframe(first, t, self._motion.state(t), jump, is_elsewhere=True)
        graph.append(keyframe)
        earlier = [change for change in graph.changes if change[0] < t]
        graph.changes = (*earlier, (min(refuted.change[0], t), max(refuted.change[1], t)))
        graph.pose, graph.covariance = pose, FOUND
        self._builder.clear()
        for sensor in graph.sensors.values():
            sensor.restart(t)
        graph.forget_points()
        self._backend.begin(keyframe)
        self._search.begin_track(by_search=True)
        self._replay(replay)

    def _placed(self, t: float, best: PosePrior) -> Array:
        """Return the robot's pose (3,) at time ``t`` [s], computed by odometry from ``best``, its pose at a later
        time."""
        moved = self._motion.relative(self._motion.state(t), self._motion.state(best.t))
        return se2.compose(best.pose, se2.inverse(self._graph.recalibrated(moved).delta))

    def _replay(self, measurements: Sequence[Measurement]) -> None:
        self._behind.extend(measurements)
        self._t = max(m.t for m in measurements)
        self._catch_up()

    @property
    def _taken_until(self) -> float:
        """The time [s] until which all measurements are processed."""
        return min((m.t for m in self._behind), default=self._t)

    def _catch_up(self) -> None:
        """Process again some of the measurements that are queued for this. The computing cost of a call is limited."""
        work = REPLAYED
        while self._behind and work > 0:
            m = self._behind.popleft()
            work -= TICK if isinstance(m, Tick) else self._graph.sensors[m.source].work
            self._take(m)


class Batch(Smoother):
    """An estimator that computes the robust optimum over the whole log, once at its end. See the module docstring."""

    causal = False

    def __init__(self, setup: Setup, settings: BatchSettings) -> None:
        super().__init__(setup, SmootherSettings(**settings.model_dump(), final_only=True))


def _learnt(graph: Graph, poses: Iterable[Array] = (), covariances: Iterable[Array] = ()) -> Learnt:
    """Return the estimated sensor constants, landmarks and points of a graph. ``poses`` (M, 3), ``covariances`` (M, 3,
    3): the final poses of all M keyframes and their body-frame covariances."""
    blocks = [(name, graph.values[key], graph.covariances[key]) for name, key in graph.keys.items()]
    numbered = graph.keyframes.values()
    means, bodies = ({k.key: v for k, v in zip(numbered, part)} for part in (poses, covariances))  # noqa: B905
    means, bodies = graph.departed[0] | graph.values | means, graph.departed[1] | graph.covariances | bodies
    return learnt_from(graph.constants, blocks, graph.mapper.learnt(means, bodies))


def _trajectory(graph: Graph, poses: Array, covariances: Array) -> Trajectory:
    """Return the trajectory at the times at which the run records the pose, interpolated between keyframes.

    ``poses`` (M, 3), ``covariances`` (M, 3, 3): the final poses of all keyframes and their body-frame covariances.
    Times at which the pose is unknown, because the robot was carried, are left out.
    """
    newest = {tick.t: tick for tick in graph.ticks}
    stamps = np.array(sorted(newest))
    ticks = [newest[t] for t in stamps[is_known(stamps, graph.changes)].tolist()]
    keyframes = list(graph.keyframes.values())
    previous = np.array([tick.keyframe - keyframes[0].index for tick in ticks], dtype=np.int64)
    ends = np.array([tick.odometry for tick in ticks]).reshape(-1, STATE)
    starts = np.array([k.odometry for k in keyframes]).reshape(-1, STATE)[previous]
    deltas, noises = graph.motion.relatives(starts, ends, graph.value(MOTION, NOTHING_KNOWN))
    steps = [graph.recalibrated(k.from_previous) for k in keyframes[1:] if k.from_previous is not None]
    later = (
        np.array([step.delta for step in steps]).reshape(-1, 3),
        np.array([step.covariance for step in steps]).reshape(-1, 3, 3),
        np.array([step.duration for step in steps]),
        np.array([k.is_elsewhere for k in keyframes[1:]], dtype=np.bool_),
    )
    at, body = poses_between(previous, deltas, noises, np.abs(ends[:, 0] - starts[:, 0]), *later, poses, covariances)
    return Trajectory(np.array([tick.t for tick in ticks]), at, se2.body_to_world(at, body))
