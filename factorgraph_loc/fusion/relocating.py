"""Graphs that find their place: an unknown start, a wrong one, and a robot that was carried elsewhere.

Before the start the last sightings are kept until they tell one place; then they are taken in from their first on. So they are
where the start is known but for its heading; the graph then begins at that start. On the way, landmarks that are persistently
not where they are expected make a suspicion, and a place that explains them much better a certainty: the graph goes back to where
the suspicion began, and goes on at the new place after a step of unknown length. Where no landmarks are used, scans of RFID tags
do the same. A camera tells the place by itself, whatever else is used.
"""

from __future__ import annotations

import bisect
import math
from abc import abstractmethod
from collections import Counter, deque
from collections.abc import Collection
from dataclasses import replace

import numpy as np

from factorgraph_loc.fusion.graph_builder import MeasuringGraph
from factorgraph_loc.fusion.graph_parts import GraphSettings, Guess, Keyframe
from factorgraph_loc.fusion.known_position import START_KEPT, KnownPosition
from factorgraph_loc.fusion.scan_finder import ScanFinder
from factorgraph_loc.fusion.variables import is_point, landmark_key
from factorgraph_loc.model.belief import Belief, Mode, PoseEstimate, PosePrior, Status
from factorgraph_loc.model.diagnostics import NOTHING_WRITTEN, Diagnostics, Written
from factorgraph_loc.model.measurement import Exteroceptive, Measurement, Odometry, Tick
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.sensors.camera.finder import MISSED, PixelFinder
from factorgraph_loc.sensors.camera.sensor import Pixels
from factorgraph_loc.sensors.landmarks.finder import DURATION, Relocalizer
from factorgraph_loc.sensors.landmarks.monitor import TrackMonitor
from factorgraph_loc.sensors.landmarks.pending import NewLandmarks
from factorgraph_loc.sensors.landmarks.sensor import KnownLandmarks
from factorgraph_loc.sensors.rfid.measurement import RfidScan
from factorgraph_loc.sensors.rfid.monitor import ScanMonitor
from factorgraph_loc.sensors.rfid.tag_map import extent
from factorgraph_loc.slam.new_points import FEWEST
from factors import se2
from factors.landmarks.factor import BearingRangeFactor
from factors.motion import ChainState, Increment
from factors.rfid.detection import Looks
from factors.rfid.update import TagUpdate
from factors.se2 import Array

# m, m, rad: nothing is known of a start, or of where a robot is carried; the sightings that told the place come in as factors
UNKNOWN = np.diag((10.0, 10.0, math.pi)) ** 2
SEARCH_INTERVAL = 1.0  # s between searches while there is a suspicion


class RelocatingGraph(MeasuringGraph):
    """A graph estimator that finds its place; see the module."""

    modalities = frozenset({"bearing_range", "rfid", "camera"})
    estimates_points = True  # with ``landmarks`` other than ``known``, those that the map lacks

    def __init__(self, setup: Setup, settings: GraphSettings) -> None:
        super().__init__(setup, settings)
        self._motion.keep(2.0 * DURATION)
        # where landmarks are estimated too, they cannot tell the place
        self._relocates = self.supports_unknown_start = settings.landmarks == "known"
        self._relocalizer = Relocalizer(self._motion, setup.world.positions())
        self._finder = None
        self._monitor: TrackMonitor | ScanMonitor = TrackMonitor()
        if self._scans.tags.likelihood is not None and not self._landmarks.known:
            bounds = extent(setup.world, self._scans.tags.map.tags)
            self._finder = ScanFinder(self._scans.tags.likelihood, self._motion, bounds, setup.rng)
            self._monitor = ScanMonitor()
        # what is seen before the start is counted when it is taken in
        self._sought = KnownLandmarks(setup, Diagnostics())
        self._camera = PixelFinder(self._points, self._motion)
        self._searched: ChainState | None = None
        # the last measurements, in the order in which they were taken, with what the diagnostics say of them
        self._recent: deque[tuple[Exteroceptive | Tick, Written]] = deque()
        self._start: KnownPosition | None = None  # while its heading is sought

    def initialize(self, prior: PosePrior) -> None:
        """Start from a Gaussian; without a heading, once what is seen tells it."""
        if prior.has_heading:
            super().initialize(prior)
            return
        self._t = prior.t
        self._seek_from(KnownPosition(prior, self._motion))

    def _seek_from(self, start: KnownPosition | None) -> None:
        """Tell the searches what is known of the start."""
        self._start = self._relocalizer.start = self._camera.start = start
        self._motion.keep(2.0 * DURATION if start is None else START_KEPT)
        if self._finder is not None and start is not None:
            self._finder.begin(start)

    def process(self, measurement: Measurement) -> None:
        """Take one measurement, in time or late by at most ``max_delay``."""
        if isinstance(measurement, Odometry):
            super().process(measurement)
        elif self._prior is None:
            self._conclusion = None
            self._search(measurement)  # type: ignore[arg-type]
        else:
            super().process(measurement)
            if isinstance(measurement, Pixels):
                self._watch(measurement)
            elif not isinstance(measurement, Tick) and self._monitor.suspicious_since is not None:
                self._doubt(self._monitor.suspicious_since)

    def estimate(self, t: float | None = None) -> PoseEstimate:
        """The newest keyframe, moved along the odometry since; before the start the likeliest place, if there is any.

        ``ambiguous`` before one place is clear, and while the landmarks are not where they are expected.
        """
        if self._prior is not None:
            status: Status = "ambiguous" if self._doubted or self._scans.silent else "localized"
            return replace(super().estimate(t), status=status)
        at = self._t if t is None else max(t, self._t)
        modes = self._modes(at)
        if not modes:
            return PoseEstimate(at, np.full(3, np.nan), np.full((3, 3), np.nan), "unlocalized")
        return PoseEstimate(at, modes[0].pose, modes[0].covariance, "ambiguous")

    def belief(self, t: float | None = None) -> Belief:
        """The belief behind :meth:`estimate`; before the start all places that the sightings allow, and the particles of who
        seeks by scans."""
        if self._prior is not None:
            return super().belief(t)
        at = self._t if t is None else max(t, self._t)
        modes = tuple(self._modes(at))
        if self._finder is None or self._searched is None or self._camera.newest is not None:
            return Belief(modes)
        poses, weights = self._finder.particles
        since = self._motion.relative(self._searched, self._motion.state(at))
        return Belief(modes, se2.compose(poses, since.delta), weights)

    def _modes(self, t: float) -> list[Mode]:
        found = self._relocalizer.hypotheses if self._finder is None else self._finder.hypotheses
        at = self._searched
        if self._camera.newest is not None:
            found, at = self._camera.hypotheses, self._camera.newest
        if at is None:
            return [] if self._start is None else [self._start.mode(self._motion.state(t))]
        since = self._motion.relative(at, self._motion.state(t))
        return [
            Mode(h.weight, se2.compose(h.pose, since.delta), h.covariance + se2.body_to_world(h.pose, since.covariance))
            for h in found
        ]

    def _best(self) -> PosePrior | None:
        """The place that was found, at the time of the last search."""
        if (seen := self._camera.best) is not None:
            return seen
        return self._relocalizer.best if self._finder is None else self._finder.best

    def _take(self, m: Exteroceptive | Tick) -> None:
        mark = self.diagnostics.mark()
        super()._take(m)
        self._remember(m, self.diagnostics.since(mark))

    def _remember(self, m: Exteroceptive | Tick, written: Written = NOTHING_WRITTEN) -> None:
        self._recent.append((m, written))
        while self._recent[0][0].t < m.t - (DURATION if self._start is None else START_KEPT):
            self._recent.popleft()

    def _take_back(self, t: float) -> list[Exteroceptive | Tick]:
        """The last measurements from ``t`` on, by their times: forgotten, as they are taken once more."""
        again = [(m, written) for m, written in self._recent if m.t >= t]
        self._recent = deque((m, written) for m, written in self._recent if m.t < t)
        for _, written in reversed(again):
            self.diagnostics.take_back(written)
        return sorted((m for m, _ in again), key=lambda m: m.t)

    def _search(self, m: Exteroceptive | Tick) -> None:
        """Before the start: see whether what was seen tells one place by now, and start there."""
        if self._start is not None:
            self._start.settle()
        if self._start is not None and m.t < max(self._start.t, self._t - self._graph_settings.max_delay):
            self._drop_late(m)
            return
        self._t = max(self._t, m.t)
        looked = not isinstance(m, Tick) and self._look(m)
        if not looked and self._searched is None and self._camera.newest is None and self._start is None:
            return  # the run begins with the first landmark, scan or image that tells something
        self._remember(m)
        if not looked or self._best() is None:
            return
        replay = self._take_back(-math.inf)
        self.diagnostics.events.append((m.t, "localized"))
        t = replay[0].t
        prior = PosePrior(t, self._placed(t), UNKNOWN)
        if self._start is not None and self._t <= self._start.t + START_KEPT:
            prior = self._start.facing(float(self._placed(self._start.t)[2]))
        self._seek_from(None)
        self.initialize(prior)
        self._replay(replay)

    def _look(self, m: Exteroceptive) -> bool:
        """Search with one more measurement; False if it tells nothing."""
        state = self._motion.state(m.t)
        if isinstance(m, Pixels):
            return self._camera.look(m, state)
        if isinstance(m, RfidScan):
            looks = self._scans.tags.looks(m, count=False)
            if looks is None or self._finder is None:
                return False
            self._finder.add(state, looks)
        else:
            seen = self._sought.factor(m)
            if seen is None or self._finder is not None:
                return False
            self._relocalizer.add(state, seen)
            self._relocalizer.search()
        self._searched = state
        return True

    def _doubt(self, since: float) -> None:
        """See whether another place explains what is seen since then, and go on there."""
        now = self._motion.state(self._t)
        if self._finder is not None:
            self._finder.seek(since)
            refuted = self._finder.refutes(self._pose, self._covariance)
            if isinstance(self._monitor, ScanMonitor) and self._finder.confirms(self._pose, self._covariance):
                self._monitor.accept()
                self._finder.rest()
        elif self._searched is not None and now.t < self._searched.t + SEARCH_INTERVAL:
            return
        else:
            self._relocalizer.forget(since)
            self._relocalizer.search()
            refuted = self._relocates and self._relocalizer.refutes(self._pose, self._covariance)
        self._searched = now
        if refuted:
            what = "landmarks were not where" if self._finder is None else "tags were not read as"
            what += " they were expected"
            self._lose(what, since)
            self._go_on(since if self._finder is None else self._finder.change(self._placed))

    def _watch(self, m: Pixels) -> None:
        """See whether the camera sees what is expected, and go on where it sees the robot if that is elsewhere."""
        if m.t < self._t:
            return
        moved = self._since(self._keyframes[-1], m.t)
        since = self._camera.refuted_since(m, self._motion.state(m.t), se2.compose(self._pose, moved.delta))
        if since is not None:
            self._lose(MISSED, since)
            self._go_on(since)

    def _lose(self, what: str, since: float) -> None:
        event = f"lost: {what} since {since:.1f} s; goes on at another place"
        self.diagnostics.events.append((self._t, event))

    def _go_on(self, since: float) -> None:
        """Take back what was added since then, and add it once more at the place that was found."""
        index = max(1, bisect.bisect_left(self._keyframe_times, since, self._keyframe_times.first))
        while not self._is_open(index - 1):
            index += 1
        t = max(since, self._keyframes[index - 1].t)
        replay = self._take_back(t)
        t = replay[0].t
        del self._keyframes[index:], self._keyframe_times[index:]
        self._ticks = [tick for tick in self._ticks if tick.keyframe < index and tick.t < t]
        pose = self._placed(t)
        jump = Increment(se2.between(self._guess_of(index - 1)[0], pose), UNKNOWN, t - self._keyframes[-1].t)
        keyframe = Keyframe(index, t, self._motion.state(t), jump)
        self._keyframes.append(keyframe)
        self._keyframe_times.append(t)
        self._pose, self._covariance = pose, UNKNOWN
        self._scans.clear()
        self._scans.tags.forget(t)
        self._forget_points()
        self._begin_again(keyframe)
        self._replay(replay)

    def _forget_points(self) -> None:
        """Give up the points that the keyframes that are left do not tell."""
        if self._unknown is None:
            return
        seen = Counter(key for k in self._keyframes for node in k.nodes for key in node.keys if is_point(key))
        kept = {key for key, count in seen.items() if count >= FEWEST}
        for k in self._keyframes:
            k.nodes = [node for node in k.nodes if all(key in kept or not is_point(key) for key in node.keys)]
        for key in [key for key in self._constants if is_point(key) and key not in kept]:
            del self._constants[key], self._spreads[key]
        self._unknown.keep_only(kept)

    def _forget_landmarks(self, known: Collection[int]) -> None:
        """Give up the landmarks that neither the keyframes that are left tell, nor a summary of what has left the graph, whose
        variables are ``known``; and sightings that wait for another."""
        self._new_landmarks = NewLandmarks()
        told = {key for k in self._keyframes for node in k.nodes for key in node.keys}
        for name, key in [(name, landmark_key(i)) for name, i in self._places.items()]:
            if key not in told and key not in known:
                del self._places[name], self._constants[key], self._spreads[key]

    def _placed(self, t: float) -> Array:
        """Where the robot was at ``t``, from the place that was found and the odometry since."""
        best = self._best()
        assert best is not None
        moved = self._motion.relative(self._motion.state(t), self._motion.state(best.t))
        return se2.compose(best.pose, se2.inverse(self._recalibrated(moved).delta))

    def _replay(self, measurements: list[Exteroceptive | Tick]) -> None:
        self._monitor.clear()
        self._camera.clear()
        if self._finder is not None:
            self._finder.start()
        for m in measurements:
            self._take(m)

    def _observed(self, t: float, seen: BearingRangeFactor, guess: Guess) -> None:
        self._relocalizer.add(self._motion.state(t), seen)
        if isinstance(self._monitor, TrackMonitor):
            self._monitor.add(t, seen, *guess)

    def _scanned(self, t: float, looks: Looks, update: TagUpdate) -> None:
        if self._finder is None or not isinstance(self._monitor, ScanMonitor):
            return
        self._monitor.add(t, update.surprise, update.variance)
        if self._monitor.suspicious_since is None:
            self._finder.rest()
        self._finder.add(self._motion.state(t), looks, update.evidence)

    @property
    def _doubted(self) -> bool:
        return self._monitor.suspicious_since is not None

    @abstractmethod
    def _begin_again(self, newest: Keyframe) -> None:
        """Solve the graph anew: keyframes were taken back, and ``newest`` was added."""
