"""Outlier rejection among the points observed in an image: they must agree on one camera pose near the predicted one.

All points are accepted if they are jointly compatible with the prediction (Neira, Tardos, IEEE Transactions on Robotics
and Automation 17(6), 2001). Otherwise random samples of three points correct the prediction by a Kalman update each.
The correction with most inliers is used. (Civera, Grasa, Davison, Montiel, "1-Point RANSAC for EKF filtering", Journal
of Field Robotics 27(5), 2010, use samples of one point.) The predicted camera of a robot on a floor has a covariance of
rank 5. The correction changes only these five directions.
"""

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from factors import chi_squared, gaussian, positive
from factors.camera import kernels as reprojection_kernels
from factors.camera import model as reprojection
from factors.camera.kernels import Lens
from factors.camera.model import CameraModel
from factors.compiled import compiled
from factors.se2 import Array

Truths = NDArray[np.bool_]

FEWEST = 4  # least number of points that must agree: three points agree with some pose even if they are outliers
SAMPLE = 3  # points
HYPOTHESES, ROUND = 96, 16  # largest number of samples, and number of samples between two checks for termination
FAILURE = 1e-3  # largest probability that no sample without outliers was drawn
REACH = 10.0  # for corrections by samples, the standard deviations of the prediction are multiplied by this factor
FARTHEST = 3.0  # largest step of a correction, in standard deviations of the prediction times REACH
ROUNDING = 1e-12  # relative to the largest eigenvalue of a covariance: smaller ones count as zero
RIDGE = 1e-9  # regularisation of the information, for points very close to the camera
SAMPLE_GATE, GATE = 25.0, 13.8  # limits of the squared residuals of inliers, of a sample and of the final pose (99.9 %)
JOINT = 0.99  # probability of the joint compatibility test


@dataclass(frozen=True)
class CameraPose:
    """A camera pose. ``position`` (3,) [m]: in the world frame. ``rotation`` (3, 3): from the camera frame to the world
    frame. ``covariance`` (6, 6): of a perturbation in the camera frame, in the order rotation [rad], translation
    [m]."""

    position: Array
    rotation: Array
    covariance: Array


def are_compatible(model: CameraModel, camera: CameraPose, points: Array, pixels: Array, covariances: Array) -> bool:
    """True if K observed points together pass a chi-square test against the predicted camera pose ``camera``.

    ``model``: the calibration of the camera. ``points`` (K, 3) [m]: positions in the world frame. ``pixels`` (K, 2):
    the observed pixels. ``covariances`` (K, 2, 2) [px^2]: of the errors of these pixels, without the uncertainty of the
    pose.
    """
    arrays = (np.ascontiguousarray(part, dtype=float) for part in (points, pixels, covariances))
    try:
        joint = _joint(reprojection.lens_of(model), camera.position, camera.rotation, camera.covariance, *arrays)
    except np.linalg.LinAlgError:  # an extreme covariance: the caller then tests each point separately
        return False
    return bool(joint < chi_squared.quantile(JOINT, 2 * len(points)))


def agreeing(model: CameraModel, camera: CameraPose, points: Array, pixels: Array, covariances: Array) -> Truths:
    """Return a mask (K,) of the observed points that agree on one camera pose near the predicted pose ``camera``.

    ``model``: the calibration of the camera. ``points`` (K, 3) [m]: positions in the world frame. ``pixels`` (K, 2):
    the observed pixels. ``covariances`` (K, 2, 2) [px^2]: of their errors. All points are inliers if they are jointly
    compatible with the prediction. Otherwise at least :data:`FEWEST` points must agree, or none is an inlier.
    """
    count = len(points)
    if are_compatible(model, camera, points, pixels, covariances):
        return np.ones(count, dtype=bool)
    if count < FEWEST:
        return np.zeros(count, dtype=bool)
    whiteners, root = positive.whitener(covariances), _root(camera)
    position, rotation, squared = _best_of_samples(model, camera, points, pixels, whiteners, REACH * root)
    inside = squared < SAMPLE_GATE
    for _ in range(2):
        if np.count_nonzero(inside) < FEWEST:
            return np.zeros(count, dtype=bool)
        inliers = points[None, inside], pixels[None, inside], whiteners[None, inside]
        residual, jacobian = _whitened(model, position, rotation, *inliers)
        step = np.linalg.lstsq(jacobian[0] @ root, -residual[0], rcond=1e-9)[0]
        position, rotation = _perturbed(position, rotation, (root @ step)[None])
        inside = _squared(model, position, rotation, points, pixels, whiteners)[0] < GATE
    return np.asarray(inside) if np.count_nonzero(inside) >= FEWEST else np.zeros(count, dtype=bool)


def _best_of_samples(
    model: CameraModel, camera: CameraPose, points: Array, pixels: Array, whiteners: Array, root: Array
) -> tuple[Array, Array, Array]:
    """Return the camera pose that agrees best with all points, among corrections by random samples of points.

    Returns the position (1, 3), the rotation (1, 3, 3), and the squared whitened residuals (K,) of all points.
    ``camera``: the predicted pose. ``whiteners`` (K, 2, 2): matrices that whiten the pixel errors. ``root`` (6, 6): a
    square root of the prior covariance of a correction.
    """
    rng, count = np.random.default_rng(0), len(points)
    best: tuple[float, Array, Array, Array] | None = None
    tried = 0
    while tried < HYPOTHESES:
        rows = np.argsort(rng.random((ROUND, count)), axis=1)[:, :SAMPLE]
        position = np.repeat(camera.position[None], ROUND, axis=0)
        rotation = np.repeat(camera.rotation[None], ROUND, axis=0)
        total = np.zeros((ROUND, 6))
        for _ in range(3):
            # Gauss-Newton with whitened perturbations: their prior is a unit Gaussian
            residual, jacobian = _whitened(model, position, rotation, points[rows], pixels[rows], whiteners[rows])
            flat = jacobian @ root
            normal = flat.transpose(0, 2, 1) @ flat
            normal[:, range(6), range(6)] = 1.0 + (1.0 + RIDGE) * normal[:, range(6), range(6)]
            gradient = np.einsum("hij,hi->hj", flat, residual) + total
            step = -np.linalg.solve(normal, gradient[..., None])[..., 0]
            # if a sample has outliers, its correction may be arbitrarily large
            step *= np.minimum(1.0, FARTHEST / np.linalg.norm(step, axis=1))[:, None]
            total = total + step
            position, rotation = _perturbed(position, rotation, step @ root.T)
        squared = _squared(model, position, rotation, points, pixels, whiteners)
        costs = np.minimum(squared, SAMPLE_GATE).sum(axis=1)
        i = int(np.argmin(costs))
        if best is None or costs[i] < best[0]:
            best = float(costs[i]), position[[i]], rotation[[i]], squared[i]
        tried += ROUND
        share = np.count_nonzero(best[3] < SAMPLE_GATE) / count
        if (1.0 - share**SAMPLE) ** tried < FAILURE:
            break
    assert best is not None
    return best[1:]


@compiled(error_model="numpy")
def _joint(
    lens: Lens, position: Array, rotation: Array, covariance: Array, points: Array, pixels: Array, covariances: Array
) -> float:
    """Return the squared Mahalanobis distance of ``pixels`` (K, 2) from the predicted pixels of ``points`` (K, 3).
    ``covariance`` (6, 6): of the camera pose, rotation first. ``covariances`` (K, 2, 2): of the pixel errors."""
    predicted, jacobian, _ = reprojection_kernels.linearize_in_space(lens, position, rotation, points)
    information, pull, total = np.zeros((6, 6)), np.zeros((6, 1)), 0.0
    for i in range(len(points)):
        a, b, c = covariances[i, 0, 0], covariances[i, 0, 1], covariances[i, 1, 1]
        determinant = a * c - b * b
        u, v = predicted[i, 0] - pixels[i, 0], predicted[i, 1] - pixels[i, 1]
        wu, wv = (c * u - b * v) / determinant, (a * v - b * u) / determinant
        total += u * wu + v * wv
        for j in range(6):
            ju, jv = jacobian[i, 0, j], jacobian[i, 1, j]
            pull[j, 0] += ju * wu + jv * wv
            xu, xv = (c * ju - b * jv) / determinant, (a * jv - b * ju) / determinant
            for m in range(6):
                information[j, m] += xu * jacobian[i, 0, m] + xv * jacobian[i, 1, m]
    # this form of the matrix inversion lemma allows a singular covariance
    both = gaussian.product(information, covariance)
    for j in range(6):
        both[j, j] += 1.0
    drawn = gaussian.product(covariance, gaussian.solved(both, pull)[0])
    for j in range(6):
        total -= pull[j, 0] * drawn[j, 0]
    return total


def _root(camera: CameraPose) -> Array:
    """Return a matrix R (6, 6) with RR' equal to the covariance of the camera pose, which may be singular."""
    values, vectors = np.linalg.eigh(camera.covariance)
    # eigenvalues that are zero up to rounding errors must not add directions to the samples
    return np.asarray(vectors * np.sqrt(np.where(values > ROUNDING * values[-1], values, 0.0)))


def _perturbed(position: Array, rotation: Array, step: Array) -> tuple[Array, Array]:
    """Return positions (H, 3) and rotations (H, 3, 3) of H camera poses that are perturbed by ``step`` (H, 6). A
    perturbation is in the camera frame, rotation first."""
    shifted = position + (rotation @ step[:, 3:, None])[..., 0]
    return shifted, rotation @ scipy.spatial.transform.Rotation.from_rotvec(step[:, :3]).as_matrix()


def _whitened(
    model: CameraModel, position: Array, rotation: Array, points: Array, pixels: Array, whiteners: Array
) -> tuple[Array, Array]:
    """Return the whitened pixel residuals (H, 2S), predicted minus measured, for H camera poses, and their Jacobians.

    The Jacobians (H, 2S, 6) are derivatives by a perturbation of the pose. ``points`` (H, S, 3), ``pixels`` (H, S, 2):
    S observed points of each camera. ``whiteners`` (H, S, 2, 2): matrices that whiten the pixel errors.
    """
    count = len(position)
    local = (points - position[:, None]) @ rotation
    # a point in the camera frame is like a world point seen by a camera at the origin
    predicted, jacobian, _ = reprojection.linearize_in_space(model, np.zeros(3), np.eye(3), local.reshape(-1, 3))
    jacobian = whiteners @ jacobian.reshape(count, -1, 2, 6)
    residual = np.einsum("hkij,hkj->hki", whiteners, predicted.reshape(pixels.shape) - pixels)
    return residual.reshape(count, -1), jacobian.reshape(count, -1, 6)


def _squared(
    model: CameraModel, position: Array, rotation: Array, points: Array, pixels: Array, whiteners: Array
) -> Array:
    """Return the squared whitened pixel residuals (H, K) of K points for H camera poses. ``whiteners`` (K, 2, 2):
    matrices that whiten the pixel errors."""
    local = (points - position[:, None]) @ rotation
    predicted = reprojection.project(model, local.reshape(-1, 3)).reshape(*local.shape[:2], 2)
    error = np.einsum("kij,hkj->hki", whiteners, predicted - pixels)
    return np.asarray(np.einsum("hki,hki->hk", error, error))
