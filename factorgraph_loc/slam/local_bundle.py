"""Local bundle adjustment of the last keyframes and the points waiting there, where no points of the graph determine the
rotation.

Odometry alone may be wrong by more pixels than the parallax to be triangulated, and far more where wheels slip. Points seen from
several keyframes determine the rotation better, before anything is known of their distances. The result serves as a linearization
point only: the sightings enter the graph unchanged.
"""

from collections.abc import Hashable, Mapping, Sequence

import numpy as np

from factorgraph_loc.fusion.graph.problem import Problem
from factorgraph_loc.fusion.graph.variables import Keyframe, gather, point_key, pose_key, tilt_key
from factorgraph_loc.slam.new_points import FEWEST, PointSighting
from factorgraph_loc.vision.consensus import Truths
from factors import se2
from factors.camera.model import CameraModel, camera_pose, lens_of
from factors.camera.point import PointFactor
from factors.graph import Placed, PriorFactor, VectorPriorFactor
from factors.odometry.model import OdometryFactor
from factors.se2 import Array

DISTANCE = 3.0  # m: first guess of how far points are away
FEW, ENOUGH = 5, 8  # points that a keyframe shares with the one before: a third of what it sees, within these bounds
ITERATIONS = 30
FIXED = 1e-10 * np.eye(3)  # covariance [m^2, rad^2] of the first pose, which does not move
FITS, MOST = 3.0, 0.5  # standard deviations, and the share of a keyframe's sightings that must fit
SLIPPED = 0.1  # rad: what points that move with the image for their nearness cannot explain


def bundled(
    model: CameraModel,
    keyframes: Sequence[Keyframe],
    poses: Sequence[Array],
    waiting: Mapping[Hashable, Sequence[PointSighting]],
) -> list[tuple[Array, Array]] | None:
    """Adjusted poses (3,) and tilts (2,) of the last of consecutive ``keyframes``, as far as each shares points with the one
    before; the first pose held, from the initial ``poses``.

    None with fewer than :data:`ENOUGH` points, or where most of what a keyframe sees does not fit.
    """
    often = _seen_often(keyframes[0].index, waiting)
    shared, sees = np.zeros(len(keyframes)), np.zeros(len(keyframes))
    for seen in often:
        rows = np.array([s.keyframe for s in seen]) - keyframes[0].index
        sees[rows] += 1
        shared[rows[1:]] += np.diff(rows) == 1
    begin = int(np.flatnonzero(shared < np.clip(sees / 3.0, FEW, ENOUGH))[-1])
    keyframes, poses, first = keyframes[begin:], poses[begin:], keyframes[begin].index
    often = _seen_often(first, waiting)
    if len(often) < ENOUGH:
        return None
    starts = _turned(model, poses, first, often)
    adjusted, tilts, fits = _adjusted(model, keyframes, starts, often)
    frames = np.array([s.keyframe - first for seen in often for s in seen])
    if np.any(np.bincount(frames, fits) < MOST * np.bincount(frames)):
        return None
    fitting = iter(fits.tolist())
    often = [fitted for seen in often if len(fitted := [s for s in seen if next(fitting)]) >= FEWEST]
    if len(often) < ENOUGH:
        return None
    adjusted, tilts, _ = _adjusted(model, keyframes, adjusted, often)
    return list(zip(adjusted, tilts, strict=True))


def _adjusted(
    model: CameraModel, keyframes: Sequence[Keyframe], poses: Sequence[Array], often: Sequence[Sequence[PointSighting]]
) -> tuple[list[Array], list[Array], Truths]:
    """Adjusted poses (3,) and tilts (2,) of N keyframes, and which of the M sightings fit. The first pose is fixed."""
    first, lens = keyframes[0].index, lens_of(model)
    values = {pose_key(k): pose for k, pose in enumerate(poses)} | {tilt_key(k): np.zeros(2) for k in range(len(poses))}
    factors: list[Placed] = [(PriorFactor(poses[0], FIXED), (pose_key(0),))]
    factors += [(VectorPriorFactor(np.zeros(2), np.full(2, model.tilt)), (tilt_key(k),)) for k in range(len(poses))]
    for k, keyframe in enumerate(keyframes[1:]):
        if keyframe.from_previous is not None:
            factors.append((OdometryFactor(keyframe.from_previous), (pose_key(k), pose_key(k + 1))))
    sightings: list[tuple[PointFactor, tuple[int, ...]]] = []
    for p, seen in enumerate(often):
        middle = seen[len(seen) // 2]
        centre, rotation = camera_pose(model, poses[middle.keyframe - first])
        values[point_key(p)] = centre + DISTANCE * (rotation @ middle.ray)
        for s in seen:
            keys = pose_key(s.keyframe - first), tilt_key(s.keyframe - first), point_key(p)
            sightings.append((PointFactor(model, lens, s.pixel), keys))
    found = Problem([*factors, *sightings]).solve(values, ITERATIONS).values
    at = [gather(found, keys) for _, keys in sightings]
    residuals, _ = PointFactor.linearize_all([factor for factor, _ in sightings], at)
    fits = np.einsum("mi,mi->m", residuals, residuals) < FITS**2
    return [found[pose_key(k)] for k in range(len(poses))], [found[tilt_key(k)] for k in range(len(poses))], fits


def _seen_often(first: int, waiting: Mapping[Hashable, Sequence[PointSighting]]) -> list[list[PointSighting]]:
    """The sightings from keyframe number ``first`` on of each point that was seen from :data:`FEWEST` of these."""
    return [seen for w in waiting.values() if len(seen := [s for s in w if s.keyframe >= first]) >= FEWEST]


def _turned(
    model: CameraModel, poses: Sequence[Array], first: int, often: Sequence[Sequence[PointSighting]]
) -> list[Array]:
    """The ``poses`` (3,) of keyframes from number ``first`` on, turned as points turn between them where these contradict."""
    sides: list[dict[int, float]] = [{} for _ in poses]
    for i, seen in enumerate(often):
        for s in seen:
            x, y, _ = model.rotation @ s.ray
            sides[s.keyframe - first][i] = float(np.arctan2(y, x))
    turned = [poses[0]]
    for before, here, at, then in zip(poses, poses[1:], sides, sides[1:], strict=False):
        step = se2.between(before, here)
        turns = [at[i] - then[i] for i in at.keys() & then.keys()]
        if len(turns) >= ENOUGH and abs(turn := float(np.median(turns)) - step[2]) > SLIPPED:
            step = np.array((step[0], step[1], step[2] + turn))
        turned.append(se2.compose(turned[-1], step))
    return turned
