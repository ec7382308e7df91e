"""Maps of points as models of COLMAP, and such models as maps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from factorgraph_loc.errors import InputError
from factorgraph_loc.io.colmap import ColmapModel
from factorgraph_loc.mapping.camera_poses import PosedFrames, posed_frames
from factorgraph_loc.mapping.point_mapping import MadePoints, PointSettings, points_of_others
from factorgraph_loc.mapping.triangulation import Cameras, Tracks
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.camera.frontend import with_features
from factorgraph_loc.sensors.camera.prepare import frames_of, frontend_of, image_names
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.vision.association import Associator

TURN_SIGMA, SHIFT_SIGMA = 0.01, 0.02  # rad, m: of a reference without covariances, as for a map
NEAREST = 2.0  # px between a point of the model and a feature that shows it


def model_of(log: Log) -> ColmapModel:
    """The points of a log's map, its images at the poses of its reference, and the points that are found in them."""
    if log.world.points is None or not log.world.points.feature:
        raise InputError(
            f"{log.name}: its map has no points with descriptors to write, expected one with them (--world)"
        )
    names, (seen, _) = image_names(log), with_features(log, frontend_of(log.rig, log.world))
    posed, camera = posed_frames(seen, TURN_SIGMA, SHIFT_SIGMA), log.rig.of(CameraSettings).model()
    names = tuple(names[i] for i in np.searchsorted(frames_of(seen)[0], [frame.t for frame in posed.frames]).tolist())
    associator, cameras = Associator(log.world.points, camera), posed.cameras
    poses = zip(posed.frames, cameras.positions, cameras.rotations, posed.covariances, strict=True)
    found = [associator.guided(*pose) for pose in poses]
    return ColmapModel(
        ((camera.width, camera.height),) * len(names),
        names,
        cameras.positions,
        cameras.rotations,
        log.world.points.positions,
        np.repeat(np.arange(len(found)), [len(one) for one in found]),
        np.concatenate([one.points for one in found]),
        np.concatenate([f.pixels[one.features] for f, one in zip(posed.frames, found, strict=True)]).reshape(-1, 2),
    )


def points_of(model: ColmapModel, log: Log, seen: Log, settings: PointSettings, source: Path) -> MadePoints:
    """The points of a model as a map, with descriptors from the log's images of the same names; ``seen``: the log with features.

    A point is kept if features of the images are where the model says that it was seen.
    """
    camera, frames = log.rig.of(CameraSettings).model(), frames_of(seen)[1]
    index = {name: i for i, name in enumerate(image_names(log))}
    there = [(k, index[name]) for k, name in enumerate(model.names) if name in index]
    if not there:
        raise InputError(f"{source}: has none of the images of {log.name}, such as {model.names[0]}")
    if other := {model.sizes[k] for k, _ in there} - {(camera.width, camera.height)}:
        width, height = min(other)
        raise InputError(
            f"{source}: has images of {width} x {height} px, the rig's have {camera.width} x {camera.height}"
        )
    rows = []
    for place, (k, i) in enumerate(there):
        shown = np.flatnonzero(model.seen_in == k)
        if len(shown) and len(frames[i].pixels):
            apart, feature = cKDTree(frames[i].pixels).query(model.pixels[shown], distance_upper_bound=NEAREST)
            best = np.argsort(apart, kind="stable")[: np.count_nonzero(np.isfinite(apart))]
            for values in (feature, model.seen[shown]):  # each feature and each point once
                best = best[np.sort(np.unique(values[best], return_index=True)[1])]
            rows += [(model.seen[shown[b]], place, feature[b]) for b in best.tolist()]
    point, frame, feature = np.array(rows, dtype=np.int64).reshape(-1, 3).T
    posed = [frames[i] for _, i in there]
    pixels = np.array([posed[i].pixels[k] for i, k in zip(frame.tolist(), feature.tolist(), strict=True)]).reshape(
        -1, 2
    )
    old, track = np.unique(point, return_inverse=True)
    images = [k for k, _ in there]
    cameras = Cameras(model.positions[images], model.rotations[images])
    covariances = np.repeat(1e-8 * np.eye(6)[None], len(posed), axis=0)  # its frame is that of its cameras
    tracks = Tracks(track.astype(np.int64), frame, feature, pixels)
    return points_of_others(camera, PosedFrames(posed, cameras, covariances), tracks, model.points[old], settings)
