"""Compiled functions of :mod:`factors.camera.model` and :mod:`factors.camera.point`: projection, distortion and derivatives."""

import math

import numpy as np

from factors.compiled import compiled
from factors.robust import huber_loss, huber_weight
from factors.se2 import Array

NEAREST = 0.05  # m; points with a smaller depth are projected as if at this depth
MOST_STEPS, ENOUGH = 50, 1e-14  # maximum steps of Newton's method, and norm of the residual at convergence
BLOCK = 256  # number of poses whose likelihoods are computed together, so that their data fit into the cache
BEHIND = 100.0  # residual of a point behind the camera, in standard deviations
# Columns of a full Jacobian: the pose (3), the tilt (2) from TILT on, the point (3) from POINT on, the camera's constants (8).
TILT, POINT, CONSTANTS, WIDTH = 3, 5, 8, 16

# The elements of a lens are fx, fy, cx, cy, k1, k2, p1, p2, and 1 / r^2, where the distortion is valid for x^2 + y^2 < r^2. A lens
# without Brown's distortion has five more: its kind (RATIONAL or FISHEYE), k3, k4, k5, k6. Numba compiles separate code for each
# length of the tuple, so that Brown's distortion needs no branch.
Lens = tuple[float, ...]
BROWN = 9  # the number of elements of a lens with Brown's distortion
RATIONAL, FISHEYE = 0.0, 1.0
Place = tuple[tuple[float, ...], ...]  # a camera's pose in the robot frame: position, and the three axes of the camera


@compiled
def _radial(k: Lens, rr: float) -> tuple[float, float]:
    """Return the radial factor of a rational or fisheye lens ``k``, and twice its derivative by ``rr``.

    ``rr``: the squared distance x^2 + y^2 of the direction from the axis. The distorted distance is the distance times
    the radial factor. Fisheye lens: Kannala and Brandt, "A generic camera model and calibration method", PAMI 28(8),
    2006, eq. 6.
    """
    k1, k2, k3, k4, k5, k6 = k[4], k[5], k[-4], k[-3], k[-2], k[-1]
    if k[-5] == RATIONAL:
        above, below = 1.0 + rr * (k1 + rr * (k2 + rr * k3)), 1.0 + rr * (k4 + rr * (k5 + rr * k6))
        rise, fall = k1 + rr * (2.0 * k2 + rr * 3.0 * k3), k4 + rr * (2.0 * k5 + rr * 3.0 * k6)
        return above / below, 2.0 * (rise - fall * above / below) / below
    if rr < 1e-8:
        return 1.0 + (k1 - 1.0 / 3.0) * rr, 2.0 * (k1 - 1.0 / 3.0)
    r = math.sqrt(rr)
    angle = math.atan(r)
    aa = angle * angle
    seen = angle * (1.0 + aa * (k1 + aa * (k2 + aa * (k3 + aa * k4))))
    slope = (1.0 + aa * (3.0 * k1 + aa * (5.0 * k2 + aa * (7.0 * k3 + aa * 9.0 * k4)))) / (1.0 + rr)
    return seen / r, (slope * r - seen) / (r * rr)


@compiled
def radial_slope(k: Lens, rr: float) -> float:
    """Return the derivative of the distorted distance from the optical axis by the undistorted distance. ``k``: a
    rational or fisheye lens. ``rr``: the squared undistorted distance x^2 + y^2 at depth 1."""
    radial, slope = _radial(k, rr)
    return float(radial + rr * slope)


@compiled(inline="always")
def _bent(k: Lens, x: float, y: float) -> tuple[float, float, float, float, float]:
    """Distort a direction (x, y) within the valid radius of the lens ``k``. Returns the distorted direction (2
    numbers), and its derivatives: x by x, x by y (which equals y by x), and y by y."""
    k1, k2, p1, p2 = k[4], k[5], k[6], k[7]
    rr = x * x + y * y
    radial = 1.0 + k1 * rr + k2 * rr * rr
    slope = 2.0 * (k1 + 2.0 * k2 * rr)
    if len(k) != BROWN:
        radial, slope = _radial(k, rr)
    xd = x * radial + 2.0 * p1 * x * y + p2 * (rr + 2.0 * x * x)
    yd = y * radial + p1 * (rr + 2.0 * y * y) + 2.0 * p2 * x * y
    xx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    xy = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    yy = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
    return xd, yd, xx, xy, yy


@compiled(inline="always")
def _distorted(k: Lens, x: float, y: float) -> tuple[float, float, float, float, float, float]:
    """Distort any direction (x, y) by the lens ``k``. Returns the result (2 numbers) and its Jacobian by rows (4).

    Let B be the distortion and R its valid radius. Beyond R the distortion of a direction d is extrapolated radially,
    as ``t B(d / t)`` with ``t = |d| / R``. Directions far outside of the image then do not appear in the image.
    """
    t = math.sqrt(max(1.0, k[8] * (x * x + y * y)))
    inverse = 1.0 / t
    ex, ey = inverse * x, inverse * y
    xd, yd, xx, xy, yy = _bent(k, ex, ey)
    tx, ty = (k[8] * ex, k[8] * ey) if t > 1.0 else (0.0, 0.0)  # derivatives of t
    ax, ay = xd - xx * ex - xy * ey, yd - xy * ex - yy * ey
    return t * xd, t * yd, xx + ax * tx, xy + ax * ty, xy + ay * tx, yy + ay * ty


@compiled(inline="always")
def pixel(
    k: Lens, p0: float, p1: float, p2: float
) -> tuple[float, float, tuple[float, float, float], tuple[float, float, float]]:
    """Project the point (p0, p1, p2) in the camera frame by the lens ``k``. Returns the pixel coordinates u and v, and
    the gradients of u and of v by the point (3 numbers each)."""
    near = 1.0 / max(p2, NEAREST)
    x, y = p0 * near, p1 * near
    xd, yd, xx, xy, yx, yy = _distorted(k, x, y)
    fx, fy, fz = k[0] * near, k[1] * near, 0.0 if p2 < NEAREST else -1.0
    by_u = (fx * xx, fx * xy, fx * fz * (xx * x + xy * y))
    by_v = (fy * yx, fy * yy, fy * fz * (yx * x + yy * y))
    return k[0] * xd + k[2], k[1] * yd + k[3], by_u, by_v


@compiled(inline="always")
def mounting(position: Array, rotation: Array) -> Place:
    """Return the camera's ``position`` (3,) and ``rotation`` (3, 3) in the robot frame as tuples of numbers, for fast
    access in compiled code."""
    p, r = position, rotation
    right, down, ahead = (r[0, 0], r[1, 0], r[2, 0]), (r[0, 1], r[1, 1], r[2, 1]), (r[0, 2], r[1, 2], r[2, 2])
    return (p[0], p[1], p[2]), right, down, ahead


@compiled(inline="always")
def in_camera(
    place: Place, c: float, s: float, dx: float, dy: float, z: float
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Transform a world point to the camera frame.

    ``place``: the camera's pose in the robot frame, from :func:`mounting`. ``c``, ``s``: cosine and sine of the robot's
    heading. ``dx``, ``dy``, ``z``: the vector from the robot to the point along the world's axes.

    Returns the vector (x, y, z) from camera to point twice, first along the robot's axes, then along the camera's axes.
    """
    position, right, down, ahead = place
    ax, ay, az = c * dx + s * dy - position[0], c * dy - s * dx - position[1], z - position[2]
    lx = right[0] * ax + right[1] * ay + right[2] * az
    ly = down[0] * ax + down[1] * ay + down[2] * az
    lz = ahead[0] * ax + ahead[1] * ay + ahead[2] * az
    return (ax, ay, az), (lx, ly, lz)


@compiled(error_model="numpy")
def undistorted(k: Lens, distorted: Array) -> tuple[Array, Array]:
    """Invert the distortion of the lens ``k`` by Newton's method.

    ``distorted`` (K, 2): distorted directions (x, y) at depth 1. Returns the undistorted directions (K, 2), and errors
    (K,): the distance from each distorted direction to the result after distortion. At the results, the determinant of
    the lens's Jacobian is positive. If ``distorted`` is NaN, the result is NaN with an infinite error.
    """
    n = len(distorted)
    directions, errors = np.full((n, 2), np.nan), np.full(n, np.inf)
    for i in range(n):
        # start on the axis, where every lens is invertible. The first step is the solution without distortion
        x, y, step_x, step_y, share = 0.0, 0.0, distorted[i, 0], distorted[i, 1], 1.0
        for _ in range(MOST_STEPS):
            to_x, to_y = x + share * step_x, y + share * step_y
            xd, yd, xx, xy, yx, yy = _distorted(k, to_x, to_y)
            eu, ev, determinant = distorted[i, 0] - xd, distorted[i, 1] - yd, xx * yy - xy * yx
            error = math.sqrt(eu * eu + ev * ev)
            if not (determinant > 0.0 and error < errors[i]):  # the step is too long
                share *= 0.5
                continue
            x, y, errors[i] = to_x, to_y, error
            directions[i, 0], directions[i, 1] = x, y
            if error < ENOUGH:
                break
            step_x, step_y, share = (yy * eu - xy * ev) / determinant, (xx * ev - yx * eu) / determinant, 1.0
    return directions, errors


@compiled(error_model="numpy")
def project(k: Lens, points: Array) -> tuple[Array, Array]:
    """Return the pixels (K, 2) of points (K, 3) in the camera frame, and their Jacobians (K, 2, 3) by the points."""
    n = len(points)
    pixels, jacobians = np.empty((n, 2)), np.empty((n, 2, 3))
    for i in range(n):
        u, v, by_u, by_v = pixel(k, points[i, 0], points[i, 1], points[i, 2])
        pixels[i, 0], pixels[i, 1] = u, v
        for j in range(3):
            jacobians[i, 0, j], jacobians[i, 1, j] = by_u[j], by_v[j]
    return pixels, jacobians


@compiled(error_model="numpy")
def linearize_in_space(k: Lens, position: Array, rotation: Array, points: Array) -> tuple[Array, Array, Array]:
    """Project world ``points`` (K, 3) to the pixels of a camera at ``position`` (3,) with ``rotation`` (3, 3) in the
    world. ``k``: the lens. Returns the pixels (K, 2) and their Jacobians by the camera's perturbation (K, 2, 6) and by
    the points (K, 2, 3). The perturbation is in the camera frame, with rotation before translation."""
    n = len(points)
    pixels, by_camera, by_point = np.empty((n, 2)), np.empty((n, 2, 6)), np.empty((n, 2, 3))
    for i in range(n):
        dx, dy, dz = points[i, 0] - position[0], points[i, 1] - position[1], points[i, 2] - position[2]
        x = dx * rotation[0, 0] + dy * rotation[1, 0] + dz * rotation[2, 0]
        y = dx * rotation[0, 1] + dy * rotation[1, 1] + dz * rotation[2, 1]
        z = dx * rotation[0, 2] + dy * rotation[1, 2] + dz * rotation[2, 2]
        u, v, by_u, by_v = pixel(k, x, y, z)
        pixels[i, 0], pixels[i, 1] = u, v
        for r in range(2):
            a, b, c = by_u if r == 0 else by_v
            # a rotation w moves the point in the camera frame by -w x p
            by_camera[i, r, 0], by_camera[i, r, 1], by_camera[i, r, 2] = b * z - c * y, c * x - a * z, a * y - b * x
            by_camera[i, r, 3], by_camera[i, r, 4], by_camera[i, r, 5] = -a, -b, -c
            for j in range(3):
                by_point[i, r, j] = a * rotation[j, 0] + b * rotation[j, 1] + c * rotation[j, 2]
    return pixels, by_camera, by_point


@compiled(error_model="numpy")
def project_planar(
    camera: tuple[Lens, Array, Array], pose: Array, tilt: Array, turn: Array, point: Array, jacobian: Array
) -> tuple[float, float, float]:
    """Project a world ``point`` (3,) to the camera of a robot on a plane.

    ``camera``: the lens, and the camera's position (3,) and rotation (3, 3) in the robot frame.
    ``pose`` (3,), ``tilt`` (2,) [rad]: the robot's planar pose, and its roll and pitch. ``turn`` (3, 3): the rotation
    matrix of the tilt, from :func:`turned`.
    ``jacobian`` (2, WIDTH): output, the derivatives of the pixel by pose, tilt, point and the camera's constants.

    Returns the pixel coordinates u and v, and the depth [m].
    """
    k, position, rotation = camera
    c, s = math.cos(pose[2]), math.sin(pose[2])
    dx, dy, z = point[0] - pose[0], point[1] - pose[1], point[2]
    x, y = c * dx + s * dy, c * dy - s * dx
    # (bx, by, bz): the point in the robot frame; (ax, ay, az): the vector from the camera to the point along the robot's axes
    bx = turn[0, 0] * x + turn[1, 0] * y + turn[2, 0] * z
    by = turn[0, 1] * x + turn[1, 1] * y + turn[2, 1] * z
    bz = turn[0, 2] * x + turn[1, 2] * y + turn[2, 2] * z
    ax, ay, az = bx - position[0], by - position[1], bz - position[2]
    depth = rotation[0, 2] * ax + rotation[1, 2] * ay + rotation[2, 2] * az
    u, v, by_u, by_v = pixel(
        k,
        rotation[0, 0] * ax + rotation[1, 0] * ay + rotation[2, 0] * az,
        rotation[0, 1] * ax + rotation[1, 1] * ay + rotation[2, 1] * az,
        depth,
    )
    for r in range(2):
        d = by_u if r == 0 else by_v
        g0 = rotation[0, 0] * d[0] + rotation[0, 1] * d[1] + rotation[0, 2] * d[2]
        g1 = rotation[1, 0] * d[0] + rotation[1, 1] * d[1] + rotation[1, 2] * d[2]
        g2 = rotation[2, 0] * d[0] + rotation[2, 1] * d[1] + rotation[2, 2] * d[2]
        e0 = turn[0, 0] * g0 + turn[0, 1] * g1 + turn[0, 2] * g2
        e1 = turn[1, 0] * g0 + turn[1, 1] * g1 + turn[1, 2] * g2
        e2 = turn[2, 0] * g0 + turn[2, 1] * g1 + turn[2, 2] * g2
        jacobian[r, 0], jacobian[r, 1], jacobian[r, 2] = -e0, -e1, e0 * y - e1 * x
        # second-order term: a change of the tilt rotates the robot about axes that are rotated by half of the tilt
        about = 0.5 * (g0 * by - g1 * bx)
        jacobian[r, TILT] = g1 * bz - g2 * by + about * tilt[1]
        jacobian[r, TILT + 1] = g2 * bx - g0 * bz - about * tilt[0]
        jacobian[r, POINT], jacobian[r, POINT + 1], jacobian[r, POINT + 2] = c * e0 - s * e1, s * e0 + c * e1, e2
        jacobian[r, CONSTANTS], jacobian[r, CONSTANTS + 1], jacobian[r, CONSTANTS + 2] = -g0, -g1, -g2
        jacobian[r, CONSTANTS + 3] = g1 * az - g2 * ay
        jacobian[r, CONSTANTS + 4] = g2 * ax - g0 * az
        jacobian[r, CONSTANTS + 5] = g0 * ay - g1 * ax
        jacobian[r, CONSTANTS + 6] = u - k[2] if r == 0 else v - k[3]  # by the logarithm of the focal length
        jacobian[r, CONSTANTS + 7] = 0.0
    return u, v, depth


@compiled(error_model="numpy")
def linearize(camera: tuple[Lens, Array, Array], pose: Array, points: Array) -> tuple[Array, Array]:
    """Return the pixels (K, 2) of world ``points`` (K, 3) from a level robot at ``pose`` (3,). Also returns their
    Jacobians (K, 2, WIDTH) by pose, tilt, point and camera constants. ``camera``: lens, position and rotation in the
    robot frame."""
    pixels, jacobian = np.empty((len(points), 2)), np.empty((len(points), 2, WIDTH))
    level, upright = np.zeros(2), np.eye(3)
    for i in range(len(points)):
        pixels[i, 0], pixels[i, 1], _ = project_planar(camera, pose, level, upright, points[i], jacobian[i])
    return pixels, jacobian


@compiled(error_model="numpy")
def turned(roll: float, pitch: float) -> Array:
    """Return the rotation (3, 3) of a tilted robot: the exponential of the rotation vector (roll, pitch, 0) [rad]."""
    angle = math.sqrt(roll * roll + pitch * pitch)
    a, b = (math.sin(angle) / angle, (1.0 - math.cos(angle)) / (angle * angle)) if angle > 1e-6 else (1.0, 0.5)
    turn = np.empty((3, 3))
    turn[0, 0], turn[1, 1], turn[2, 2] = 1.0 - b * pitch * pitch, 1.0 - b * roll * roll, 1.0 - b * angle * angle
    turn[0, 1] = turn[1, 0] = b * roll * pitch
    turn[0, 2], turn[2, 0], turn[1, 2], turn[2, 1] = a * pitch, -a * pitch, -a * roll, a * roll
    return turn


@compiled(error_model="numpy")
def whiten(
    k: Lens,
    position: Array,
    rotation: Array,
    poses: Array,
    tilts: Array,
    points: Array,
    measured: Array,
    sigma: float,
    robust: float,
) -> tuple[Array, Array, Array]:
    """Linearise the reprojection errors of N measured pixels.

    ``k``, ``position``, ``rotation``: the lens, and the camera's pose in the robot frame.
    ``poses`` (N, 3), ``tilts`` (N, 2) [rad], ``points`` (N, 3): the robot's pose, its roll and pitch, and the world
    point of each measurement. ``measured`` (N, 2): the measured pixels. ``sigma`` [px]: the pixel noise.
    ``robust``: the scale of Huber's loss in standard deviations.

    Returns whitened residuals (N, 2) with robust weights, their Jacobian (N, 2, WIDTH), and the squared norms (N,) of
    the residuals without robust weights. The Jacobian's columns are pose, tilt, point and camera constants.
    """
    n = len(measured)
    residual, jacobian, squared = np.empty((n, 2)), np.empty((n, 2, WIDTH)), np.zeros(n)
    for i in range(n):
        at = poses[i], tilts[i], points[i], measured[i]
        squared[i] = linearize_one((k, position, rotation), at, sigma, robust, residual[i], jacobian[i])
    return residual, jacobian, squared


@compiled(error_model="numpy")
def linearize_one(
    camera: tuple[Lens, Array, Array],
    at: tuple[Array, Array, Array, Array],
    sigma: float,
    robust: float,
    residual: Array,
    jacobian: Array,
) -> float:
    """Linearise the reprojection error of one pixel, as :func:`whiten` does. ``camera``: lens, position, rotation.
    ``at``: pose, tilt, point and measured pixel. ``sigma`` [px]: noise of the pixel. ``robust``: scale of Huber's loss.
    Writes the whitened ``residual`` (2,) and ``jacobian`` (2, WIDTH). Returns the squared norm of the residual without
    robust weight."""
    pose, tilt, point, measured = at
    u, v, depth = project_planar(camera, pose, tilt, turned(tilt[0], tilt[1]), point, jacobian)
    residual[0], residual[1] = (u - measured[0]) / sigma, (v - measured[1]) / sigma
    squared: float = residual[0] * residual[0] + residual[1] * residual[1]
    scale = math.sqrt(huber_weight(squared, robust)) / sigma
    if depth < NEAREST:
        squared, scale = 2.0 * BEHIND * BEHIND, 0.0
        residual[0] = residual[1] = BEHIND
    weight = math.sqrt(huber_weight(squared, robust))
    for r in range(2):
        residual[r] *= weight
        for j in range(WIDTH):
            jacobian[r, j] *= scale
    return squared


@compiled(error_model="numpy")
def log_likelihood(
    k: Lens,
    position: Array,
    rotation: Array,
    poses: Array,
    points: Array,
    pixels: Array,
    whiteners: Array,
    tilts: Array,
    scale: float,
    tempering: float,
) -> Array:
    """Return the robust, tempered log-likelihood (N,) of one image at N robot ``poses`` (N, 3), up to a constant.

    ``k``, ``position``, ``rotation``: the lens, and the camera's pose in the robot frame. ``points`` (K, 3): world
    points. ``pixels`` (K, 2): their measured pixels. ``whiteners`` (K, 2, 2): the matrices that whiten the pixel
    errors. ``tilts`` (K, 2, 2): the Jacobian of the whitened errors by roll and pitch in standard deviations.
    ``scale``: the scale of Huber's loss. ``tempering``: the exponent. The tilt of each pose is fitted by least squares,
    without robust weights.
    """
    place, count = mounting(position, rotation), len(points)
    px, py, c, s = poses[:, 0].copy(), poses[:, 1].copy(), np.cos(poses[:, 2]), np.sin(poses[:, 2])
    out = np.zeros(len(poses))
    xx, xy, yy = 1.0, 0.0, 1.0
    for i in range(count):
        for r in range(2):
            xx += tilts[i, r, 0] ** 2
            xy += tilts[i, r, 0] * tilts[i, r, 1]
            yy += tilts[i, r, 1] ** 2
    determinant = xx * yy - xy * xy
    xx, xy, yy = xx / determinant, xy / determinant, yy / determinant
    errors, roll, pitch = np.empty((2 * count, BLOCK)), np.empty(BLOCK), np.empty(BLOCK)
    for start in range(0, len(poses), BLOCK):
        rows = slice(start, start + BLOCK)
        bx, by, bc, bs, total = px[rows], py[rows], c[rows], s[rows], out[rows]
        roll[:] = 0.0
        pitch[:] = 0.0
        for i in range(count):
            x, y, z, seen_u, seen_v = points[i, 0], points[i, 1], points[i, 2], pixels[i, 0], pixels[i, 1]
            uu, uv, vu, vv = whiteners[i, 0, 0], whiteners[i, 0, 1], whiteners[i, 1, 0], whiteners[i, 1, 1]
            ru, pu, rv, pv = tilts[i, 0, 0], tilts[i, 0, 1], tilts[i, 1, 0], tilts[i, 1, 1]
            # the inner loops run over poses, so that the compiler vectorises them
            for n in range(len(total)):
                _, (lx, ly, lz) = in_camera(place, bc[n], bs[n], x - bx[n], y - by[n], z)
                u, v, _, _ = pixel(k, lx, ly, lz)
                a, b = uu * (u - seen_u) + uv * (v - seen_v), vu * (u - seen_u) + vv * (v - seen_v)
                errors[2 * i, n], errors[2 * i + 1, n] = a, b
                x_pull, y_pull = ru * a + rv * b, pu * a + pv * b
                roll[n] += xy * y_pull - yy * x_pull
                pitch[n] += xy * x_pull - xx * y_pull
        for n in range(len(total)):
            total[n] = -0.5 * (roll[n] * roll[n] + pitch[n] * pitch[n])
        for i in range(count):
            ru, pu, rv, pv = tilts[i, 0, 0], tilts[i, 0, 1], tilts[i, 1, 0], tilts[i, 1, 1]
            for n in range(len(total)):
                a = errors[2 * i, n] + ru * roll[n] + pu * pitch[n]
                b = errors[2 * i + 1, n] + rv * roll[n] + pv * pitch[n]
                total[n] -= huber_loss(a * a + b * b, scale)
    return tempering * out
