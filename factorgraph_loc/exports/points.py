"""Export of a map of points: as PLY (G. Turk, "The PLY polygon file format", 1994), which viewers of point clouds read, and with
the images that show the points as a g2o file, a problem of bundle adjustment.

g2o: R. Kuemmerle, G. Grisetti, H. Strasdat, K. Konolige, W. Burgard, "g2o: a general framework for graph optimization", ICRA 2011,
types ``sba``.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import write_text
from factorgraph_loc.files.temporary import writing
from factorgraph_loc.mapping.camera_poses import posed_frames
from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.camera.frontend import with_features
from factorgraph_loc.sensors.camera.prepare import frontend_of
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.vision.association import Associator
from factors.camera.model import undistorted

HEADER = """ply
format ascii 1.0
comment points of a map in metres; sigma: standard deviation in the worst direction; views: stored views of a point
element vertex {count}
property double x
property double y
property double z
property double sigma
property int views
end_header
"""


def write_ply(points: PointMap, path: Path) -> None:
    """Write the positions of points, with the standard deviation in the worst direction [m] and the number of their views."""
    sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(points.covariances)[:, -1], 0.0)) if len(points) else np.empty(0)
    views = np.bincount(points.owners, minlength=len(points))
    rows = zip(points.positions.tolist(), sigma.tolist(), views.tolist(), strict=True)
    body = "".join(f"{x:.6f} {y:.6f} {z:.6f} {s:.6f} {count}\n" for (x, y, z), s, count in rows)
    with writing(path):
        write_text(path, HEADER.format(count=len(points)) + body)


def write_bundle(log: Log, path: Path) -> None:
    """Write the images of a log at the poses of its reference (``VERTEX_SE3:EXPMAP``, the camera in the world), the points of its
    map (``VERTEX_XYZ``) and where the images show them (``EDGE_PROJECT_XYZ2UV``), numbered in this order.

    Pixels are undistorted, relative to the principal point, with ``fx`` for both axes; their information is that of the camera's
    noise. The first image is fixed. Raises InputError if the points of the map have no descriptors.
    """
    points = log.world.points
    if points is None or not points.feature:
        raise InputError(
            f"{log.name}: its map has no points with descriptors to write, expected one with them (--world)"
        )
    camera = log.rig.of(CameraSettings).model()
    posed = posed_frames(with_features(log, frontend_of(log.rig, log.world))[0])
    associator, cameras = Associator(points, camera), posed.cameras
    turns = Rotation.from_matrix(cameras.rotations).as_quat(canonical=True)
    weight = f"{camera.sigma**-2:.12g}"
    lines = [f"PARAMS_CAMERAPARAMETERS 0 {camera.fx:.12g} 0 0 0"]
    lines += [f"VERTEX_SE3:EXPMAP {i} {_words((*cameras.positions[i], *turns[i]))}" for i in range(len(turns))]
    lines += [f"VERTEX_XYZ {len(turns) + k} {_words(point)}" for k, point in enumerate(points.positions)]
    for i, frame in enumerate(posed.frames):
        seen = associator.guided(frame, cameras.positions[i], cameras.rotations[i], posed.covariances[i])
        pixels = camera.fx * undistorted(camera, frame.pixels[seen.features])
        for k, pixel in zip(seen.points.tolist(), pixels, strict=True):
            lines.append(f"EDGE_PROJECT_XYZ2UV {len(turns) + k} {i} 0 {_words(pixel)} {weight} 0 {weight}")
    with writing(path):
        write_text(path, "\n".join([*lines, "FIX 0"]) + "\n")


def _words(values: object) -> str:
    return " ".join(f"{value:.12g}" for value in np.asarray(values, dtype=float).tolist())
