"""Points that the map lacks, as variables of a factor graph.

Their pixels are added to the graph at keyframes only. The sightings of a point are collected first
(:mod:`.new_points`). Once they determine the point, it becomes a variable, and each of its sightings becomes a factor.
From then on the inlier pixels of the point correct the newest keyframe and become factors too. If a track is an outlier
:data:`STRIKES` times in a row, it is no longer used for the point.
"""

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from factorgraph_loc.fusion.graph.graph import Addition, Graph, Guess, Keyframe, Mapper, Node, jumps
from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.settings import NOTHING, Estimated
from factorgraph_loc.sensors.camera.known_points import ITERATIONS, SETTLED, lifted
from factorgraph_loc.sensors.camera.measurement import Pixels
from factorgraph_loc.slam.keyframe_cameras import HORIZON, SLACK, KeyframeCameras
from factorgraph_loc.slam.loop_closure import Image, LoopClosure, OldPoints
from factorgraph_loc.slam.moving_things import MovingThings
from factorgraph_loc.slam.new_points import FEWEST as FEWEST_SIGHTINGS
from factorgraph_loc.slam.new_points import ChosenSightings, NewPoints, PointSighting, sightings_of
from factorgraph_loc.slam.point_views import PointViews
from factorgraph_loc.slam.slipping import moved_since, unless_slipped
from factorgraph_loc.vision.consensus import FEWEST, GATE, CameraPose, Truths, agreeing
from factorgraph_loc.vision.frame import CameraFrame
from factorgraph_loc.vision.keypoints import spread_out
from factors import positive, se2
from factors.camera import model as reprojection
from factors.camera import update_kernels as pixel_kernels
from factors.camera.factor import ReprojectionFactor, image_update
from factors.camera.kernels import NEAREST
from factors.camera.model import CameraModel, TiltScale, recalibrated
from factors.camera.point import PointFactor, PointPrior
from factors.graph import VectorPriorFactor, point_key, tilt_key
from factors.se2 import Array

# largest numbers of points that are used per keyframe: of the graph, and not yet in the graph
PER_KEYFRAME, MOST_WAITING = 40, 160
STRIKES = 2  # consecutive outliers
LEVEL = np.zeros(2)  # no tilt
PRIOR_SIGMA = 30.0  # m: weak prior of a point, about the size of a building
SEARCH_TIME = 10.0  # s: time for which a lost point is searched. Later, too many other points resemble it.
RECENT = 5.0  # s: the error of a point observed within this time is correlated with the error of the robot's pose
LEAST_INLIERS = 0.5  # least fraction of inliers among old points, because descriptors may agree by chance
REVISITED = 6  # this many inliers among old points are accepted, even if points observed recently disagree


@dataclass
class _Point:
    """A point of the graph. ``key``: its variable. ``last`` [s]: the time of its last observation. ``strikes``: the
    number of consecutive outliers. ``information`` (3, 3): the position's inverse covariance for exact camera poses."""

    key: int
    last: float
    information: Array
    name: str = ""
    strikes: int = 0


@dataclass(frozen=True)
class _NewImage:
    """The image ``m`` of a new keyframe. ``addition``: receives new factors and variables of ``graph``. ``model``: the
    camera, with the current estimates of its constants."""

    m: Pixels
    keyframe: Keyframe
    graph: Graph
    addition: Addition
    model: CameraModel


class UnknownPoints(Mapper):
    """Adds the points of images to a graph as variables. ``estimated``: which constants of the camera the graph
    estimates."""

    def __init__(self, model: CameraModel, diagnostics: Diagnostics, estimated: Estimated = NOTHING) -> None:
        self.model, self.diagnostics, self.estimated = model, diagnostics, estimated
        self._lens = reprojection.lens_of(model)
        self._floor = TiltScale.guessed(model.tilt)
        self._points: dict[Hashable, _Point] = {}
        self._astray: list[_Point] = []  # points of the graph whose tracks are no longer used
        self._gone: list[_Point] = []  # points that were removed from the graph
        self._count = 0  # number of points that were ever added to the graph
        self._new, self._views = NewPoints(model), PointViews(model)
        self._cameras = KeyframeCameras(model, estimated)
        self._loops = LoopClosure()
        self._distance_travelled = 0.0  # m
        # the names of points by feature track, for tracks that are not the first track of their point
        self._names_by_track: dict[Hashable, Hashable] = {}

    def take_rows(
        self,
        m: Pixels,
        rows: Sequence[int],
        keyframe: Keyframe,
        guess: Guess,
        graph: Graph,
        addition: Addition,
        movers: MovingThings,
    ) -> Guess:
        """Add ``rows`` of the image ``m`` of a new keyframe to the graph. Returns ``guess``, with the pose corrected by
        points. Its covariance is not reduced, because the points are as uncertain as the poses that observed them.
        ``addition``: receives the new factors and variables. ``movers``: the feature tracks on moving objects."""
        model = self.model
        constants = graph.mapped_constants
        if constants is not None:
            model = recalibrated(model, self.estimated.full(graph.values[constants], len(reprojection.PARAMETERS)))
        image = _NewImage(m, keyframe, graph, addition, model)
        self._cameras.add(keyframe, graph)
        guess = self._cameras.at_image(keyframe.index, guess, graph)
        if keyframe.from_previous is not None:
            self._distance_travelled += float(np.hypot(*keyframe.from_previous.delta[:2]))
        # the longest tracks come first
        rows = list(rows) if m.frame is None else sorted(rows, key=m.frame.tracks.__getitem__)
        names = self._names_of(m, rows, lifted(model, *guess), graph)
        certain = self._revisited(image, guess, rows, names)
        chosen = self._chosen(image, rows, names)
        guess, count = self._observe_points(image, guess, chosen, certain)
        pose = self._add_points(image, guess, chosen, PER_KEYFRAME - count, movers)
        return self._cameras.at_stamp(keyframe.index, (pose, guess[1]), graph)

    def _chosen(self, image: _NewImage, rows: Sequence[int], names: Sequence[Hashable]) -> ChosenSightings:
        """Return the observations of some of the ``rows`` of the image, distributed over the whole image. ``names``:
        the name of each row's point."""
        priority = [len(names) if name in self._points else self._new.count(name) for name in names]
        pixels = np.asarray(image.m.pixels[list(rows)], dtype=float)
        chosen = spread_out(pixels, PER_KEYFRAME + MOST_WAITING, priority).tolist()
        pixels = pixels[chosen]
        sightings = sightings_of(self.model, image.keyframe.index, pixels)
        return ChosenSightings([rows[i] for i in chosen], [names[i] for i in chosen], pixels, sightings)

    def _observe_points(
        self, image: _NewImage, guess: Guess, chosen: ChosenSightings, certain: set[int]
    ) -> tuple[Guess, int]:
        """Add the observations ``chosen`` of points that the graph contains. Returns ``guess`` with the pose corrected
        by these points, and the number of points. ``certain``: the rows of points that a loop closure recognized."""
        m, keyframe = image.m, image.keyframe
        old = [i for i, name in enumerate(chosen.names) if name in self._points]
        old = [old[i] for i in spread_out(chosen.pixels[old], PER_KEYFRAME).tolist()]
        names = [chosen.names[i] for i in old]
        known = np.array([chosen.rows[i] in certain for i in old], dtype=bool)
        points = [self._points[name] for name in names]
        guess, tilt, sigma, right = self._corrected(image, points, chosen.pixels[old], guess, known)
        self._add_tilt(image, tilt, sigma)
        if m.frame is not None:
            self._store_views(m.frame, [chosen.rows[i] for i in old], names, right, keyframe.key, guess)
        for i, agrees in zip(old, right.tolist(), strict=True):
            self._add_observation(image, chosen.names[i], chosen.sightings[i], agrees, guess[0])
        self._cameras.anchor(keyframe, int(np.count_nonzero(right)))
        return guess, len(old)

    def _add_points(
        self, image: _NewImage, guess: Guess, chosen: ChosenSightings, most: int, movers: MovingThings
    ) -> Array:
        """Collect observations of points not in the graph, and add up to ``most`` triangulated points to the graph.
        Returns the pose (3,) of the keyframe, adjusted together with the new points if the graph's points do not
        determine it. ``movers``: the tracks on moving objects."""
        m, keyframe, graph, addition = image.m, image.keyframe, image.graph, image.addition
        fresh = [i for i, name in enumerate(chosen.names) if name not in self._points]
        for i in fresh:
            self._new.add(chosen.names[i], chosen.sightings[i])
        self._new.forget(keyframe.index, movers.moving)
        waiting = [
            n for i in fresh if self._new.count(n := chosen.names[i]) >= FEWEST_SIGHTINGS and movers.is_static(n)
        ]
        bundle = self._cameras.bundled(keyframe, guess[0], self._new.select(movers.is_static), self._floor.sigma, graph)
        cameras, pose = bundle or (
            self._cameras.cameras(keyframe, guess[0], waiting, self._new.waiting, graph),
            guess[0],
        )
        for name, point, sightings in self._new.ready(waiting, cameras.get, most):
            key, label = point_key(self._count), f"track{name}" if m.names is None else str(name)
            self._count += 1
            self._points[name] = _Point(key, keyframe.t, positive.inverse(point.covariance), label)
            if m.frame is not None:
                row = chosen.rows[chosen.names.index(name)]
                self._views.keep(key, m.frame, row, self._distance_travelled, keyframe.key, guess)
            addition.values[key] = point.position
            graph.values[key], graph.covariances[key] = point.position, point.covariance
            prior = PointPrior.of(pose, point.position, PRIOR_SIGMA)
            addition.hang(keyframe, Node((keyframe.key, key), prior, 3))
            for sighting in sightings:
                self._add_factor(image, graph.keyframes[sighting.keyframe], key, sighting)
        return pose

    def _names_of(self, m: Pixels, rows: Sequence[int], camera: CameraPose, graph: Graph) -> list[Hashable]:
        """Return the name of the point in each of the ``rows`` of the image ``m``. For a feature, this is the
        identifier of the track that first observed its point. Points with a lost track are searched in the image, seen
        from ``camera``, and keep their name."""
        if m.frame is None:
            return [m.names[i] for i in rows]
        tracks = m.frame.tracks[list(rows)].tolist()
        gone = self._points.keys() - set(tracks)  # points that are not visible in the track of their name
        self._names_by_track = {track: name for track, name in self._names_by_track.items() if name in gone}
        names: list[Hashable] = [self._names_by_track.get(track, track) for track in tracks]
        assigned = set(names)
        lately = [name for name, point in self._points.items() if m.t - point.last < SEARCH_TIME]
        lost = [name for name in lately if name not in assigned and self._points[name].key in self._views]
        free = [i for i, name in zip(rows, names, strict=True) if name not in self._points]
        keys = [self._points[name].key for name in lost]
        positions = np.array([graph.values[key] for key in keys]).reshape(-1, 3)
        place = {row: i for i, row in enumerate(rows)}
        for which, row in self._views.refound(camera, keys, positions, m.frame, free):
            track = names[place[row]]
            if self._new.count(track) < FEWEST_SIGHTINGS:
                names[place[row]] = lost[which]
                self._follow(track, lost[which])
        return names

    def _follow(self, track: Hashable, name: Hashable) -> None:
        """Store that the feature track ``track`` observes the point ``name``, and that no other track does."""
        self._names_by_track = {new_track: of for new_track, of in self._names_by_track.items() if of != name}
        self._names_by_track[track] = name

    def _revisited(self, image: _NewImage, guess: Guess, rows: Sequence[int], names: list[Hashable]) -> set[int]:
        """Return the set of ``rows`` with points that were last observed long ago (loop closure). Replaces the names of
        these rows in ``names``. The set is empty if the image closes no loop."""
        frame, t, graph = image.m.frame, image.keyframe.t, image.graph
        if frame is None or not self._loops.is_due(image.m.t):
            return set()
        old = [
            name for name, point in self._points.items() if t - point.last >= SEARCH_TIME and point.key in self._views
        ]
        if not old:
            return set()
        points = [self._points[name] for name in old]
        keys = [point.key for point in points]
        covariances = positive.inverse(np.array([point.information for point in points]))
        positions = np.array([graph.values[key] for key in keys])
        old_map = self._views.map_of([str(name) for name in old], keys, positions, covariances)
        travelled = np.array([self._views[key].travelled for key in keys])
        current = Image(frame, image.keyframe, guess, self._distance_travelled)
        revisit = self._loops.compare(image.model, current, OldPoints(old_map, keys, travelled), graph.current)
        if revisit is None:
            return set()
        certain: set[int] = set()
        place, named = {row: i for i, row in enumerate(rows)}, set(names)
        for which, row in zip(revisit.points.tolist(), revisit.features.tolist(), strict=True):
            if row in place and old[which] not in named:
                certain.add(row)
                names[place[row]] = old[which]
                self._follow(int(frame.tracks[row]), old[which])
        return certain

    def _store_views(
        self,
        frame: CameraFrame,
        rows: Sequence[int],
        names: Sequence[Hashable],
        right: Truths,
        keyframe: int,
        guess: Guess,
    ) -> None:
        """Store the views of the points ``names`` in the ``rows`` of a frame. ``right``: mask of the inliers; only
        these are stored. ``keyframe``, ``guess``: key and estimate of the keyframe's pose. The feature track of an
        outlier is separated from the point if another track observed the point first."""
        for row, name, agrees in zip(rows, names, right.tolist(), strict=True):
            if agrees:
                point = self._points[name].key
                self._views.keep(point, frame, row, self._distance_travelled, keyframe, guess)
            elif self._names_by_track.pop(int(frame.tracks[row]), None) is not None:
                self._points[name].strikes -= 1  # the track was wrong: this outlier does not count

    def leave(self, t: float) -> list[int]:
        """Remove from the graph the points last observed before the time ``t`` [s]. Returns the keys of these
        points."""
        gone = [point for point in (*self._points.values(), *self._astray) if point.last < t]
        self._points = {name: point for name, point in self._points.items() if point.last >= t}
        self._astray = [point for point in self._astray if point.last >= t]
        self._gone += gone
        return [point.key for point in gone]

    def keep_only(self, keys: set[int]) -> None:
        """Delete all points whose key is not in ``keys``, and all observations of points that are not in the graph."""
        self._views.forget({point.key for point in (*self._points.values(), *self._astray)} - keys)
        self._points = {name: point for name, point in self._points.items() if point.key in keys}
        self._astray = [point for point in self._astray if point.key in keys]
        self._new, self._loops = NewPoints(self.model), LoopClosure()

    def forget(self, first: Keyframe) -> list[int]:
        """Delete the data of keyframes before ``first``. Also delete the points that were removed from the graph and
        last observed before ``first``, and return their keys."""
        forgotten = [point.key for point in self._gone if point.last < first.t]
        self._gone = [point for point in self._gone if point.last >= first.t]
        self._views.forget(forgotten)
        self._cameras.forget(first.index)
        return forgotten

    def learnt(self, values: Mapping[int, Array], covariances: Mapping[int, Array]) -> PointMap | None:
        """Return a map of all stored points, including points removed from the graph. Returns None if there are none.
        ``values``, ``covariances``: the estimates and covariances of points and keyframes, by key."""
        keys: dict[str, int] = {}
        for point in sorted((*self._points.values(), *self._astray, *self._gone), key=lambda point: point.key):
            if point.key in values:
                keys.setdefault(point.name, point.key)
        if not keys:
            return None
        positions, of_points = (np.array([part[key] for key in keys.values()]) for part in (values, covariances))
        points = PointMap.of(tuple(keys), positions, of_points)
        return self._views.settled(points, tuple(keys.values()), values, covariances)

    def _add_tilt(self, image: _NewImage, tilt: Array, sigma: float) -> None:
        """Add the robot's ``tilt`` (2,) at the keyframe of ``image`` as a variable, with a prior of mean zero and
        standard deviation ``sigma`` [rad]."""
        keyframe, graph = image.keyframe, image.graph
        key = tilt_key(keyframe.index)
        if key in graph.values:
            return
        image.addition.values[key] = graph.values[key] = tilt
        sigmas = np.full(2, sigma)
        native = gtsam.PriorFactorVector(key, LEVEL, gtsam.noiseModel.Diagonal.Sigmas(sigmas))
        image.addition.hang(keyframe, Node((key,), VectorPriorFactor(LEVEL, sigmas), 2, native))

    def _corrected(
        self, image: _NewImage, points: list[_Point], pixels: Array, guess: Guess, known: Truths
    ) -> tuple[Guess, Array, float, Truths]:
        """Return ``guess`` with the pose corrected by ``points`` of the graph that are observed at ``pixels``. Also
        return the tilt (2,) of the robot, the prior standard deviation of the tilt, and a mask of the inliers.
        ``known``: mask of points recognized by a loop closure, which are inliers."""
        model, keyframe, graph, named = image.model, image.keyframe, image.graph, image.m.names is not None
        sigma = self._floor.sigma
        if not points:
            return guess, LEVEL, sigma, np.zeros(0, dtype=bool)
        positions = np.array([graph.current(point.key) for point in points])
        covariances = positive.inverse(np.array([point.information for point in points]))
        camera = lifted(model, *guess)
        _, _, by_point = reprojection.linearize_in_space(model, camera.position, camera.rotation, positions)
        noise = (model.sigma**2 + SLACK**2) * np.eye(2) + by_point @ covariances @ by_point.transpose(0, 2, 1)
        recent = np.array([keyframe.t - point.last < RECENT for point in points])
        observed = positions[recent], pixels[recent], covariances[recent], noise[recent]
        guess = unless_slipped(replace(model, tilt=sigma), keyframe, guess, graph.motion.slip, observed)
        since = moved_since(graph.keyframes, keyframe, keyframe.t - RECENT, HORIZON)
        near = (
            guess if since is None else (guess[0], since)
        )  # with the covariance of the odometry of the last RECENT seconds
        camera, right, placed, tilt = lifted(model, *guess), known.copy(), guess, LEVEL
        # a named point needs one other point that confirms it
        revisited = max(2 if named else REVISITED, math.ceil(LEAST_INLIERS * np.count_nonzero(~recent & ~known)))
        for which, enough in ((recent, FEWEST), (~recent & ~known, revisited)):
            agrees = np.zeros(len(points), dtype=bool)
            if which.any():
                agrees[which] = agreeing(model, camera, positions[which], pixels[which], noise[which])
            if np.count_nonzero(agrees) >= enough and placed is guess:
                factor = ReprojectionFactor(
                    model, positions[agrees], pixels[agrees], point_covariances=covariances[agrees]
                )
                leaning = pixel_kernels.leaning(factor.packed(), *guess)
                floor, unlevel = self._floor.learnt(*leaning, model.tilt)
                factor = replace(factor, model=replace(model, tilt=unlevel))
                update = image_update(factor, *guess, ITERATIONS, SETTLED)
                pose = se2.compose(guess[0], se2.exp(update.delta))
                if which is recent and jumps(near, pose):  # a few wrong points may agree by chance
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

    def _add_observation(
        self, image: _NewImage, name: Hashable, sighting: PointSighting, agrees: bool, pose: Array
    ) -> None:
        """Add an observation of the point ``name`` from ``pose`` (3,) to the graph. If ``agrees`` is False, count an
        outlier instead."""
        point = self._points[name]
        if not agrees:
            self.diagnostics.reject("camera: point disagrees with the other points of the image")
            point.strikes += 1
            if point.strikes >= STRIKES:
                self._astray.append(self._points.pop(name))
            return
        position = image.graph.current(point.key)
        _, depth = reprojection.predict(image.model, pose, position[None])
        if depth[0] < NEAREST:
            return
        point.strikes, point.last = 0, image.keyframe.t
        _, _, by_point, _ = reprojection.linearize(image.model, pose, position[None])
        point.information += by_point[0].T @ by_point[0] / image.model.sigma**2
        self._add_factor(image, image.keyframe, point.key, sighting)

    def _add_factor(self, image: _NewImage, keyframe: Keyframe, key: int, sighting: PointSighting) -> None:
        """Add the factor of a ``sighting`` of the point ``key`` from ``keyframe`` to the graph of ``image``."""
        constants = image.graph.mapped_constants
        keys = (keyframe.key, *(() if constants is None else (constants,)), tilt_key(keyframe.index), key)
        twist = self._cameras.twists.get(keyframe.index)
        factor = PointFactor(self.model, self._lens, sighting.pixel, self.estimated.indices, twist)
        image.addition.hang(keyframe, Node(keys, factor, 2))
