"""Bundle adjustment of points and cameras in one GTSAM graph.

The graph has projection factors with a Huber loss and a prior on each camera pose. It is solved by Levenberg-Marquardt (Triggs,
McLauchlan, Hartley, Fitzgibbon, "Bundle adjustment - a modern synthesis", 2000). Outliers are removed, and the remaining
observations are adjusted again. Covariances are computed by the Schur complement on the cameras, which are fewer than the points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
import scipy.sparse
from gtsam.symbol_shorthand import K, L, X

from factorgraph_loc.mapping.triangulation import NEAREST, Cameras, Tracks, reproject
from factorgraph_loc.vision.consensus import Truths
from factors.camera.model import CameraModel, undistorted
from factors.se2 import Array, Integers

ROUNDS = 3  # largest number of adjustments; outliers are removed after each one
# largest error of an inlier, in standard deviations of a pixel: after the first adjustment, and after later ones
LOOSE, OUTLIER = 6.0, 3.5
ITERATIONS = 20
RELATIVE, ABSOLUTE = 1e-4, 1e-4  # the optimization ends if the sum of squared errors decreases by less
FOCAL_SIGMA, ASPECT_SIGMA = 0.1, 0.005  # standard deviations of an unknown focal length and of fx / fy, relative
CENTRE_SIGMA = 0.01  # standard deviation of an unknown principal point, relative to the focal length
LENS_SIGMA = (0.1, 0.1, 0.003, 0.003)  # standard deviations of an unknown distortion
FIXED = 1e-5  # standard deviation of the known calibration constants
POINT_SIGMA = 1000.0  # m, prior standard deviation of a point
CHUNK = 500  # number of points in one computation of covariances, to limit the memory


@dataclass(frozen=True, eq=False)
class Bundle:
    """The result of a bundle adjustment with F cameras, T points and N observations.

    ``model``: the camera's calibration, adjusted if that was requested. ``cameras``: the adjusted poses. ``tracks``:
    the observations without outliers. ``points`` (T, 3) [m]: the adjusted positions of their points. ``old`` (T,): the
    index that each point had in the input. ``errors`` (N, 2) [px]: the residuals, predicted minus measured.
    ``camera_covariances`` (F, 6, 6): of perturbations in the cameras' own frames, rotation first. ``point_covariances``
    (T, 3, 3) [m^2]: of the points. Limitation: the uncertainty of the calibration is not included.
    """

    model: CameraModel
    cameras: Cameras
    tracks: Tracks
    points: Array
    old: Integers
    errors: Array
    camera_covariances: Array
    point_covariances: Array


def adjust(
    model: CameraModel,
    cameras: Cameras,
    covariances: Array,
    tracks: Tracks,
    points: Array,
    *,
    focal: bool = False,
    lens: bool = False,
    progress: Callable[[float], None] = lambda _: None,
) -> Bundle:
    """Return the result of a bundle adjustment of points and camera poses, and optionally of the camera's calibration.

    ``cameras``, ``covariances`` (F, 6, 6): the prior poses and their covariances, in the cameras' own frames, rotation
    first. ``tracks``: the observations. ``points`` (T, 3) [m]: the initial positions. ``focal``: True to estimate also
    the focal lengths. ``lens``: True to estimate also the focal lengths, the principal point and the distortion
    (Brown's model). ``progress``: a function that is called with the completed fraction, 0 to 1. Raises RuntimeError if
    the graph cannot be solved.
    """
    old = np.arange(len(points))
    fixed = gtsam.NonlinearFactorGraph()
    for i, covariance in enumerate(covariances):
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        fixed.add(gtsam.PriorFactorPose3(X(i), pose3(cameras.positions[i], cameras.rotations[i]), noise))
    if focal or lens:
        noise = gtsam.noiseModel.Gaussian.Covariance(_unknown_constants(model, lens=lens))
        fixed.add(gtsam.PriorFactorCal3DS2(K(0), model.calibration(), noise))
    for i in range(ROUNDS):
        model, cameras, points = _optimized(model, fixed, cameras, tracks, points, constants=focal or lens)
        right = agreeing(model, cameras, tracks, points, LOOSE if i == 0 else OUTLIER)
        progress((i + 1) / ROUNDS)
        if right.all() and i > 0:
            break
        tracks, left = tracks.kept(right)
        points, old = points[left], old[left]
    errors = reproject(model, cameras, points, tracks)[0]
    information = np.asarray(np.linalg.inv(covariances), dtype=float)
    of_cameras, of_points = marginals(model, cameras, information, tracks, points)
    return Bundle(model, cameras, tracks, points, old, errors, of_cameras, of_points)


def agreeing(model: CameraModel, cameras: Cameras, tracks: Tracks, points: Array, limit: float) -> Truths:
    """Return a mask (N,) of the inliers: observations with a residual of at most ``limit`` standard deviations. The
    only inlier of a point is also excluded, because one observation does not determine a point."""
    errors, _, _, depths = reproject(model, cameras, points, tracks)
    right = (np.sum(errors**2, axis=1) < (limit * model.sigma) ** 2) & (depths > NEAREST)
    count = np.bincount(tracks.track[right], minlength=tracks.count)
    return np.asarray(right & (count >= 2)[tracks.track])


def marginals(
    model: CameraModel, cameras: Cameras, information: Array, tracks: Tracks, points: Array
) -> tuple[Array, Array]:
    """Return the marginal covariances of the cameras (F, 6, 6) and of the points (T, 3, 3), linearised at ``cameras``
    and ``points``. ``tracks``: the observations. ``information`` (F, 6, 6): the inverse covariances of the cameras'
    prior poses."""
    count, total = len(cameras), tracks.count
    _, by_camera, by_point, _ = reproject(model, cameras, points, tracks)
    by_camera, by_point = by_camera / model.sigma, by_point / model.sigma
    of_points = np.repeat(POINT_SIGMA**-2 * np.eye(3)[None], total, axis=0)
    np.add.at(of_points, tracks.track, np.einsum("nij,nik->njk", by_point, by_point))
    of_cameras = np.array(information)
    np.add.at(of_cameras, tracks.frame, np.einsum("nij,nik->njk", by_camera, by_camera))
    inverse = np.linalg.inv(of_points)
    # for each observation, minus the derivative (3, 6) of the point's optimal position by the perturbation of the camera
    gains = np.einsum("nij,nkj,nkl->nil", inverse[tracks.track], by_point, by_camera)
    gain = _sparse(gains, tracks.track, tracks.frame, (3 * total, 6 * count))
    cross = _sparse(np.einsum("nki,nkj->nij", by_camera, by_point), tracks.frame, tracks.track, (6 * count, 3 * total))
    schur = -(cross @ gain).toarray()
    for i in range(count):
        schur[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] += of_cameras[i]
    joint = np.linalg.inv(schur)
    for begin in range(0, total, CHUNK):
        block = gain[3 * begin : 3 * (begin + CHUNK)]
        moved, dense = (part.reshape(-1, 3, 6 * count) for part in (block @ joint, block.toarray()))
        inverse[begin : begin + CHUNK] += moved @ dense.transpose(0, 2, 1)
    places = 6 * np.arange(count)[:, None] + np.arange(6)
    return joint[places[:, :, None], places[:, None, :]], 0.5 * (inverse + inverse.transpose(0, 2, 1))


def pose3(position: Array, rotation: Array) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3(rotation), position)


def robust_noise(model: CameraModel) -> Any:
    """Return GTSAM's noise model of a pixel measurement, with a Huber loss."""
    huber = gtsam.noiseModel.mEstimator.Huber.Create(model.robust)
    return gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Isotropic.Sigma(2, model.sigma))


def _unknown_constants(model: CameraModel, *, lens: bool) -> Array:
    """Return the prior covariance (9, 9) of fx, fy, skew, cx, cy, k1, k2, p1, p2. ``lens``: False if only fx and fy are
    unknown."""
    covariance = FIXED**2 * np.eye(9)
    focal = np.array((model.fx, model.fy))
    covariance[:2, :2] += FOCAL_SIGMA**2 * np.outer(focal, focal) + ASPECT_SIGMA**2 * np.diag(focal**2)
    if lens:
        centre = CENTRE_SIGMA * focal
        covariance[range(3, 9), range(3, 9)] = np.square((*centre, *LENS_SIGMA))
    return covariance


def _optimized(
    model: CameraModel,
    fixed: gtsam.NonlinearFactorGraph,
    cameras: Cameras,
    tracks: Tracks,
    points: Array,
    *,
    constants: bool,
) -> tuple[CameraModel, Cameras, Array]:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.push_back(fixed)
    pinhole, pixels = model, tracks.pixels
    if not model.is_brown:  # GTSAM does not support this distortion: adjust undistorted pixels of a pinhole camera
        pinhole = replace(model, distortion=(0.0,) * 4, fisheye=False)
        pixels = undistorted(model, pixels) * (model.fx, model.fy) + (model.cx, model.cy)
    calibration = pinhole.calibration()
    for i in range(len(cameras)):
        values.insert(X(i), pose3(cameras.positions[i], cameras.rotations[i]))
    for k, point in enumerate(points):
        values.insert(L(k), point)
    noise = robust_noise(model)
    rows = zip(tracks.frame.tolist(), tracks.track.tolist(), pixels, strict=True)
    if constants:
        values.insert(K(0), calibration)
        for i, k, pixel in rows:
            graph.add(gtsam.GeneralSFMFactor2Cal3DS2(pixel, noise, X(i), L(k), K(0)))
    else:
        for i, k, pixel in rows:
            graph.add(gtsam.GenericProjectionFactorCal3DS2(pixel, noise, X(i), L(k), calibration, False, False))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(ITERATIONS)
    parameters.setRelativeErrorTol(RELATIVE)
    parameters.setAbsoluteErrorTol(ABSOLUTE)
    solution = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    if constants:
        fx, fy, _, cx, cy, *distortion = solution.atCal3DS2(K(0)).vector().tolist()
        model = replace(model, fx=fx, fy=fy, cx=cx, cy=cy, distortion=tuple(distortion))
    poses = [solution.atPose3(X(i)) for i in range(len(cameras))]
    adjusted = Cameras(np.array([p.translation() for p in poses]), np.array([p.rotation().matrix() for p in poses]))
    return model, adjusted, np.array([solution.atPoint3(L(k)) for k in range(len(points))]).reshape(-1, 3)


def _sparse(blocks: Array, rows: Integers, columns: Integers, shape: tuple[int, int]) -> Any:
    """Return a sparse block matrix of ``shape``. ``blocks`` (N, r, c): its blocks. ``rows``, ``columns`` (N,): their
    block rows and block columns. Blocks with the same row and column are added."""
    _, height, width = blocks.shape
    i = np.broadcast_to(height * rows[:, None, None] + np.arange(height)[:, None], blocks.shape)
    j = np.broadcast_to(width * columns[:, None, None] + np.arange(width), blocks.shape)
    return scipy.sparse.csr_matrix((blocks.ravel(), (i.ravel(), j.ravel())), shape=shape)
