"""Local bundle adjustment of the last keyframes and the points waiting there, where no points of the graph determine the
rotation.

Odometry alone may be wrong by more pixels than the parallax to be triangulated. Points seen from several keyframes determine the
rotation better. The result serves as a linearization point only: the sightings enter the graph unchanged.
"""

from collections.abc import Hashable, Mapping, Sequence

import numpy as np

from factorgraph_loc.fusion.graph_parts import Keyframe
from factorgraph_loc.slam.new_points import FEWEST, KeyframeCamera, PointSighting, agreed, apart
from factors import positive
from factors.camera import bundle_kernels as kernels
from factors.camera.model import CameraModel, lens_of
from factors.se2 import Array

ROUGH = 0.5  # standard deviation of an initial point, relative to its depth
ENOUGH = 8  # points
ITERATIONS = 12


def bundled(
    model: CameraModel,
    keyframes: Sequence[Keyframe],
    poses: Sequence[Array],
    slacks: Sequence[float],
    waiting: Mapping[Hashable, Sequence[PointSighting]],
) -> list[tuple[Array, Array]] | None:
    """Adjusted poses (3,) and tilts (2,) of consecutive ``keyframes``, the first pose held, from the initial
    ``poses``, which displace points by ``slacks`` [px]; None with fewer than :data:`ENOUGH` points.
    """
    first = keyframes[0].index
    places = [KeyframeCamera.of(model, pose, slack) for pose, slack in zip(poses, slacks, strict=True)]
    often = [seen for w in waiting.values() if len(seen := [s for s in w if s.keyframe >= first]) >= FEWEST]
    ends = [(seen[i], places[seen[i].keyframe - first]) for seen in often for i in (0, -1)]
    often = [s for s, a, b in zip(often, ends[::2], ends[1::2], strict=True) if apart(model, *a, *b, ROUGH)]
    if len(often) < ENOUGH:
        return None
    points: list[Array] = []
    sightings: list[PointSighting] = []
    starts = [0]
    for seen in often:
        found = agreed(model, seen, [places[s.keyframe - first] for s in seen], ROUGH)
        if found is not None:
            points.append(found[0].position)
            sightings += found[1]
            starts.append(len(sightings))
    if len(points) < ENOUGH:
        return None
    steps = [k.from_previous for k in keyframes[1:] if k.from_previous is not None]
    adjusted = kernels.adjusted(
        lens_of(model),
        model.position,
        model.rotation,
        np.array(poses, dtype=float),
        np.array(points),
        np.array([s.keyframe - first for s in sightings]),
        np.array(starts),
        np.array([s.pixel for s in sightings]),
        np.array((model.sigma, model.robust, model.tilt)),
        np.array([step.delta for step in steps]),
        positive.whitener(np.array([step.covariance for step in steps])),
        ITERATIONS,
    )
    return list(zip(*adjusted, strict=True))
