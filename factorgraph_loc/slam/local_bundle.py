"""Local bundle adjustment of the last keyframes and their waiting points, if no points of the graph determine the rotation.

The error of the odometry may exceed the parallax of the points, and does so by far if wheels slip. Points seen from several
keyframes determine the rotation better, even if their distances are unknown. The result is only a linearization point: the
sightings enter the graph unchanged.
"""

from collections.abc import Hashable, Mapping, Sequence

import numpy as np

from factorgraph_loc.fusion.graph.graph import Keyframe
from factorgraph_loc.slam.new_points import FEWEST, PointSighting
from factorgraph_loc.vision.consensus import Truths
from factors import positive, se2
from factors.camera import bundle_kernels as kernels
from factors.camera.model import CameraModel, camera_pose, lens_of
from factors.se2 import Array

DISTANCE = 3.0  # m: first guess of how far points are away
FEW, ENOUGH = 5, 8  # bounds of the number of points shared with the previous keyframe: a third of the points in view
ITERATIONS = 30
FITS, MOST = 3.0, 0.5  # standard deviations, and the share of a keyframe's sightings that must fit
SLIPPED = 0.1  # rad: what points that move with the image for their nearness cannot explain


def bundled(
    model: CameraModel,
    keyframes: Sequence[Keyframe],
    poses: Sequence[Array],
    waiting: Mapping[Hashable, Sequence[PointSighting]],
) -> list[tuple[Array, Array]] | None:
    """Adjusted poses (3,) and tilts (2,) of the last of consecutive ``keyframes``, while each shares points with the previous one.

    The initial values are ``poses``; the first pose is fixed. None with fewer than :data:`ENOUGH` points, or if most sightings of
    a keyframe do not fit.
    """
    often = _seen_often(keyframes[0].index, waiting)
    shared, sees = np.zeros(len(keyframes)), np.zeros(len(keyframes))
    for sightings in often:
        rows = np.array([s.keyframe for s in sightings]) - keyframes[0].index
        sees[rows] += 1
        shared[rows[1:]] += np.diff(rows) == 1
    begin = int(np.flatnonzero(shared < np.clip(sees / 3.0, FEW, ENOUGH))[-1])
    keyframes, poses, first = keyframes[begin:], poses[begin:], keyframes[begin].index
    often = _seen_often(first, waiting)
    if len(often) < ENOUGH:
        return None
    starts = _turned(model, poses, first, often)
    adjusted, tilts, fits = _adjusted(model, keyframes, starts, often)
    frames = np.array([s.keyframe - first for sightings in often for s in sightings])
    if np.any(np.bincount(frames, fits) < MOST * np.bincount(frames)):
        return None
    fitting = iter(fits.tolist())
    often = [fitted for sightings in often if len(fitted := [s for s in sightings if next(fitting)]) >= FEWEST]
    if len(often) < ENOUGH:
        return None
    adjusted, tilts, _ = _adjusted(model, keyframes, adjusted, often)
    return list(zip(adjusted, tilts, strict=True))


def _adjusted(
    model: CameraModel, keyframes: Sequence[Keyframe], poses: Sequence[Array], often: Sequence[Sequence[PointSighting]]
) -> tuple[Sequence[Array], Array, Truths]:
    """Adjusted poses (3,) and tilts (N, 2) of N keyframes, and which of the M sightings fit: none if the points cannot be
    determined.
    """
    first = keyframes[0].index
    places = [camera_pose(model, pose) for pose in poses]
    points = []
    for sightings in often:
        middle = sightings[len(sightings) // 2]
        centre, rotation = places[middle.keyframe - first]
        points.append(centre + DISTANCE * (rotation @ middle.ray))
    steps = [k.from_previous for k in keyframes[1:] if k.from_previous is not None]
    frames = np.array([s.keyframe - first for sightings in often for s in sightings])
    try:
        adjusted, tilts, residuals = kernels.adjusted(
            lens_of(model),
            model.position,
            model.rotation,
            np.array(poses),
            np.array(points),
            frames,
            np.cumsum([0, *map(len, often)]),
            np.array([s.pixel for sightings in often for s in sightings]),
            np.array((model.sigma, model.robust, model.tilt)),
            np.array([step.delta for step in steps]),
            positive.whitener(np.array([step.covariance for step in steps])),
            ITERATIONS,
        )
    except np.linalg.LinAlgError:
        return poses, np.zeros((len(poses), 2)), np.zeros(len(frames), dtype=bool)
    return list(adjusted), tilts, np.einsum("mi,mi->m", residuals, residuals) < FITS**2


def _seen_often(first: int, waiting: Mapping[Hashable, Sequence[PointSighting]]) -> list[list[PointSighting]]:
    """The sightings from keyframe number ``first`` on of each point that was seen from :data:`FEWEST` of these."""
    return [sightings for w in waiting.values() if len(sightings := [s for s in w if s.keyframe >= first]) >= FEWEST]


def _turned(
    model: CameraModel, poses: Sequence[Array], first: int, often: Sequence[Sequence[PointSighting]]
) -> list[Array]:
    """The ``poses`` (3,) of keyframes from number ``first`` on, turned as points turn between them where these contradict."""
    sides: list[dict[int, float]] = [{} for _ in poses]
    for i, sightings in enumerate(often):
        for s in sightings:
            x, y, _ = model.rotation @ s.ray
            sides[s.keyframe - first][i] = float(np.arctan2(y, x))
    turned = [poses[0]]
    for start, second, at, then in zip(poses, poses[1:], sides, sides[1:], strict=False):
        step = se2.between(start, second)
        turns = [at[i] - then[i] for i in at.keys() & then.keys()]
        if len(turns) >= ENOUGH and abs(turn := float(np.median(turns)) - step[2]) > SLIPPED:
            step = np.array((step[0], step[1], step[2] + turn))
        turned.append(se2.compose(turned[-1], step))
    return turned
