"""Points that the map lacks, as variables of a graph.

Pixels of one enter the graph at keyframes alone. First its sightings wait (:mod:`.new_points`); with its place it becomes a
variable, with all of them as factors. Then its pixels place the newest keyframe, those that agree with the others, and become
factors too. A point whose pixels disagree :data:`STRIKES` times in a row is another one from then on: whoever followed it went
astray.
"""

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np

from factorgraph_loc.fusion.graph_parts import Addition, Guess, Keyframe
from factorgraph_loc.fusion.mapping import GraphView
from factorgraph_loc.fusion.variables import Node, point_key
from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.variable import NOTHING, Estimated
from factorgraph_loc.sensors.camera.sensor import ITERATIONS, SETTLED, Pixels, lifted
from factorgraph_loc.slam.local_bundle import bundled
from factorgraph_loc.slam.loop_closure import Image, LoopClosure, OldPoints
from factorgraph_loc.slam.new_points import FEWEST as FEWEST_SIGHTINGS
from factorgraph_loc.slam.new_points import NewPoints, Place, sightings_of
from factorgraph_loc.slam.point_looks import PointLooks
from factorgraph_loc.slam.refound_points import refound
from factorgraph_loc.vision.consensus import FEWEST, GATE, CameraPose, Truths, agreeing
from factorgraph_loc.vision.frame import CameraFrame
from factorgraph_loc.vision.spread import spread_out
from factors import positive, se2
from factors.camera import model as reprojection
from factors.camera.factor import ReprojectionFactor
from factors.camera.kernels import NEAREST
from factors.camera.model import CameraModel, recalibrated
from factors.camera.native import PointSightings
from factors.graph import VectorPriorFactor
from factors.se2 import Array
from factors.update import robust_update

PER_KEYFRAME, WAITING = 40, 60  # points that are seen from one, and that wait
STRIKES = 2
ANCHORED = 4  # points of the graph that place a keyframe well: to SLACK pixels
SLACK = 2.0  # px
OPEN = np.full(3, 30.0)  # m: sightings may leave a point open, but not farther than a building is wide
LOST = 10.0  # s for which a point is looked for: later on, in a building, too many others look like it
AGREED = 0.5  # share of points that must agree, of those not seen for longer: looks that are alike agree by chance
RECENT = 5.0  # s: a point that was seen since has the error of the track now
REVISITED = 6  # points not seen for longer that together are right, whatever the others say
HORIZON, BUNDLE = 60, 8  # keyframes back that sightings may wait, and that are adjusted together


@dataclass
class _Point:
    """A point of the graph: when it was last seen, what its sightings tell of it with exact poses (3, 3), and how many of
    the last ones disagreed."""

    key: int
    last: float
    information: Array
    strikes: int = 0


@dataclass
class UnknownPoints:
    """The points of a graph by name, and those that wait. ``estimated``: constants of the camera that are variables."""

    model: CameraModel
    diagnostics: Diagnostics
    estimated: Estimated = NOTHING
    _points: dict[Hashable, _Point] = field(default_factory=dict)
    _astray: list[_Point] = field(default_factory=list)  # in the graph, but seen no more under their name
    _names: dict[int, str] = field(default_factory=dict)  # by key, of all that ever were in the graph
    _looks: PointLooks = field(default_factory=PointLooks)
    _loops: LoopClosure = field(default_factory=LoopClosure)
    _distance_travelled: float = 0.0  # m that the robot has gone
    _again_as: dict[Hashable, Hashable] = field(default_factory=dict)  # names of points that are followed by new tracks
    _anchored: dict[int, bool] = field(default_factory=dict)  # keyframes with sightings

    def __post_init__(self) -> None:
        self._new = NewPoints(self.model)
        self._sightings = PointSightings(self.model)

    def take(
        self,
        m: Pixels,
        rows: Sequence[int],
        keyframe: Keyframe,
        guess: Guess,
        graph: GraphView,
        addition: Addition,
    ) -> Guess:
        """Turn ``rows`` of what is seen from a new keyframe into factors and variables; returned is the guess of its pose, placed
        by the points. Its covariance stays: the points are known no better than the poses that saw them."""
        model = self.model
        if graph.constants is not None:
            model = recalibrated(model, self.estimated.full(graph.constants, len(reprojection.PARAMETERS)))
        rows = list(rows)
        if keyframe.from_previous is not None:
            self._distance_travelled += float(np.hypot(*keyframe.from_previous.delta[:2]))
        names = self._named(m, rows, lifted(model, *guess), graph)
        certain: set[int] = set()  # rows
        if m.frame is not None and self._loops.due(m.t):
            certain = self._revisited(
                model, Image(m.frame, keyframe, guess, self._distance_travelled), rows, names, graph
            )
        pixels = np.asarray(m.pixels[rows], dtype=float)
        priority = [len(names) if name in self._points else self._new.count(name) for name in names]
        chosen = spread_out(pixels, PER_KEYFRAME + WAITING, priority).tolist()
        rows, names, pixels = [rows[i] for i in chosen], [names[i] for i in chosen], pixels[chosen]
        old = [i for i, name in enumerate(names) if name in self._points]
        few = spread_out(pixels[old], PER_KEYFRAME).tolist()
        old = [old[i] for i in few]
        points = [self._points[names[i]] for i in old]
        known = np.array([rows[i] in certain for i in old], dtype=bool)
        guess, right = self._placed(model, points, pixels[old], keyframe.t, guess, graph, known)
        if m.frame is not None:
            seen_from = lifted(model, *guess).position
            self._remember(
                m.frame, [(rows[i], names[i], bool(agrees)) for i, agrees in zip(old, right, strict=True)], seen_from
            )
        for i, agrees in zip(old, right.tolist(), strict=True):
            self._again(names[i], pixels[i], bool(agrees), keyframe, guess[0], model, graph, addition)
        self._anchored[keyframe.index] = int(np.count_nonzero(right)) >= ANCHORED
        fresh = [i for i, name in enumerate(names) if name not in self._points]
        for i, sighting in zip(fresh, sightings_of(self.model, keyframe.index, pixels[fresh]), strict=True):
            self._new.add(names[i], sighting)
        self._new.forget(keyframe.index)
        waiting = [names[i] for i in fresh if self._new.count(names[i]) >= FEWEST_SIGHTINGS]
        places, pose = self._places(keyframe, guess[0], waiting, graph)
        for name, found, seen in self._new.ready(waiting, places.get, PER_KEYFRAME - len(old)):
            key = point_key(len(self._names))
            self._names[key] = f"track{name}" if m.names is None else str(name)
            self._points[name] = _Point(key, keyframe.t, positive.inverse(found.covariance))
            if m.frame is not None:
                self._looks.keep(
                    key, m.frame, rows[names.index(name)], lifted(model, *guess).position, self._distance_travelled
                )
            addition.values[key] = found.position
            graph.values[key], graph.spreads[key] = found.position, found.covariance
            native = gtsam.PriorFactorVector(key, found.position, gtsam.noiseModel.Diagonal.Sigmas(OPEN))
            prior = Node((key,), VectorPriorFactor(found.position, OPEN), 3, native)
            keyframe.nodes.append(prior)
            addition.nodes.append(prior)
            for sighting in seen:
                self._hang(graph.keyframes[sighting.keyframe], key, sighting.pixel, graph, addition)
        return pose, guess[1]

    def _named(self, m: Pixels, rows: Sequence[int], camera: CameraPose, graph: GraphView) -> list[Hashable]:
        """What is seen, by name: of features the number of the track, or of that under which the point came into the graph."""
        if m.frame is None:
            return [m.names[i] for i in rows]
        tracks = m.frame.tracks[list(rows)].tolist()
        # the track that a point came with may come back itself
        gone = self._points.keys() - set(tracks)
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
        """From now on a track, and no other, shows the point of that name."""
        self._again_as = {other: of for other, of in self._again_as.items() if of != name}
        self._again_as[track] = name

    def _revisited(
        self, model: CameraModel, image: Image, rows: Sequence[int], names: list[Hashable], graph: GraphView
    ) -> set[int]:
        """Those ``rows`` of an image that certainly show points last seen long ago; their ``names`` become those of the points."""
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

    def _remember(self, m: CameraFrame, seen: Sequence[tuple[int, Hashable, bool]], seen_from: Array) -> None:
        """What points of the graph look like now; a track that is none of them after all goes its own way."""
        for row, name, agrees in seen:
            track = int(m.tracks[row])
            if agrees:
                self._looks.keep(self._points[name].key, m, row, seen_from, self._distance_travelled)
            elif self._again_as.pop(track, None) is not None:
                self._points[name].strikes -= 1  # the point itself did nothing wrong

    def uses(self, name: Hashable) -> bool:
        """Whether what is seen under a name is a point of the graph, or waits to be one."""
        return name in self._points or name in self._again_as or self._new.count(name) > 0

    def leave(self, t: float) -> list[int]:
        """Keys of the points that were last seen before ``t``, which the graph has no more from now on."""
        gone = [point.key for point in (*self._points.values(), *self._astray) if point.last < t]
        self._points = {name: point for name, point in self._points.items() if point.last >= t}
        self._astray = [point for point in self._astray if point.last >= t]
        return gone

    def keep_only(self, keys: set[int]) -> None:
        """Give up the points of the graph but those with these ``keys``, and all that wait."""
        self._points = {name: point for name, point in self._points.items() if point.key in keys}
        self._new, self._loops = NewPoints(self.model), LoopClosure()

    def learnt(self, values: Mapping[int, Array], spreads: Mapping[int, Array]) -> PointMap | None:
        """All points that were ever in the graph, those that were met under several keys under the first of them; of
        features with the last view of each."""
        keys: dict[str, int] = {}
        for key, name in self._names.items():
            if key in values:
                keys.setdefault(name, key)
        if not keys:
            return None
        positions, covariances = (np.array([part[key] for key in keys.values()]) for part in (values, spreads))
        return self._looks.map_of(tuple(keys), tuple(keys.values()), positions, covariances)

    def _placed(
        self,
        model: CameraModel,
        points: list[_Point],
        pixels: Array,
        t: float,
        guess: Guess,
        graph: GraphView,
        known: Truths,
    ) -> tuple[Guess, Truths]:
        """The guess placed by points of the graph, and which of these agree.

        Those that were not seen for long need not agree with the others, as the track has drifted since, but with each other.
        """
        if not points:
            return guess, np.zeros(0, dtype=bool)
        positions = np.array([graph.current(point.key) for point in points])
        spreads = positive.inverse(np.array([point.information for point in points]))
        camera = lifted(model, *guess)
        _, _, by_point = reprojection.linearize_in_space(model, camera.position, camera.rotation, positions)
        noise = (model.sigma**2 + SLACK**2) * np.eye(2) + by_point @ spreads @ by_point.transpose(0, 2, 1)
        recent = np.array([t - point.last < RECENT for point in points])
        right = known.copy()
        placed = guess
        revisited = max(REVISITED, math.ceil(AGREED * np.count_nonzero(~recent & ~known)))
        for which, enough in ((recent, FEWEST), (~recent & ~known, revisited)):
            agrees = np.zeros(len(points), dtype=bool)
            if which.any():
                agrees[which] = agreeing(model, camera, positions[which], pixels[which], noise[which])
            if np.count_nonzero(agrees) >= enough and placed is guess:
                factor = ReprojectionFactor(model, positions[agrees], pixels[agrees], point_covariances=spreads[agrees])
                update = robust_update(factor, *guess, ITERATIONS, SETTLED)
                placed = se2.compose(guess[0], se2.exp(update.delta)), guess[1]
            elif np.count_nonzero(agrees) < enough and placed is not guess:
                error = reprojection.predict(model, placed[0], positions)[0] - pixels
                agrees &= positive.squared(error, noise) < GATE
            elif np.count_nonzero(agrees) < enough:
                agrees &= which & recent
            right |= agrees
        return placed, right

    def _again(
        self,
        name: Hashable,
        pixel: Array,
        agrees: bool,
        keyframe: Keyframe,
        pose: Array,
        model: CameraModel,
        graph: GraphView,
        addition: Addition,
    ) -> None:
        """A point of the graph is seen again."""
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
        self._hang(keyframe, point.key, pixel, graph, addition)

    def _hang(self, keyframe: Keyframe, key: int, pixel: Array, graph: GraphView, addition: Addition) -> None:
        shared = graph.shared
        native = None if shared else self._sightings.factor(keyframe.key, key, pixel)
        factor = ReprojectionFactor(
            self.model, np.zeros((1, 3)), pixel[None], estimated=self.estimated.indices, free=True
        )
        node = Node((keyframe.key, *shared, key), factor, 2, native)
        keyframe.nodes.append(node)
        addition.nodes.append(node)

    def _places(
        self, newest: Keyframe, pose: Array, names: Sequence[Hashable], graph: GraphView
    ) -> tuple[dict[int, Place], Array]:
        """Where the keyframes are that see points that wait, by number, and how well their pixels fit to those of the newest; and
        the pose (3,) of that.

        Between keyframes that points of the graph have placed they do; else that goes with the turn that odometry alone tells
        between them, or with the adjustment of both where that is possible.
        """
        slacks = self._slacks(newest, graph)
        if not self._anchored[newest.index]:
            last = [index for index in sorted(slacks)[-BUNDLE:] if graph.is_open(index)]
            poses = [pose if i == newest.index else graph.current(graph.keyframes[i].key) for i in last]
            some = [slacks[i] for i in last]
            found = bundled(self.model, [graph.keyframes[i] for i in last], poses, some, self._new.waiting())
            if found is not None:
                return {i: Place.of(self.model, p, SLACK) for i, p in zip(last, found, strict=True)}, found[-1]
        places = {newest.index: Place.of(self.model, pose, slacks[newest.index])}
        for i in {s.keyframe for name in names for s in self._new.waiting()[name]}:
            if i not in places and i in slacks and graph.is_open(i):
                places[i] = Place.of(self.model, graph.current(graph.keyframes[i].key), slacks[i])
        return places, pose

    def _slacks(self, newest: Keyframe, graph: GraphView) -> dict[int, float]:
        """By how many pixels the last keyframes may be off against the newest."""
        slacks: dict[int, float] = {}
        to_anchor = since = (
            0.0  # variance of the turn from the newest to the first one that is anchored, and from that on
        )
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
