"""Compiled bundle adjustment of a few planar poses in a row, the tilt of the robot at each, and the points seen from there.

Steps of Levenberg and Marquardt, with the points eliminated first (Triggs, McLauchlan, Hartley, Fitzgibbon, "Bundle Adjustment, a
Modern Synthesis", 2000).
"""

import numpy as np

from factors.camera.kernels import POINT, WIDTH, Lens, see
from factors.compiled import compiled
from factors.gaussian import inverse, product, put, solved
from factors.odometry.factor import linearize as between
from factors.robust import huber_loss
from factors.se2 import Array, Integers, moved

GAIN, DAMPING = 1e-6, 1e-4  # relative decrease of the cost below which it has converged, and what damps the first step


@compiled(error_model="numpy")
def adjusted(
    k: Lens,
    position: Array,
    rotation: Array,
    poses: Array,
    points: Array,
    frames: Integers,
    starts: Integers,
    pixels: Array,
    noise: Array,
    deltas: Array,
    whiteners: Array,
    iterations: int,
) -> tuple[Array, Array, Array]:
    """The most likely poses (N, 3), with the first one fixed, and tilts (N, 2), from pixels of points (P, 3); and the whitened,
    robustly weighted residuals (M, 2).

    ``frames`` (M,): the pose that each of the ``pixels`` (M, 2) was seen from; those of point p are from ``starts`` (P + 1,) p on.
    ``noise``: of a pixel, the scale of its robust loss, and of the tilt [rad]. ``deltas`` (N - 1, 3): from each pose to the next,
    whitened by ``whiteners`` (N - 1, 3, 3).
    """
    n, count = len(frames), len(points)
    tilts, damping = np.zeros((len(poses), 2)), DAMPING
    residual, jacobian = np.empty((n, 2)), np.empty((n, 2, WIDTH))
    trial, by_trial = np.empty((n, 2)), np.empty((n, 2, WIDTH))
    camera = k, position, rotation
    cost = _looked(camera, poses, tilts, points, frames, starts, pixels, noise, deltas, whiteners, residual, jacobian)
    for _ in range(iterations):
        step, shifts = _step(poses, tilts, frames, starts, residual, jacobian, noise[2], deltas, whiteners, damping)
        new_poses, new_tilts, new_points = np.empty_like(poses), tilts.copy(), points.copy()
        for i in range(len(poses)):
            pose = moved(poses[i], step[i])
            for j in range(3):
                new_poses[i, j] = pose[j]
            new_tilts[i, 0] += step[i, 3]
            new_tilts[i, 1] += step[i, 4]
        for p in range(count):
            for j in range(3):
                new_points[p, j] += shifts[p, j]
        new = _looked(
            camera, new_poses, new_tilts, new_points, frames, starts, pixels, noise, deltas, whiteners, trial, by_trial
        )
        if not new <= cost:
            damping *= 10.0
            continue
        gained = cost - new
        poses, tilts, points, cost, damping = new_poses, new_tilts, new_points, new, damping / 10.0
        residual, jacobian, trial, by_trial = trial, by_trial, residual, jacobian
        if gained <= GAIN * cost:
            break
    return poses, tilts, residual


@compiled(error_model="numpy")
def _looked(
    camera: tuple[Lens, Array, Array],
    poses: Array,
    tilts: Array,
    points: Array,
    frames: Integers,
    starts: Integers,
    pixels: Array,
    noise: Array,
    deltas: Array,
    whiteners: Array,
    residual: Array,
    jacobian: Array,
) -> float:
    """The cost; what is seen, linearised in place."""
    cost = 0.0
    for p in range(len(points)):
        for m in range(starts[p], starts[p + 1]):
            at = poses[frames[m]], tilts[frames[m]], points[p], pixels[m]
            cost += huber_loss(see(camera, at, noise[0], noise[1], residual[m], jacobian[m]), noise[1])
    for i in range(len(poses)):
        cost += 0.5 * (tilts[i, 0] ** 2 + tilts[i, 1] ** 2) / noise[2] ** 2
    for i in range(len(deltas)):
        off, _, _, _ = between(poses[i], poses[i + 1], deltas[i], np.zeros((3, 0)), whiteners[i])
        cost += 0.5 * (off[0] ** 2 + off[1] ** 2 + off[2] ** 2)
    return cost


@compiled(error_model="numpy")
def _step(
    poses: Array,
    tilts: Array,
    frames: Integers,
    starts: Integers,
    residual: Array,
    jacobian: Array,
    tilt: float,
    deltas: Array,
    whiteners: Array,
    damping: float,
) -> tuple[Array, Array]:
    """The damped step (N, 5) of poses and tilts, and that of the points (P, 3)."""
    count, n = len(starts) - 1, len(frames)
    hessian, pull = _without_points(poses, tilts, tilt, deltas, whiteners, damping)
    inverses, pulls, mixed = np.empty((count, 3, 3)), np.zeros((count, 3)), np.zeros((n, POINT, 3))
    for p in range(count):
        of_point = damping * np.eye(3)
        for m in range(starts[p], starts[p + 1]):
            _add(residual[m], jacobian[m], POINT * frames[m], hessian, pull, of_point, pulls[p], mixed[m])
        put(inverse(of_point), inverses[p])
        for m in range(starts[p], starts[p + 1]):
            share = product(mixed[m], inverses[p])
            for i in range(POINT):
                for j in range(3):
                    pull[POINT * frames[m] + i, 0] -= share[i, j] * pulls[p, j]
                    for o in range(starts[p], starts[p + 1]):
                        for q in range(POINT):
                            hessian[POINT * frames[m] + i, POINT * frames[o] + q] -= share[i, j] * mixed[o, q, j]
    for i in range(3):  # the first pose is held
        for j in range(len(hessian)):
            hessian[i, j] = hessian[j, i] = 0.0
        hessian[i, i], pull[i, 0] = 1.0, 0.0
    step, shifts = solved(hessian, pull)[0].reshape(len(poses), POINT), np.empty((count, 3))
    for p in range(count):
        left = pulls[p].copy().reshape(1, 3)
        for m in range(starts[p], starts[p + 1]):
            left -= product(step[frames[m]].reshape(1, POINT), mixed[m])
        put(product(left, inverses[p]), shifts[p : p + 1])
    return step, shifts


@compiled(error_model="numpy")
def _without_points(
    poses: Array, tilts: Array, tilt: float, deltas: Array, whiteners: Array, damping: float
) -> tuple[Array, Array]:
    """The cost of odometry and tilt: Gauss-Newton Hessian (5 N, 5 N) and gradient (5 N, 1)."""
    size = POINT * len(poses)
    hessian, pull = damping * np.eye(size), np.zeros((size, 1))
    for i in range(len(poses)):
        for j in range(2):
            hessian[POINT * i + 3 + j, POINT * i + 3 + j] += 1.0 / tilt**2
            pull[POINT * i + 3 + j, 0] -= tilts[i, j] / tilt**2
    for i in range(len(deltas)):
        off, by_start, by_end, _ = between(poses[i], poses[i + 1], deltas[i], np.zeros((3, 0)), whiteners[i])
        for a, left in ((i, by_start), (i + 1, by_end)):
            for r in range(3):
                for j in range(3):
                    pull[POINT * a + j, 0] -= left[r, j] * off[r]
                    for q in range(3):
                        hessian[POINT * a + j, POINT * i + q] += left[r, j] * by_start[r, q]
                        hessian[POINT * a + j, POINT * (i + 1) + q] += left[r, j] * by_end[r, q]
    return hessian, pull


@compiled(error_model="numpy")
def _add(
    residual: Array,
    jacobian: Array,
    place: int,
    hessian: Array,
    pull: Array,
    of_point: Array,
    point_pull: Array,
    mixed: Array,
) -> None:
    """Add one sighting (2,) to the information of its pose, at ``place``, of its point, and of both (5, 3)."""
    for r in range(2):
        for j in range(3):
            of = jacobian[r, POINT + j]
            point_pull[j] -= of * residual[r]
            for q in range(3):
                of_point[j, q] += of * jacobian[r, POINT + q]
            for i in range(POINT):
                mixed[i, j] += jacobian[r, i] * of
        for i in range(POINT):
            pull[place + i, 0] -= jacobian[r, i] * residual[r]
            for j in range(POINT):
                hessian[place + i, place + j] += jacobian[r, i] * jacobian[r, j]
