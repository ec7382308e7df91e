"""Matching of graph points by descriptor after their track was lost.

Within the ellipse predicted from pose and point, the nearest descriptor is accepted if it is clearly nearer than the second
(:func:`factorgraph_loc.vision.matching.match_guided`). Wrong matches are rejected later, by consensus with other points.
"""

from collections.abc import Sequence

import numpy as np

from factorgraph_loc.vision.consensus import CameraPose
from factorgraph_loc.vision.frame import CameraFrame
from factorgraph_loc.vision.matching import match_guided
from factors.camera import model as reprojection
from factors.camera.kernels import NEAREST
from factors.camera.model import CameraModel
from factors.se2 import Array

NOISE = 3.0  # px: of the predicted pixel, in addition to the error of the pose
FARTHEST = 15.0  # m of depth


def refound(
    model: CameraModel,
    camera: CameraPose,
    positions: Array,
    descriptors: Sequence[Array],
    frame: CameraFrame,
    rows: Sequence[int],
) -> list[tuple[int, int]]:
    """Pairs of a point, of those at ``positions`` (N, 3) with N ``descriptors``, and of its match among the features ``rows`` of
    a frame taken from about ``camera``.
    """
    if not len(positions) or not rows:
        return []
    seen, by_camera, _ = reprojection.linearize_in_space(model, camera.position, camera.rotation, positions)
    depth = ((positions - camera.position) @ camera.rotation)[:, 2]
    near = np.flatnonzero(model.contains(seen) & (depth > NEAREST) & (depth < FARTHEST))
    if not len(near):
        return []
    jacobian = by_camera[near]
    spreads = jacobian @ camera.covariance @ jacobian.transpose(0, 2, 1) + NOISE**2 * np.eye(2)
    looks = np.array([descriptors[i] for i in near.tolist()])
    offered = frame.descriptors[list(rows)]
    found = match_guided(
        looks, offered, seen[near], spreads, frame.pixels[list(rows)], binary=frame.descriptors.dtype == np.uint8
    )
    return [(int(near[a]), rows[b]) for a, b in found.indices.tolist()]
