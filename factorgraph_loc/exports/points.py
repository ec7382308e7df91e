"""Export of a map of points: as PLY (G. Turk, "The PLY polygon file format", 1994), which viewers of point clouds read, and with
the images that show the points as a g2o file, a problem of bundle adjustment.

g2o: R. Kuemmerle, G. Grisetti, H. Strasdat, K. Konolige, W. Burgard, "g2o: a general framework for graph optimization", ICRA 2011,
types ``sba``.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from factorgraph_loc.files.models import write_text
from factorgraph_loc.files.temporary import writing
from factorgraph_loc.io.colmap import ColmapModel
from factorgraph_loc.maps.points import PointMap
from factors.camera.model import CameraModel, undistorted

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


def write_bundle(model: ColmapModel, camera: CameraModel, path: Path) -> None:
    """Write images (``VERTEX_SE3:EXPMAP``, the camera in the world), points (``VERTEX_XYZ``) and where images show points
    (``EDGE_PROJECT_XYZ2UV``), numbered in this order.

    Pixels are undistorted, relative to the principal point, with ``fx`` for both axes; their information is that of the camera's
    noise. The first image is fixed.
    """
    count = len(model.names)
    turns = Rotation.from_matrix(model.rotations).as_quat(canonical=True)
    pixels = camera.fx * undistorted(camera, model.pixels)
    weight = camera.sigma**-2
    lines = [f"PARAMS_CAMERAPARAMETERS 0 {camera.fx:.12g} 0 0 0"]
    lines += [f"VERTEX_SE3:EXPMAP {i} {_words((*model.positions[i], *turns[i]))}" for i in range(count)]
    lines += [f"VERTEX_XYZ {count + k} {_words(point)}" for k, point in enumerate(model.points)]
    for image, point, pixel in zip(model.seen_in.tolist(), model.seen.tolist(), pixels, strict=True):
        lines.append(f"EDGE_PROJECT_XYZ2UV {count + point} {image} 0 {_words(pixel)} {weight:.12g} 0 {weight:.12g}")
    with writing(path):
        write_text(path, "\n".join([*lines, "FIX 0"]) + "\n")


def _words(values: object) -> str:
    return " ".join(f"{value:.12g}" for value in np.asarray(values, dtype=float).tolist())
