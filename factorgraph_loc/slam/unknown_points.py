"""Points that the map lacks, as variables of a graph.

Their pixels enter the graph at keyframes only. Sightings are collected first (:mod:`.new_points`); once the point is determined
it becomes a variable, with all of them as factors. From then on its inlier pixels correct the newest keyframe and become factors
too. A track whose pixels are outliers :data:`STRIKES` times in a row is separated from the point.
"""

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from factorgraph_loc.fusion.graph.variables import Addition, Guess, Keyframe, Node, jumps, point_key, tilt_key
from factorgraph_loc.fusion.mapping import GraphView
from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.settings import NOTHING, Estimated
from factorgraph_loc.sensors.camera.known_points import ITERATIONS, SETTLED, Pixels, lifted
from factorgraph_loc.slam.image_times import ImageTimes
from factorgraph_loc.slam.local_bundle import bundled
from factorgraph_loc.slam.loop_closure import Image, LoopClosure, OldPoints
from factorgraph_loc.slam.moving_things import MovingThings
from factorgraph_loc.slam.new_points import FEWEST as FEWEST_SIGHTINGS
from factorgraph_loc.slam.new_points import KeyframeCamera, NewPoints, PointSighting, sightings_of
from factorgraph_loc.slam.point_looks import PointLooks
from factorgraph_loc.slam.refound_points import refound
from factorgraph_loc.slam.slipping import moved_since, unless_slipped
from factorgraph_loc.vision.consensus import FEWEST, GATE, CameraPose, Truths, agreeing
from factorgraph_loc.vision.frame import CameraFrame
from factorgraph_loc.vision.spread import spread_out
from factors import positive, se2
from factors.camera import model as reprojection
from factors.camera import update_kernels as pixel_kernels
from factors.camera.factor import ReprojectionFactor, image_update
from factors.camera.floor import TiltScale
from factors.camera.kernels import NEAREST
from factors.camera.model import CameraModel, recalibrated
from factors.camera.point import PointFactor, PointPrior
from factors.graph import VectorPriorFactor
from factors.se2 import Array

PER_KEYFRAME, WAITING = 40, 160  # maximum number of estimated points per keyframe, and of points waiting
STRIKES = 2
ANCHORED, SLACK = 4, 2.0  # points of the graph that determine a keyframe to so many pixels
LEVEL = np.zeros(2)  # no tilt
OPEN = 30.0  # m: weak prior of a point, about the size of a building
LOST = 10.0  # s for which a lost point is searched: after that, too many others in a building look like it
AGREED = 0.5  # fraction of inliers required of points not seen for longer: similar descriptors agree by chance
RECENT = 5.0  # s: the error of a point seen since is correlated with that of the track
REVISITED = 6  # features of points not seen for longer that are accepted together, whatever the others say
HORIZON, BUNDLE = 60, 8  # keyframes for which sightings are kept, and keyframes that are adjusted together


@dataclass
class _Point:
    """A point of the graph: when it was last seen, the information (3, 3) of its sightings for exact poses, and the number of
    consecutive outliers.
    """

    key: int
    last: float
    information: Array
    strikes: int = 0


@dataclass
class UnknownPoints:
    """The points of a graph by name, and those waiting. ``estimated``: camera constants that are variables."""

    model: CameraModel
    diagnostics: Diagnostics
    estimated: Estimated = NOTHING
    _points: dict[Hashable, _Point] = field(default_factory=dict)
    _astray: list[_Point] = field(default_factory=list)  # in the graph, but no longer seen under their name
    _names: dict[int, str] = field(default_factory=dict)  # by key, of all points that ever were in the graph
    _loops: LoopClosure = field(default_factory=LoopClosure)
    _distance_travelled: float = 0.0  # m
    _again_as: dict[Hashable, Hashable] = field(default_factory=dict)  # names of points that new tracks continue
    _anchored: dict[int, bool] = field(default_factory=dict)  # keyframes with sightings

    def __post_init__(self) -> None:
        self._new, self._looks = NewPoints(self.model), PointLooks(self.model)
        self._lens = reprojection.lens_of(self.model)
        self._floor, self._times = TiltScale.guessed(self.model.tilt), ImageTimes(self.estimated)

    def take(
        self,
        m: Pixels,
        rows: Sequence[int],
        keyframe: Keyframe,
        guess: Guess,
        graph: GraphView,
        addition: Addition,
        things: MovingThings,
    ) -> Guess:
        """Turn ``rows`` of what is seen from a new keyframe into factors and variables, and return its pose, corrected by the
        points.

        The covariance is not reduced: the points are as uncertain as the poses that observed them.
        """
        model, (index, times) = self.model, (keyframe.index, self._times)
        times.add(keyframe, graph)
        guess = times.at_image(index, guess, graph)
        if graph.constants is not None:
            model = recalibrated(model, self.estimated.full(graph.constants, len(reprojection.PARAMETERS)))
        # those that have been followed for longest come first
        rows = list(rows) if m.frame is None else sorted(rows, key=m.frame.tracks.__getitem__)
        if keyframe.from_previous is not None:
            self._distance_travelled += float(np.hypot(*keyframe.from_previous.delta[:2]))
        names = self._named(m, rows, lifted(model, *guess), graph)
        certain: set[int] = set()  # rows
        if m.frame is not None and self._loops.due(m.t):
            certain = self._revisited(
                model, Image(m.frame, keyframe, guess, self._distance_travelled), rows, names, graph
            )
        priority = [len(names) if name in self._points else self._new.count(name) for name in names]
        pixels = np.asarray(m.pixels[rows], dtype=float)
        chosen = spread_out(pixels, PER_KEYFRAME + WAITING, priority).tolist()
        rows, names, pixels = [rows[i] for i in chosen], [names[i] for i in chosen], pixels[chosen]
        sightings = sightings_of(self.model, keyframe.index, pixels)
        old = [i for i, name in enumerate(names) if name in self._points]
        old = [old[i] for i in spread_out(pixels[old], PER_KEYFRAME).tolist()]
        points = [self._points[names[i]] for i in old]
        known = np.array([rows[i] in certain for i in old], dtype=bool)
        named = m.names is not None
        guess, tilt, sigma, right = self._placed(model, points, pixels[old], keyframe, guess, graph, known, named=named)
        self._tilts(keyframe, tilt, sigma, graph, addition)
        if m.frame is not None:
            known_rows = [(rows[i], names[i], bool(agrees)) for i, agrees in zip(old, right, strict=True)]
            self._remember(m.frame, known_rows, keyframe.key, guess)
        for i, agrees in zip(old, right.tolist(), strict=True):
            self._again(names[i], sightings[i], bool(agrees), keyframe, guess[0], model, graph, addition)
        self._anchored[keyframe.index] = int(np.count_nonzero(right)) >= ANCHORED
        fresh = [i for i, name in enumerate(names) if name not in self._points]
        for i in fresh:
            self._new.add(names[i], sightings[i])
        self._new.forget(keyframe.index, things.moving())
        waiting = [n for i in fresh if self._new.count(n := names[i]) >= FEWEST_SIGHTINGS and things.trusts(n)]
        places, pose = self._places(keyframe, guess[0], waiting, graph, things)
        for name, found, seen in self._new.ready(waiting, places.get, PER_KEYFRAME - len(old)):
            key = point_key(len(self._names))
            self._names[key] = f"track{name}" if m.names is None else str(name)
            self._points[name] = _Point(key, keyframe.t, positive.inverse(found.covariance))
            if m.frame is not None:
                row = rows[names.index(name)]
                self._looks.keep(key, m.frame, row, self._distance_travelled, keyframe.key, guess)
            addition.values[key] = found.position
            graph.values[key], graph.spreads[key] = found.position, found.covariance
            prior = PointPrior.of(pose, found.position, OPEN)
            addition.hang(keyframe, Node((keyframe.key, key), prior, 3))
            for sighting in seen:
                self._hang(graph.keyframes[sighting.keyframe], key, sighting, graph, addition)
        return times.at_stamp(index, (pose, guess[1]), graph)

    def _named(self, m: Pixels, rows: Sequence[int], camera: CameraPose, graph: GraphView) -> list[Hashable]:
        """The name of each row: of a feature, the number of its track, or of the track that its point was added with."""
        if m.frame is None:
            return [m.names[i] for i in rows]
        tracks = m.frame.tracks[list(rows)].tolist()
        gone = self._points.keys() - set(tracks)  # the track that a point was added with may itself return
        self._again_as = {track: name for track, name in self._again_as.items() if name in gone}
        names: list[Hashable] = [self._again_as.get(track, track) for track in tracks]
        seen = set(names)
        lately = [name for name, point in self._points.items() if m.t - point.last < LOST]
        lost = [name for name in lately if name not in seen and self._points[name].key in self._looks]
        free = [i for i, name in zip(rows, names, strict=True) if name not in self._points]
        positions = np.array([graph.values[self._points[name].key] for name in lost]).reshape(-1, 3)
        place = {row: i for i, row in enumerate(rows)}
        for which, row in refound(
            self.model,
            camera,
            positions,
            [self._looks[self._points[name].key].descriptor for name in lost],
            m.frame,
            free,
        ):
            track = names[place[row]]
            if self._new.count(track) < FEWEST_SIGHTINGS:
                names[place[row]] = lost[which]
                self._follow(track, lost[which])
        return names

    def _follow(self, track: Hashable, name: Hashable) -> None:
        """Assign the point ``name`` to ``track`` and to no other."""
        self._again_as = {other: of for other, of in self._again_as.items() if of != name}
        self._again_as[track] = name

    def _revisited(
        self, model: CameraModel, image: Image, rows: Sequence[int], names: list[Hashable], graph: GraphView
    ) -> set[int]:
        """The ``rows`` of an image that certainly show points last seen long ago; ``names`` are updated to those of the points."""
        t = image.keyframe.t
        old = [name for name, point in self._points.items() if t - point.last >= LOST and point.key in self._looks]
        if not old:
            return set()
        points = [self._points[name] for name in old]
        keys = [point.key for point in points]
        covariances = positive.inverse(np.array([point.information for point in points]))
        positions = np.array([graph.values[key] for key in keys])
        seen = self._looks.map_of([str(name) for name in old], keys, positions, covariances)
        ways = np.array([self._looks[key].way for key in keys])
        revisit = self._loops.look(model, image, OldPoints(seen, keys, ways), graph.current)
        if revisit is None:
            return set()
        certain: set[int] = set()
        place, named = {row: i for i, row in enumerate(rows)}, set(names)
        for which, row in zip(revisit.points.tolist(), revisit.features.tolist(), strict=True):
            if row in place and old[which] not in named:
                certain.add(row)
                names[place[row]] = old[which]
                self._follow(int(image.frame.tracks[row]), old[which])
        return certain

    def _remember(self, m: CameraFrame, seen: Sequence[tuple[int, Hashable, bool]], key: int, guess: Guess) -> None:
        """Store the views of points from the keyframe ``key``; a track that was wrongly assigned to one is separated."""
        for row, name, agrees in seen:
            track = int(m.tracks[row])
            if agrees:
                point = self._points[name].key
                self._looks.keep(point, m, row, self._distance_travelled, key, guess)
            elif self._again_as.pop(track, None) is not None:
                self._points[name].strikes -= 1  # not the fault of the point

    def uses(self, name: Hashable) -> bool:
        """Whether ``name`` is a point of the graph, or waiting to become one."""
        return name in self._points or name in self._again_as or self._new.count(name) > 0

    def leave(self, t: float) -> list[int]:
        """Remove the points last seen before ``t``, and return their keys."""
        gone = [point.key for point in (*self._points.values(), *self._astray) if point.last < t]
        self._points = {name: point for name, point in self._points.items() if point.last >= t}
        self._astray = [point for point in self._astray if point.last >= t]
        return gone

    def keep_only(self, keys: set[int]) -> None:
        """Remove the points of the graph without these ``keys``, and all waiting ones."""
        self._points = {name: point for name, point in self._points.items() if point.key in keys}
        self._new, self._loops = NewPoints(self.model), LoopClosure()

    def learnt(self, values: Mapping[int, Array], spreads: Mapping[int, Array]) -> PointMap | None:
        """All points that were ever in the graph, under the first of their keys; features with some views. ``values`` and
        ``spreads`` are of keyframes too."""
        keys: dict[str, int] = {}
        for key, name in self._names.items():
            if key in values:
                keys.setdefault(name, key)
        if not keys:
            return None
        positions, covariances = (np.array([part[key] for key in keys.values()]) for part in (values, spreads))
        points = PointMap.of(tuple(keys), positions, covariances)
        return self._looks.settled(points, tuple(keys.values()), values, spreads)

    def _tilts(self, keyframe: Keyframe, tilt: Array, sigma: float, graph: GraphView, addition: Addition) -> None:
        """Make a variable of the ``tilt`` of the robot at a new keyframe, of a floor that is level to ``sigma`` [rad]."""
        key = tilt_key(keyframe.index)
        if key in graph.values:
            return
        addition.values[key] = graph.values[key] = tilt
        sigmas = np.full(2, sigma)
        native = gtsam.PriorFactorVector(key, LEVEL, gtsam.noiseModel.Diagonal.Sigmas(sigmas))
        addition.hang(keyframe, Node((key,), VectorPriorFactor(LEVEL, sigmas), 2, native))

    def _placed(
        self,
        model: CameraModel,
        points: list[_Point],
        pixels: Array,
        keyframe: Keyframe,
        guess: Guess,
        graph: GraphView,
        known: Truths,
        *,
        named: bool,
    ) -> tuple[Guess, Array, float, Truths]:
        """The pose corrected by points of the graph, the tilt (2,) of the robot that they tell with its prior standard deviation,
        and which of them are inliers.

        Points not seen for long need to agree with each other, but not with the rest, as the track has drifted since. So few points
        that they cannot confirm each other are used only if they have names: where the pose is uncertain a wrong one agrees, too.
        """
        sigma = self._floor.sigma
        if not points:
            return guess, LEVEL, sigma, np.zeros(0, dtype=bool)
        positions = np.array([graph.current(point.key) for point in points])
        spreads = positive.inverse(np.array([point.information for point in points]))
        camera = lifted(model, *guess)
        _, _, by_point = reprojection.linearize_in_space(model, camera.position, camera.rotation, positions)
        noise = (model.sigma**2 + SLACK**2) * np.eye(2) + by_point @ spreads @ by_point.transpose(0, 2, 1)
        recent = np.array([keyframe.t - point.last < RECENT for point in points])
        level, seen = replace(model, tilt=sigma), (positions[recent], pixels[recent], spreads[recent], noise[recent])
        guess = unless_slipped(level, keyframe, guess, graph.slip, seen)
        since = moved_since(graph.keyframes, keyframe, keyframe.t - RECENT, HORIZON)
        near = guess if since is None else (guess[0], since)  # of a pose among the points that were seen since
        camera, right, placed, tilt = lifted(model, *guess), known.copy(), guess, LEVEL
        # a name needs one other to confirm it
        revisited = max(2 if named else REVISITED, math.ceil(AGREED * np.count_nonzero(~recent & ~known)))
        for which, enough in ((recent, FEWEST), (~recent & ~known, revisited)):
            agrees = np.zeros(len(points), dtype=bool)
            if which.any():
                agrees[which] = agreeing(model, camera, positions[which], pixels[which], noise[which])
            if np.count_nonzero(agrees) >= enough and placed is guess:
                factor = ReprojectionFactor(model, positions[agrees], pixels[agrees], point_covariances=spreads[agrees])
                leaning = pixel_kernels.leaning(factor.packed(), *guess)
                floor, unlevel = self._floor.learnt(*leaning, model.tilt)
                factor = replace(factor, model=replace(model, tilt=unlevel))
                update = image_update(factor, *guess, ITERATIONS, SETTLED)
                pose = se2.compose(guess[0], se2.exp(update.delta))
                if which is recent and jumps(near, pose):  # a few wrong points agree, too
                    continue
                placed, self._floor, sigma = (pose, guess[1]), floor, unlevel
                tilt = sigma * factor.levelled([pose])[1]
            elif np.count_nonzero(agrees) < enough and placed is not guess:
                seen_from = reprojection.camera_pose(model, placed[0], tilt)
                error = reprojection.linearize_in_space(model, *seen_from, positions)[0] - pixels
                agrees &= positive.squared(error, noise) < GATE
            elif np.count_nonzero(agrees) < enough:
                agrees &= recent & named
            right |= agrees
        return placed, tilt, sigma, right

    def _again(
        self,
        name: Hashable,
        sighting: PointSighting,
        agrees: bool,
        keyframe: Keyframe,
        pose: Array,
        model: CameraModel,
        graph: GraphView,
        addition: Addition,
    ) -> None:
        """Add an observation of a point that is in the graph already."""
        point = self._points[name]
        if not agrees:
            self.diagnostics.reject("camera: does not agree with the others")
            point.strikes += 1
            if point.strikes >= STRIKES:
                self._astray.append(self._points.pop(name))
            return
        position = graph.current(point.key)
        _, depth = reprojection.predict(model, pose, position[None])
        if depth[0] < NEAREST:
            return
        point.strikes, point.last = 0, keyframe.t
        _, _, by_point, _ = reprojection.linearize(model, pose, position[None])
        point.information += by_point[0].T @ by_point[0] / model.sigma**2
        self._hang(keyframe, point.key, sighting, graph, addition)

    def _hang(self, keyframe: Keyframe, key: int, seen: PointSighting, graph: GraphView, addition: Addition) -> None:
        keys = (keyframe.key, *graph.shared, tilt_key(keyframe.index), key)
        twist = self._times.twists.get(keyframe.index)
        factor = PointFactor(self.model, self._lens, seen.pixel, self.estimated.indices, twist)
        addition.hang(keyframe, Node(keys, factor, 2))

    def _places(
        self, newest: Keyframe, pose: Array, names: Sequence[Hashable], graph: GraphView, things: MovingThings
    ) -> tuple[dict[int, KeyframeCamera], Array]:
        """The camera poses of the keyframes that see waiting points, by number, with the pixel errors they cause in the newest
        one; and the pose (3,) of the newest keyframe.

        Relative poses come from points of the graph where these determine both keyframes, otherwise from odometry, or from local
        bundle adjustment where possible.
        """
        slacks = self._slacks(newest, graph)
        if not self._anchored[newest.index]:
            last = [index for index in sorted(slacks)[-BUNDLE:] if graph.is_open(index)]
            poses = [pose if i == newest.index else self._times.pose(i, graph) for i in last]
            level = replace(self.model, tilt=self._floor.sigma)
            found = bundled(level, [graph.keyframes[i] for i in last], poses, self._new.those(things.trusts))
            if found is not None:
                placed = zip(last[-len(found) :], found, strict=True)
                return {i: KeyframeCamera.of(self.model, p, SLACK, t) for i, (p, t) in placed}, found[-1][0]
        tilt = graph.values[tilt_key(newest.index)]
        places = {newest.index: KeyframeCamera.of(self.model, pose, slacks[newest.index], tilt)}
        for i in {s.keyframe for name in names for s in self._new.waiting()[name]}:
            if i not in places and i in slacks and graph.is_open(i):
                there, tilt = self._times.pose(i, graph), graph.values[tilt_key(i)]
                places[i] = KeyframeCamera.of(self.model, there, slacks[i], tilt)
        return places, pose

    def _slacks(self, newest: Keyframe, graph: GraphView) -> dict[int, float]:
        """The pixel error of the last keyframes relative to the newest."""
        slacks: dict[int, float] = {}
        to_anchor = since = 0.0  # variance of the rotation from the newest to the first anchored keyframe, and since
        reached = False
        for index in range(newest.index, max(-1, newest.index - HORIZON), -1):
            if self._anchored.get(index, False):
                reached, since = True, 0.0
            slacks[index] = math.hypot(SLACK, self.model.fx * math.sqrt(to_anchor + since))
            step = graph.keyframes[index].from_previous
            if step is None:
                break
            variance = float(step.covariance[2, 2])
            to_anchor, since = (to_anchor, since + variance) if reached else (to_anchor + variance, since)
        return slacks
