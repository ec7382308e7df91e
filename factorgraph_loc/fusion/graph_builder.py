"""Graphs that take measurements: where keyframes stand, and what becomes a factor on them.

A keyframe stands at each stamp of landmarks or of an image, unless the one before is nearer than ``keyframe_interval``, and at
least every ``keyframe_max_interval``. What is seen between two keyframes, or arrives late, becomes a factor on the earlier one,
displaced by the odometry since.

Scans of RFID antennas come many a second and each tells little. Those from one keyframe to the next, half a second later, make one
factor, which enters the graph with the next keyframe; until then the newest pose is updated by them alone, as a filter would.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Hashable
from dataclasses import replace

import numpy as np

from factorgraph_loc.fusion.graph_parts import Addition, GraphSettings, Guess, Keyframe, TickAt
from factorgraph_loc.fusion.keyframes import KeyframeGraph
from factorgraph_loc.fusion.variables import CAMERA_KEY, ODOMETRY_KEY, SENSOR_KEY, Node, landmark_key, pose_key
from factorgraph_loc.model.measurement import Exteroceptive, Tick
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.sensors.camera.measurement import PixelSightings
from factorgraph_loc.sensors.camera.sensor import KnownPoints, Pixels, Predicted, pixel_update
from factorgraph_loc.sensors.landmarks import sensor as landmarks
from factorgraph_loc.sensors.landmarks.measurement import BearingRange
from factorgraph_loc.sensors.landmarks.pending import NewLandmarks
from factorgraph_loc.sensors.landmarks.sensor import KnownLandmarks
from factorgraph_loc.sensors.rfid.measurement import RfidScan
from factorgraph_loc.sensors.rfid.sensor import WaitingScans
from factorgraph_loc.slam.frame_pairs import FramePairs
from factorgraph_loc.slam.unknown_points import GraphView, UnknownPoints
from factors import se2
from factors.camera import model as reprojection
from factors.landmarks.factor import BearingRangeFactor
from factors.landmarks.model import TIME_OFFSET
from factors.motion import Increment, propagate
from factors.odometry.model import PARAMETERS
from factors.rfid.detection import Looks
from factors.rfid.factor import ROWS
from factors.rfid.update import TagUpdate
from factors.se2 import Array
from factors.update import robust_update

ITERATIONS_OF_GUESS = 1
KEYFRAME_INTERVAL, MAPPING_KEYFRAME_INTERVAL = 0.09, 0.5  # s
SCAN_KEYFRAME_INTERVAL = 0.45  # s between keyframes that stand there for scans


class MeasuringGraph(KeyframeGraph):
    """Builds the graph as measurements come; see the module."""

    def __init__(self, setup: Setup, settings: GraphSettings) -> None:
        super().__init__(setup, settings)
        self._landmarks = KnownLandmarks(setup, self.diagnostics, settings.landmarks, self._sensor_constants.indices)
        default = KEYFRAME_INTERVAL if settings.landmarks == "known" else MAPPING_KEYFRAME_INTERVAL
        self._interval = default if settings.keyframe_interval is None else settings.keyframe_interval
        self._points = KnownPoints(setup, self.diagnostics, self._camera_constants, settings.landmarks, self._motion)
        if settings.landmarks != "known" and self._points.model is not None:
            constants = self._camera_constants.indices
            self._unknown = UnknownPoints(self._points.model, self.diagnostics, constants)
        self._pixels_taken = -math.inf
        self._pairs: FramePairs | None = None
        if settings.visual_odometry and self._points.model is not None:
            self._pairs = FramePairs(self._points.model)
        self._scans = WaitingScans(setup, self.diagnostics)
        self._new_landmarks: NewLandmarks[tuple[int, BearingRangeFactor]] = NewLandmarks()

    def _take(self, m: Exteroceptive | Tick) -> None:
        self._anchor()
        if isinstance(m, Tick):
            self._pass_time(m.t)
            return
        self._t = max(self._t, m.t)
        if isinstance(m, RfidScan):
            self._scan(m)
        else:
            self._see(m)

    def _drop_late(self, m: Exteroceptive | Tick) -> None:
        if not isinstance(m, Tick):
            self.diagnostics.drop_late(m.modality, m.count)

    @abstractmethod
    def _extend(self, keyframe: Keyframe, addition: Addition, spread: Array) -> None:
        """Add a keyframe and what came with it, and bring pose, covariance and constants up to date.

        The guess of its pose in ``addition``, and its body-frame covariance ``spread`` (3, 3), come from an update of the one
        before.
        """

    @abstractmethod
    def _guess_of(self, keyframe: int) -> Guess:
        """The causal estimate of a keyframe."""

    @abstractmethod
    def _current(self, key: int) -> Array:
        """The newest estimate of a variable that is in the graph."""

    @abstractmethod
    def _refine(self, newest: Keyframe, guess: Guess) -> None:
        """Take over pose and covariance of the newest keyframe from scans that are not yet in the graph."""

    @abstractmethod
    def _scanned(self, t: float, looks: Looks, update: TagUpdate) -> None:
        """Antennas listened at ``t``; ``update``: what that changed."""

    @property
    @abstractmethod
    def _doubted(self) -> bool:
        """Whether the robot may be elsewhere."""

    def _odds_of_tags(self) -> Array:
        return self._scans.tags.states.odds

    @abstractmethod
    def _observed(self, t: float, seen: BearingRangeFactor, guess: Guess) -> None:
        """Landmarks of the map were seen at ``t`` from a keyframe whose pose is expected to be ``guess``."""

    def _pass_time(self, t: float) -> None:
        self._t = max(self._t, t)
        if t - self._keyframes[-1].t >= self._graph_settings.keyframe_max_interval:
            self._add_keyframe(t, None)
        before = self._keyframe_before(t)
        self._ticks.append(TickAt(t, before.index, self._motion.relative(before.odometry, self._motion.state(t))))

    def _see(self, m: BearingRange | Pixels) -> None:
        newest = self._keyframes[-1]
        # unknown points need keyframes of their own, whatever others stand there for scans
        due = self._unknown is not None and isinstance(m, Pixels) and m.t - self._pixels_taken >= self._interval
        if m.t - newest.t >= self._interval or (due and m.t > newest.t):
            self._add_keyframe(m.t, m)
            return
        before = self._keyframe_before(m.t)
        if not self._is_open(before.index):
            self._drop_late(m)
            return
        offset = self._since(before, m.t) if m.t > before.t else None
        addition = Addition(self._gather())
        here = (self._pose, self._covariance) if before is newest else None
        if isinstance(m, BearingRange):
            guess = self._sight(before, m, offset, here, addition)
        else:
            guess = self._spot(before, m, offset, here, addition)
        if addition.nodes:
            self._attach(before, addition, guess)

    def _scan(self, m: RfidScan) -> None:
        looks = self._scans.tags.looks(m)
        if looks is None:
            return
        if m.t - self._keyframes[-1].t >= SCAN_KEYFRAME_INTERVAL:
            self._add_keyframe(m.t, None)
        keyframe = self._keyframe_before(m.t)
        offset = self._since(keyframe, m.t).delta if m.t > keyframe.t else np.zeros(3)
        here = looks.moved(offset)
        if keyframe is not self._keyframes[-1]:
            self._add_late(keyframe, m, here)
            return
        predicted = self._pose, self._covariance
        update = self._scans.update(m, here, *predicted)
        if update is None:
            return
        self._take_over(update)
        self._scanned(m.t, looks, update)
        if not self._doubted:
            self._scans.tags.miss(m.t, here, *predicted)
        by_phases = self._scans.update_by_phases(m, self._places_at, self._pose, self._covariance)
        if by_phases is not None:
            self._take_over(by_phases)

    def _places_at(self, times: Array) -> Array:
        """Where the robot was at these times (R,), in the frame of the newest keyframe, (R, 3)."""
        changes = None
        if ODOMETRY_KEY in self._constants:
            changes = self._odometry_constants.full(self._constants[ODOMETRY_KEY], len(PARAMETERS))
        return self._motion.places(self._keyframes[-1].odometry, times, changes)

    def _take_over(self, update: TagUpdate) -> None:
        self._pose, self._covariance = update.pose, update.covariance
        self._refine(self._keyframes[-1], (update.pose, update.covariance))

    def _add_late(self, keyframe: Keyframe, m: RfidScan, looks: Looks) -> None:
        if not self._is_open(keyframe.index):
            self._drop_late(m)
            return
        guess = self._guess_of(keyframe.index)
        factors = self._scans.late_factors(m, looks, *guess)
        nodes = [Node((keyframe.key,), factor, ROWS) for factor in factors]
        keyframe.nodes += nodes
        self._attach(keyframe, Addition([*self._gather(), *nodes]), None)
        if not self._doubted:
            self._scans.tags.miss(m.t, looks, *guess)

    def _gather(self) -> list[Node]:
        """The scans from the newest keyframe, which are in no graph yet."""
        nodes = self._waiting_nodes()
        self._keyframes[-1].nodes += nodes
        self._scans.gather()
        return nodes

    def _waiting_nodes(self) -> list[Node]:
        key = self._keyframes[-1].key
        return [Node((key,), factor, ROWS) for factor in self._scans.waiting()]

    def _add_keyframe(self, t: float, m: BearingRange | Pixels | None) -> None:
        newest = self._keyframes[-1]
        odometry = self._motion.state(t)
        increment = self._motion.relative(newest.odometry, odometry)
        moved = self._recalibrated(increment)
        keyframe = Keyframe(newest.index + 1, t, odometry, increment)
        guess: Guess | None = (se2.compose(self._pose, moved.delta), propagate(self._covariance, moved))
        addition = Addition(self._gather())
        self._keyframes.append(keyframe)
        self._keyframe_times.append(t)
        if isinstance(m, BearingRange):
            guess = self._sight(keyframe, m, None, guess, addition)
        elif m is not None:
            guess = self._spot(keyframe, m, None, guess, addition)
            self._compare(keyframe, m, addition)
        assert guess is not None
        addition.values[keyframe.key] = guess[0]
        self._extend(keyframe, addition, guess[1])

    def _sight(
        self,
        keyframe: Keyframe,
        m: BearingRange,
        offset: Increment | None,
        guess: Guess | None,
        addition: Addition,
    ) -> Guess | None:
        """Turn a measurement into factors of ``keyframe``; returned is the guess of its pose, updated by them.

        The guess is where the graph linearises first, and what the robust weights are computed at. Without one (the keyframe is
        an older one) landmarks that are not yet in the graph stay out, and the innovation is that of its causal estimate.
        """
        twist = self._motion.twist(m.t) if TIME_OFFSET in self._sensor_constants.indices else None
        nodes: list[Node] = []
        seen: list[BearingRangeFactor] = []
        met: list[tuple[str, BearingRangeFactor]] = []
        shared = (SENSOR_KEY,) if self._sensor_constants.names else ()
        constants = [self._constants[key] for key in shared]
        known = self._landmarks.factor(m, offset, twist)
        if known is not None:
            nodes.append(Node((keyframe.key, *shared), known, 2 * len(known.points)))
            seen.append(known.fixed(constants, None))
        for name, factor in self._landmarks.others(m, offset, twist):
            if name not in self._places:
                met.append((name, factor))
                continue
            key = landmark_key(self._places[name])
            nodes.append(Node((keyframe.key, *shared, key), factor, 2))
            here = factor.fixed(constants, self._constants[key])
            seen.append(replace(here, point_covariances=self._spreads[key][None]))
        if guess is not None and known is not None:
            self._observed(m.t, known.fixed(constants, None), guess)
        if seen:
            factor = landmarks.together(seen)
            expected = self._guess_of(keyframe.index) if guess is None else guess
            update = robust_update(factor, *expected, ITERATIONS_OF_GUESS)
            self._landmarks.report(m.t, factor, update)
            if guess is not None:
                guess = se2.compose(guess[0], se2.exp(update.delta)), update.covariance
        if guess is not None:
            for name, factor in met:
                self._meet(name, factor, keyframe, guess, addition)
        keyframe.nodes += nodes
        addition.nodes += nodes
        return guess

    def _spot(
        self, keyframe: Keyframe, m: Pixels, offset: Increment | None, guess: Guess | None, addition: Addition
    ) -> Guess | None:
        """Turn what a camera saw into a factor of ``keyframe``; returned is the guess of its pose, updated by it. Without a guess
        the keyframe is an older one."""
        twist = self._motion.twist(m.t) if self._points.needs_twist else None
        shared = (CAMERA_KEY,) if self._camera_constants.names else ()
        constants = [self._constants[key] for key in shared]
        expected = self._guess_of(keyframe.index) if guess is None else guess
        predicted = Predicted(*expected, *constants, *(self._spreads[key] for key in shared))
        factor = self._points.factor(m, predicted, offset, twist)
        if factor is None:
            return guess if guess is None else self._spot_others(keyframe, m, guess, addition)
        node = Node((keyframe.key, *shared), factor, 2 * len(factor.points))
        keyframe.nodes.append(node)
        addition.nodes.append(node)
        update = pixel_update(factor, *expected, *constants, *(self._spreads[key] for key in shared))
        self._points.report(m.t, factor, update)
        if guess is None:
            return None
        guess = se2.compose(guess[0], se2.exp(update.delta[:3])), update.covariance[:3, :3]
        return self._spot_others(keyframe, m, guess, addition)

    def _spot_others(self, keyframe: Keyframe, m: Pixels, guess: Guess, addition: Addition) -> Guess:
        """Take in the points of an image that the map lacks; returned is the guess of the pose, placed by them."""
        if self._unknown is None or keyframe is not self._keyframes[-1] or m.t != keyframe.t:
            return guess
        self._pixels_taken = m.t
        rows = list(range(len(m.pixels)))
        if isinstance(m, PixelSightings):
            rows = [i for i in rows if m.points[i] not in self._points.map.index]
        else:
            used = set(self._points.used.tolist())
            rows = [i for i in rows if i not in used]
        shared = (CAMERA_KEY,) if self._camera_constants.names else ()
        changes = None
        if shared:
            changes = self._camera_constants.full(self._constants[CAMERA_KEY], len(reprojection.PARAMETERS))
        graph = GraphView(
            self._keyframes, self._constants, self._spreads, self._current, self._is_open, shared, changes
        )
        return self._unknown.take(m, rows, keyframe, guess, graph, addition)

    def _compare(self, keyframe: Keyframe, m: Pixels, addition: Addition) -> None:
        """What tracks of no other use tell of the motion since the image before."""
        if self._pairs is None:
            return
        if isinstance(m, PixelSightings):
            names: list[Hashable] = list(m.points)
            used = {i for i, name in enumerate(m.points) if name in self._points.map.index}
        else:
            names, used = m.tracks.tolist(), set(self._points.used.tolist())
        if self._unknown is not None:
            used |= {i for i, name in enumerate(names) if self._unknown.uses(name)}
        rows = [i for i in range(len(names)) if i not in used]
        before, predicted = self._pairs.previous(keyframe, self._keyframes), None
        if before is not None and self._is_open(before.index):
            predicted = self._recalibrated(self._motion.relative(before.odometry, keyframe.odometry))
        node = self._pairs.take(keyframe, [names[i] for i in rows], m.pixels[rows], predicted)
        if node is not None:
            keyframe.nodes.append(node)
            addition.nodes.append(node)

    def _meet(
        self, name: str, factor: BearingRangeFactor, keyframe: Keyframe, guess: Guess, addition: Addition
    ) -> None:
        """A landmark that is not in the graph: it comes in when an earlier sighting agrees, with both."""
        shared = (SENSOR_KEY,) if self._sensor_constants.names else ()
        point, (by_pose, *_), noise = factor.locate([guess[0], *(self._constants[key] for key in shared)])
        covariance = by_pose @ guess[1] @ by_pose.T + noise
        sighting = (keyframe.index, factor)
        self._new_landmarks, earlier = self._new_landmarks.propose(name, point, covariance, sighting)
        if earlier is None:
            return
        self._places[name] = 1 + max(self._places.values(), default=-1)
        key = landmark_key(self._places[name])
        self._constants[key], self._spreads[key] = point, covariance
        addition.values[key] = point
        for index, sighted in (earlier, sighting):
            if self._is_open(index):
                node = Node((pose_key(index), *shared, key), sighted, 2)
                self._keyframes[index].nodes.append(node)
                addition.nodes.append(node)
