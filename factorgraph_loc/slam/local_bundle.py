"""Local bundle adjustment of the last keyframes and their waiting points, if no points of the graph determine the rotation.

The error of the odometry may exceed the parallax of the points, and does so by far if wheels slip. Points seen from several
keyframes determine the rotation better, even if their distances are unknown. The result is only a linearization point: the
sightings enter the graph unchanged. Points are eliminated from each step (Triggs, McLauchlan, Hartley, Fitzgibbon, "Bundle
Adjustment, a Modern Synthesis", 2000).
"""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_loc.fusion.graph.graph import Keyframe
from factorgraph_loc.slam.new_points import FEWEST, PointSighting
from factorgraph_loc.vision.consensus import Truths
from factors import se2
from factors.camera import kernels
from factors.camera.kernels import CONSTANTS, POINT, TILT
from factors.camera.model import CameraModel, camera_pose, lens_of
from factors.least_squares import LEAST, descended
from factors.odometry.factor import OdometryFactor, OdometryStack
from factors.robust import huber_loss
from factors.se2 import Array, Integers

DISTANCE = 3.0  # m: first guess of how far points are away
FEW, ENOUGH = 5, 8  # bounds of the number of points shared with the previous keyframe: a third of the points in view
ITERATIONS = 30
FITS, MOST = 3.0, 0.5  # standard deviations, and the share of a keyframe's sightings that must fit
SLIPPED = 0.1  # rad: what points that move with the image for their nearness cannot explain

State = tuple[Array, Array, Array]  # poses (N, 3) and tilts (N, 2) of keyframes, and points (P, 3)


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
    steps = [OdometryFactor(k.from_previous) for k in keyframes[1:] if k.from_previous is not None]
    frames = np.array([s.keyframe - first for sightings in often for s in sightings])
    owners = np.repeat(np.arange(len(often)), list(map(len, often)))
    pixels = np.array([s.pixel for sightings in often for s in sightings])
    local = LocalBundle(model, OdometryStack(steps, range(len(steps)), 0), frames, owners, pixels)
    start = np.array(poses), np.zeros((len(poses), 2)), np.array(points)
    best, _, _ = descended(local.cost, local.moved, start, ITERATIONS)
    residuals, _, _ = local.linearize(best)
    return list(best[0]), best[1], np.einsum("mi,mi->m", residuals, residuals) < FITS**2


@dataclass(frozen=True)
class LocalBundle:
    """The cost of consecutive poses with ``odometry`` between them, of the tilts of the robot, and of M pixels of points.

    ``frames`` (M,), ``owners`` (M,): the pose and the point of each of the ``pixels`` (M, 2). The first pose is fixed.
    """

    model: CameraModel
    odometry: OdometryStack
    frames: Integers
    owners: Integers
    pixels: Array

    def linearize(self, state: State) -> tuple[Array, Array, Array]:
        """Whitened, robustly weighted residuals (M, 2) of the pixels, their Jacobian, and the squares (M,) without weights."""
        poses, tilts, points = state
        at = poses[self.frames], tilts[self.frames], points[self.owners], self.pixels
        model = self.model
        linear: tuple[Array, Array, Array] = kernels.whiten(
            lens_of(model), model.position, model.rotation, *at, model.sigma, model.robust
        )
        return linear

    def cost(self, state: State) -> float:
        """The robust cost."""
        poses, tilts, _ = state
        of_pixels = huber_loss(self.linearize(state)[2], self.model.robust).sum()
        return float(of_pixels + 0.5 * np.sum(tilts**2) / self.model.tilt**2) + self.odometry.cost(poses, np.zeros(0))

    def moved(self, state: State, damping: float) -> tuple[State, float] | None:
        """The state after a step, whose ``damping`` is a share of the curvature, and the largest component of the step; None
        where the step is not determined."""
        poses, tilts, points = state
        residual, jacobian, _ = self.linearize(state)
        jacobian = jacobian[..., :CONSTANTS]
        squares, pulls = np.einsum("mri,mrj->mij", jacobian, jacobian), -np.einsum("mri,mr->mi", jacobian, residual)
        of_points, mixed = np.zeros((len(points), 3, 3)), np.zeros((len(poses), POINT, len(points), 3))
        hessian, pull = np.zeros((len(poses), POINT, len(poses), POINT)), np.zeros((len(poses), POINT))
        point_pull = np.zeros((len(points), 3))
        np.add.at(of_points, self.owners, squares[:, POINT:, POINT:])
        np.add.at(mixed.swapaxes(1, 2), (self.frames, self.owners), squares[:, :POINT, POINT:])
        np.add.at(hessian.swapaxes(1, 2), (self.frames, self.frames), squares[:, :POINT, :POINT])
        np.add.at(pull, self.frames, pulls[:, :POINT])
        np.add.at(point_pull, self.owners, pulls[:, POINT:])
        each = np.arange(len(poses))
        hessian[each, TILT, each, TILT] += self.model.tilt**-2
        hessian[each, TILT + 1, each, TILT + 1] += self.model.tilt**-2
        pull[:, TILT:] -= tilts / self.model.tilt**2
        by_steps, off = np.zeros((self.odometry.rows, 6)), np.zeros(self.odometry.rows)
        self.odometry.linearize(poses, np.zeros(0), by_steps, off)
        for i, (rows, error) in enumerate(zip(by_steps.reshape(-1, 3, 6), off.reshape(-1, 3), strict=True)):
            hessian[i : i + 2, :TILT, i : i + 2, :TILT] += (rows.T @ rows).reshape(2, 3, 2, 3)
            pull[i : i + 2, :TILT] -= (rows.T @ error).reshape(2, 3)
        size = POINT * len(poses)
        dense, flat = hessian.reshape(size, size), mixed.reshape(size, len(points), 3)
        dense[range(size), range(size)] += damping * np.maximum(np.diag(dense), LEAST)
        own = np.arange(3)
        of_points[:, own, own] += damping * np.maximum(of_points[:, own, own], LEAST)
        try:
            inverse = np.linalg.inv(of_points)
            gain = np.einsum("apj,pjk->apk", flat, inverse)
            left = dense - np.tensordot(gain, flat, ((1, 2), (1, 2)))
            right = pull.ravel() - np.tensordot(gain, point_pull, ((1, 2), (0, 1)))
            step = np.append(np.zeros(TILT), np.linalg.solve(left[TILT:, TILT:], right[TILT:]))
        except np.linalg.LinAlgError:
            return None
        shift = np.einsum("pij,pj->pi", inverse, point_pull - np.tensordot(step, flat, 1))
        largest = float(max(np.abs(step).max(), np.abs(shift).max()))
        moves = step.reshape(-1, POINT)
        moved_poses = se2.compose(poses, se2.exp(moves[:, :TILT]))
        return (moved_poses, tilts + moves[:, TILT:], points + shift), largest


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
