"""Localization of images in a map of points: each image alone, or a sequence of images in one graph.

A single image is relocalized; points that the map predicts to be visible are then matched and the pose is refined.

A sequence is an offline smoothing problem with poses in space, map points with their uncertainty, points tracked from image to
image that the map lacks, and a constant-velocity motion model. Images that see few map points are located through tracked
points shared with well-located neighbours.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from factorgraph_loc.errors import RunFailedError
from factorgraph_loc.mapping import bundle
from factorgraph_loc.mapping.bundle import Bundle, Known
from factorgraph_loc.mapping.camera_poses import PosedFrames
from factorgraph_loc.mapping.feature_tracks import chained, matched_pairs, overlapping_pairs
from factorgraph_loc.mapping.point_mapping import PointSettings, map_points
from factorgraph_loc.mapping.steady_motion import SteadyMotion
from factorgraph_loc.mapping.triangulation import Cameras, Integers, Tracks, triangulate
from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.vision.association import Associator
from factorgraph_loc.vision.frame import CameraFrame
from factorgraph_loc.vision.relocalization import located
from factors.camera.model import CameraModel
from factors.se2 import Array

GUESSED = (0.01, 0.01)  # rad, m: additional standard deviations of a relocalized pose for guided matching
SURE = (0.005, 0.005)  # the same of a pose from the graph
FEWEST = 12  # points that must agree
REFINED = 2  # rounds of guided matching
ROUNDS = 2  # rounds of graph optimisation and guided matching
EPIPOLAR = 15.0  # px from epipolar lines of cameras that were located one by one
UNKNOWN = (1.0, 3.0)  # rad, m: standard deviations of a pose without a prior
GROWN = 5  # times that the map is extended by points from located images
NEW = PointSettings(distance=0.0, angle=0.0)
NOTHING: Integers = np.empty(0, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class Located:
    """``position`` (3,) [m] and ``rotation`` (3, 3) of the camera in the world, ``covariance`` (6, 6) of a perturbation in its
    own frame, rotation first; ``points`` and ``features`` (M,): indices of matched map points and features.
    """

    position: Array
    rotation: Array
    covariance: Array
    points: Integers
    features: Integers


class ImageLocalizer:
    """Localizes a camera in a map of points."""

    def __init__(self, points: PointMap, model: CameraModel) -> None:
        self._points = points
        self._model = model
        self._associator = Associator(points, model)

    def one(self, frame: CameraFrame) -> Located | None:
        """The pose of a single image, None if the map does not determine it."""
        found = self._associator.relocalized(frame)
        if found is None:
            return None
        position, rotation, covariance, seen = found
        place = Located(position, rotation, covariance, seen.points, seen.features)
        for _ in range(REFINED):
            better = self._looked_for(frame, place, GUESSED)
            if better is None:
                break
            place = better
        return place

    def all(
        self,
        frames: Sequence[CameraFrame],
        t: Array,
        ones: Sequence[Located | None],
        progress: Callable[[float], None] = lambda _: None,
    ) -> list[Located | None]:
        """The poses of a sequence of images, taken at ``t`` (F,) [s], from one graph.

        ``ones``: results of :meth:`one` for each image, returned if the graph cannot be solved. All None if too few were
        located.
        """
        places = self._extended(frames, ones)
        cameras = smooth_start(t, places)
        if cameras is None:
            return [None] * len(frames)
        seen: Sequence[Located | None] = places
        spread = np.diag(np.repeat(np.square(SURE), 3))
        pairs = overlapping_pairs(cameras)
        tracks = chained(frames, matched_pairs(self._model, cameras, frames, pairs, EPIPOLAR))
        progress(0.5)
        for i in range(ROUNDS):
            try:
                adjusted = self._solved(frames, t, cameras, seen, tracks)
            except RuntimeError:  # raised by GTSAM for an underdetermined system
                return places
            cameras, covariances = adjusted.cameras, adjusted.camera_covariances
            found = [
                self._associated(frame, Located(p, r, c + spread, NOTHING, NOTHING))
                for frame, p, r, c in zip(frames, cameras.positions, cameras.rotations, covariances, strict=True)
            ]
            seen = found
            progress(0.5 + 0.5 * (i + 1) / ROUNDS)
        return [replace(place, covariance=c) for place, c in zip(found, covariances, strict=True)]

    def _extended(self, frames: Sequence[CameraFrame], places: Sequence[Located | None]) -> list[Located | None]:
        """``places``, extended by images that see too little of the map, but enough points seen by located images."""
        found = list(places)
        for _ in range(GROWN):
            there = np.array([i for i, place in enumerate(found) if place is not None], dtype=np.int64)
            if len(there) < 2 or len(there) == len(frames):
                break
            known = [place for place in found if place is not None]
            cameras = Cameras(np.array([p.position for p in known]), np.array([p.rotation for p in known]))
            covariances = np.array([place.covariance for place in known])
            try:
                made = map_points(self._model, PosedFrames([frames[i] for i in there], cameras, covariances), NEW)
            except RunFailedError:
                break
            beyond = ImageLocalizer(made.points, self._model)
            for i, frame in enumerate(frames):
                if found[i] is None and (place := beyond.one(frame)) is not None:
                    found[i] = replace(place, points=NOTHING, features=NOTHING)
            if all(found[i] is None for i in range(len(frames)) if i not in there):
                break
        return found

    def _looked_for(self, frame: CameraFrame, place: Located, spread: tuple[float, float]) -> Located | None:
        """The pose refined by guided matching with the map's predictions."""
        wide = replace(place, covariance=place.covariance + np.diag(np.repeat(np.square(spread), 3)))
        seen = self._associated(frame, wide)
        if len(seen.points) < FEWEST:
            return None
        pixels = np.asarray(frame.pixels, dtype=float)[seen.features]
        spreads = self._points.covariances[seen.points]
        found = located(self._model, self._points.positions[seen.points], pixels, spreads)
        if found is None:
            return None
        camera, right = found.camera, found.inliers
        return Located(camera.position, camera.rotation, camera.covariance, seen.points[right], seen.features[right])

    def _associated(self, frame: CameraFrame, place: Located) -> Located:
        seen = self._associator.guided(frame, place.position, place.rotation, place.covariance)
        return replace(place, points=seen.points, features=seen.features)

    def _solved(
        self,
        frames: Sequence[CameraFrame],
        t: Array,
        cameras: Cameras,
        seen: Sequence[Located | None],
        tracks: Tracks,
    ) -> Bundle:
        """The optimised graph of all images."""
        model = self._model
        of_map, shown, new = _divided(tracks, frames, seen)
        # a wrong track would pull all images that nothing else holds in the map, however far
        once, limit = np.ones(len(shown), dtype=np.int64), EPIPOLAR / model.sigma
        of_map, left = of_map.kept(bundle.agreeing(model, cameras, of_map, self._points.positions[shown], limit, once))
        shown = shown[left]
        found = triangulate(model, cameras, new)
        good = found.good(new, replace(model, sigma=2.0 * model.sigma))
        new, old = new.kept(good[new.track])
        count = len(shown)
        both = Tracks(
            np.concatenate((of_map.track, new.track + count)),
            np.concatenate((of_map.frame, new.frame)),
            np.concatenate((of_map.feature, new.feature)),
            np.concatenate((of_map.pixels, new.pixels)),
        )
        positions = np.concatenate((self._points.positions[shown], found.positions[old]))
        known = Known(np.arange(count), self._points.positions[shown], self._points.covariances[shown])
        weak = np.repeat(np.diag(np.repeat(np.square(UNKNOWN), 3))[None], len(frames), axis=0)
        return bundle.adjust(model, cameras, weak, both, positions, known=known, motion=SteadyMotion(t))


def smooth_start(t: Array, places: Sequence[Located | None]) -> Cameras | None:
    """Initial poses (F) of all frames at ``t`` (F,), interpolated between located frames, constant before and after. None if
    fewer than two were located.
    """
    there = [i for i, place in enumerate(places) if place is not None]
    if len(there) < 2:
        return None
    positions = np.array([place.position for place in places if place is not None])
    rotations = np.array([place.rotation for place in places if place is not None])
    at = np.clip(t, t[there[0]], t[there[-1]])
    between = np.column_stack([np.interp(at, t[there], positions[:, i]) for i in range(3)])
    return Cameras(between, Slerp(t[there], Rotation.from_matrix(rotations))(at).as_matrix())


def _divided(
    tracks: Tracks, frames: Sequence[CameraFrame], seen: Sequence[Located | None]
) -> tuple[Tracks, Integers, Tracks]:
    """Observations of map points, the indices of these points in the map, and the tracks of other points.

    A track of which some features match one map point, and none another, observes that point in all its frames.
    """
    point_of = {
        (i, k): point
        for i, place in enumerate(seen)
        if place is not None
        for point, k in zip(place.points.tolist(), place.features.tolist(), strict=True)
    }
    features = list(zip(tracks.frame.tolist(), tracks.feature.tolist(), strict=True))
    named = np.array([point_of.get(one, -1) for one in features], dtype=np.int64)
    largest, least = np.full(tracks.count, -1), np.full(tracks.count, np.iinfo(np.int64).max)
    np.maximum.at(largest, tracks.track, named)
    np.minimum.at(least, tracks.track[named >= 0], named[named >= 0])
    shows = np.where(largest == least, largest, -1)[tracks.track]
    taken = {(i, point) for (i, _), point in point_of.items()}
    for (i, k), point, own in zip(features, shows.tolist(), named.tolist(), strict=True):
        if point >= 0 and own < 0 and (i, point) not in taken:
            point_of[i, k] = point
            taken.add((i, point))
    rows = np.array([(point, i, k) for (i, k), point in point_of.items()], dtype=np.int64).reshape(-1, 3)
    shown, track = np.unique(rows[:, 0], return_inverse=True)
    pixels = np.array([frames[i].pixels[k] for _, i, k in rows.tolist()], dtype=float).reshape(-1, 2)
    new, _ = tracks.kept((named < 0) & (shows < 0))
    return Tracks(track.astype(np.int64), rows[:, 1], rows[:, 2], pixels), shown, new
