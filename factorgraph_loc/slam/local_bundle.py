"""Local bundle adjustment of the last keyframes and the points waiting there, where no points of the graph determine the
rotation.

Odometry alone may be wrong by more pixels than the parallax to be triangulated. Points seen from several keyframes determine the
rotation better (Triggs, McLauchlan, Hartley, Fitzgibbon, "Bundle Adjustment, a Modern Synthesis", 2000). The result serves as a
linearization point only: the sightings enter the graph unchanged.
"""

from collections.abc import Hashable, Mapping, Sequence
from itertools import pairwise

import numpy as np

from factorgraph_loc.fusion.graph_parts import Keyframe
from factorgraph_loc.fusion.problem import Problem
from factorgraph_loc.fusion.variables import Values, point_key, tilt_key
from factorgraph_loc.slam.new_points import FEWEST, KeyframeCamera, PointSighting, agreed, apart
from factors.camera.model import CameraModel, lens_of
from factors.camera.point import PointFactor
from factors.graph import Factor, PriorFactor, VectorPriorFactor
from factors.odometry.model import OdometryFactor
from factors.se2 import Array

ROUGH = 0.5  # standard deviation of an initial point, relative to its depth
ENOUGH = 8  # points
ITERATIONS = 12
ANCHOR = np.diag((1e-4, 1e-4, 1e-4)) ** 2  # m, m, rad: holds the first keyframe


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
    values: Values = {k.key: pose for k, pose in zip(keyframes, poses, strict=True)}
    lens, upright = lens_of(model), VectorPriorFactor(np.zeros(2), np.full(2, model.tilt))
    values |= {tilt_key(k.index): np.zeros(2) for k in keyframes}
    factors: list[tuple[Factor, tuple[int, ...]]] = [(upright, (tilt_key(k.index),)) for k in keyframes]
    often = [seen for w in waiting.values() if len(seen := [s for s in w if s.keyframe >= first]) >= FEWEST]
    ends = [(seen[i], places[seen[i].keyframe - first]) for seen in often for i in (0, -1)]
    often = [s for s, a, b in zip(often, ends[::2], ends[1::2], strict=True) if apart(model, *a, *b, ROUGH)]
    if len(often) < ENOUGH:
        return None
    for seen in often:
        found = agreed(model, seen, [places[s.keyframe - first] for s in seen], ROUGH)
        if found is None:
            continue
        point, right = found
        key = point_key(len(values))
        values[key] = point.position
        for s in right:
            pose = keyframes[s.keyframe - first].key
            factors.append((PointFactor(model, lens, s.pixel), (pose, tilt_key(s.keyframe), key)))
    if len(values) < 2 * len(keyframes) + ENOUGH:
        return None
    chain = [
        (OdometryFactor(k.from_previous), (before.key, k.key))
        for before, k in pairwise(keyframes)
        if k.from_previous is not None
    ]
    problem = Problem([(PriorFactor(poses[0], ANCHOR), (keyframes[0].key,)), *chain, *factors])
    solved = problem.solve(values, ITERATIONS).values
    return [(solved[k.key], solved[tilt_key(k.index)]) for k in keyframes]
