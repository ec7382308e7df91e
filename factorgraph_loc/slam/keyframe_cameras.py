"""Camera poses of the keyframes of a graph. They triangulate points that are not in the graph yet ("waiting" points).

The pose of a keyframe in the graph is the pose at the stamp of its image. If the time offset of the camera is estimated, the image
was taken later than its stamp. The camera pose then includes the motion of the robot with the odometry's velocity at the stamp.

If too few points of the graph are visible to determine the newest pose, the last keyframes and the waiting points are adjusted
together (local bundle adjustment). The odometry alone is not accurate enough: its error may exceed the parallax of the points, and
does so by far if the wheels slip. Points observed from several keyframes determine the rotation better, even if their distances
are unknown. The adjusted poses serve as initial values only. The observations of the points enter the graph unchanged. Points are
eliminated from each step (Triggs, McLauchlan, Hartley, Fitzgibbon, "Bundle Adjustment, a Modern Synthesis", 2000).
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from factorgraph_loc.fusion.graph.graph import Graph, Guess, Keyframe
from factorgraph_loc.model.settings import Estimated
from factorgraph_loc.slam.new_points import FEWEST, KeyframeCamera, PointSighting
from factorgraph_loc.vision.consensus import Truths
from factors import se2
from factors.camera import kernels
from factors.camera.kernels import CONSTANTS, POINT, TILT
from factors.camera.model import TIME_OFFSET, CameraModel, camera_pose, lens_of
from factors.graph import tilt_key
from factors.least_squares import LEAST, descended
from factors.odometry.factor import OdometryFactor, OdometryStack
from factors.robust import huber_loss
from factors.se2 import Array, Integers

ANCHORED, SLACK = 4, 2.0  # number of visible points that determine a keyframe's pose; error of such a pose in pixels
HORIZON, BUNDLE = 60, 8  # numbers of last keyframes: with stored sightings, and adjusted together
DISTANCE = 3.0  # m: initial value of the distance of points
# consecutive keyframes must share a third of the points in view, but at least FEW and at most ENOUGH
FEW, ENOUGH = 5, 8
ITERATIONS = 30
# largest residual of a fitting sighting, in standard deviations; least fraction of a keyframe's sightings that must fit
FITS, MOST = 3.0, 0.5
SLIPPED = 0.1  # rad: smaller differences between the rotations of odometry and image may be parallax of near points

Waiting = Mapping[Hashable, Sequence[PointSighting]]
State = tuple[Array, Array, Array]  # poses (N, 3) and tilts (N, 2) of keyframes, and points (P, 3)


def bundled(
    model: CameraModel,
    keyframes: Sequence[Keyframe],
    poses: Sequence[Array],
    waiting: Waiting,
) -> list[tuple[Array, Array]] | None:
    """Return (pose (3,), tilt (2,)) of each adjusted keyframe, from a bundle adjustment of keyframes and points. A tilt
    is roll and pitch [rad].

    ``keyframes``: consecutive keyframes. Only the newest ones are adjusted, from the last one that shares too few
    points with its predecessor. The pose of this one is fixed. ``poses``: the initial poses of all ``keyframes``.
    ``waiting``: the observations of each point, by its name. Returns None if there are fewer than :data:`ENOUGH`
    points, or if most observations of a keyframe do not fit.
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
    """Return adjusted poses (3,) and tilts (N, 2) of N keyframes, and a mask (M,) of the observations that fit them.
    ``poses``: the initial poses. ``often``: the observations of each point, M in all. If the adjustment fails, poses
    and tilts are the initial ones."""
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
    """The least-squares problem of a local bundle adjustment. A state is (poses (N, 3), tilts (N, 2), points (P, 3)),
    with the poses and tilts of N consecutive keyframes. The first pose is fixed. ``model``: the camera. ``odometry``:
    the factors between consecutive poses. ``pixels`` (M, 2): the observed pixels. ``frames``, ``owners`` (M,): the
    indices of the keyframe and of the point of each pixel."""

    model: CameraModel
    odometry: OdometryStack
    frames: Integers
    owners: Integers
    pixels: Array

    def linearize(self, state: State) -> tuple[Array, Array, Array]:
        """Return the whitened residuals (M, 2) of the pixels at ``state``, with robust weights. Also return their
        Jacobian (M, 2, 16) by pose, tilt, point and camera constants, and the squared whitened residuals (M,) without
        weights."""
        poses, tilts, points = state
        at = poses[self.frames], tilts[self.frames], points[self.owners], self.pixels
        model = self.model
        linear: tuple[Array, Array, Array] = kernels.whiten(
            lens_of(model), model.position, model.rotation, *at, model.sigma, model.robust
        )
        return linear

    def cost(self, state: State) -> float:
        """Return the robust cost at ``state``: half the squared whitened residuals of odometry and tilts, and the Huber
        losses of the pixels."""
        poses, tilts, _ = state
        of_pixels = huber_loss(self.linearize(state)[2], self.model.robust).sum()
        return float(of_pixels + 0.5 * np.sum(tilts**2) / self.model.tilt**2) + self.odometry.cost(poses, np.zeros(0))

    def moved(self, state: State, damping: float) -> tuple[State, float] | None:
        """Return the state after a Levenberg-Marquardt step from ``state``, and the largest absolute component of the
        step. ``damping``: this factor times the Hessian's diagonal is added to the Hessian. Returns None if the sum is
        singular."""
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


def _seen_often(first: int, waiting: Waiting) -> list[list[PointSighting]]:
    """Return a list of the observations of each point from the keyframe with index ``first`` and later ones. Points
    with fewer than :data:`FEWEST` of these are left out. ``waiting``: all observations of each point that is not yet
    triangulated."""
    return [sightings for w in waiting.values() if len(sightings := [s for s in w if s.keyframe >= first]) >= FEWEST]


def _turned(
    model: CameraModel, poses: Sequence[Array], first: int, often: Sequence[Sequence[PointSighting]]
) -> list[Array]:
    """Return the ``poses`` (3,) of consecutive keyframes. The rotation between two keyframes is corrected if it differs
    from the measured one by more than :data:`SLIPPED`. The measured rotation is the median change of bearing of points
    that both images show. ``first``: the index of the first keyframe. ``often``: the observations of each point."""
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


class KeyframeCameras:
    """Computes the camera poses of a graph's keyframes, so that points can be triangulated.

    ``estimated``: which constants of the camera the graph estimates. ``twists``: the velocity (3,) of the robot, by
    index of the keyframe. It is empty if the time offset of the camera is not estimated. ``anchored``: by index of the
    keyframe, True if visible points of the graph determine the keyframe's pose.
    """

    def __init__(self, model: CameraModel, estimated: Estimated) -> None:
        self._model = model
        self._offset = estimated.indices.index(TIME_OFFSET) if TIME_OFFSET in estimated.indices else None
        self.twists: dict[int, Array] = {}
        self.anchored: dict[int, bool] = {}

    def add(self, keyframe: Keyframe, graph: Graph) -> None:
        """Store the robot's velocity at a new keyframe. Call this before ``graph`` deletes the odometry at the
        keyframe's time."""
        if self._offset is not None:
            self.twists[keyframe.index] = graph.motion.twist(keyframe.t)

    def anchor(self, keyframe: Keyframe, points: int) -> None:
        """Store True for a keyframe if the graph's points determine its pose, otherwise False. ``points``: the number
        of points that the keyframe observes."""
        self.anchored[keyframe.index] = points >= ANCHORED

    def forget(self, first: int) -> None:
        """Delete the stored data of the keyframes with indices below ``first``."""
        self.twists = {number: twist for number, twist in self.twists.items() if number >= first}
        self.anchored = {number: anchored for number, anchored in self.anchored.items() if number >= first}

    def at_image(self, keyframe: int, guess: Guess, graph: Graph) -> Guess:
        """Return pose and covariance at the time of exposure of an image. ``guess``: pose and covariance at the image's
        time stamp. ``keyframe``: the index of the image's keyframe. The covariance includes the variance of the
        camera's time offset."""
        return self._moved(keyframe, guess, graph, 1.0)

    def at_stamp(self, keyframe: int, guess: Guess, graph: Graph) -> Guess:
        """Return pose and covariance at the time stamp of an image, the inverse of :meth:`at_image`. ``guess``: pose
        and covariance at the time of exposure. ``keyframe``: the index of the image's keyframe."""
        return self._moved(keyframe, guess, graph, -1.0)

    def pose(self, keyframe: int, graph: Graph) -> Array:
        """Return the estimated pose (3,) of the keyframe with this index, at the time of exposure of its image."""
        pose = graph.current(graph.keyframes[keyframe].key)
        return self._moved(keyframe, (pose, np.zeros((3, 3))), graph, 1.0)[0]

    def _moved(self, keyframe: int, guess: Guess, graph: Graph, sign: float) -> Guess:
        constants = graph.mapped_constants
        if self._offset is None or constants is None or keyframe not in self.twists:
            return guess
        twist = self.twists[keyframe]
        variance = graph.covariances[constants][self._offset, self._offset]
        later = se2.exp(sign * float(graph.values[constants][self._offset]) * twist)
        carried = se2.adjoint(se2.inverse(later))
        covariance = carried @ guess[1] @ carried.T + sign * variance * np.outer(twist, twist)
        return se2.compose(guess[0], later), covariance

    def cameras(
        self, newest: Keyframe, pose: Array, names: Iterable[Hashable], waiting: Waiting, graph: Graph
    ) -> dict[int, KeyframeCamera]:
        """Return {index of keyframe: camera pose} of all keyframes that observe one of the points ``names``.

        ``newest``: the newest keyframe, which is at ``pose`` (3,). ``waiting``: the observations of each point. The
        ``slack`` of a camera pose is its error relative to the newest camera pose, in pixels. The error is small if
        points of the graph determine both keyframes. Otherwise it is computed from the covariance of the odometry.
        """
        slacks = self._slacks(newest, graph)
        cameras = {newest.index: self._camera(pose, newest.index, slacks, graph)}
        for i in {sighting.keyframe for name in names for sighting in waiting[name]}:
            if i not in cameras and i in slacks and graph.is_open(i):
                cameras[i] = self._camera(self.pose(i, graph), i, slacks, graph)
        return cameras

    def bundled(
        self, newest: Keyframe, pose: Array, waiting: Waiting, tilt: float, graph: Graph
    ) -> tuple[dict[int, KeyframeCamera], Array] | None:
        """Return {index of keyframe: adjusted camera pose} of the last keyframes, and the adjusted pose (3,) of
        ``newest``.

        ``newest``: the newest keyframe, with the initial pose ``pose`` (3,). ``waiting``: the observations of the
        points that are adjusted with the poses. ``tilt``: standard deviation [rad] of the robot's roll and pitch.
        Returns None if points of the graph determine the pose of ``newest`` already, or if the adjustment fails.
        """
        if self.anchored[newest.index]:
            return None
        last = [index for index in sorted(self._slacks(newest, graph))[-BUNDLE:] if graph.is_open(index)]
        poses = [pose if i == newest.index else self.pose(i, graph) for i in last]
        result = bundled(replace(self._model, tilt=tilt), [graph.keyframes[i] for i in last], poses, waiting)
        if result is None:
            return None
        adjusted = zip(last[-len(result) :], result, strict=True)
        return {i: KeyframeCamera.of(self._model, p, SLACK, leaning) for i, (p, leaning) in adjusted}, result[-1][0]

    def _camera(self, pose: Array, keyframe: int, slacks: Mapping[int, float], graph: Graph) -> KeyframeCamera:
        return KeyframeCamera.of(self._model, pose, slacks[keyframe], graph.values[tilt_key(keyframe)])

    def _slacks(self, newest: Keyframe, graph: Graph) -> dict[int, float]:
        """Return {index of keyframe: error [px]} of the camera poses of the last keyframes, relative to the newest
        one."""
        slacks: dict[int, float] = {}
        # variances of the odometry's rotation: from the newest keyframe back to the last anchored one; from an older
        # keyframe to the next anchored one
        to_anchor = since = 0.0
        reached = False
        for index in range(newest.index, max(-1, newest.index - HORIZON), -1):
            if self.anchored.get(index, False):
                reached, since = True, 0.0
            slacks[index] = math.hypot(SLACK, self._model.fx * math.sqrt(to_anchor + since))
            step = graph.keyframes[index].from_previous
            if step is None:
                break
            variance = float(step.covariance[2, 2])
            to_anchor, since = (to_anchor, since + variance) if reached else (to_anchor + variance, since)
        return slacks
