"""Camera pose from matched map points, without a prediction.

Each random sample of three points yields up to four poses. The pose with most inliers is refined with all its inliers
(Universal RANSAC: Raguram, Chum, Pollefeys, Matas, Frahm, PAMI 35(8), 2013, as in OpenCV). For a robot on the floor
only x, y and heading are refined. A camera pose is rejected if the robot would be tilted or not on the floor.

In a large map an image is compared only with the few most similar keyframes. A keyframe is described by the differences
between its descriptors and the words of a small vocabulary (VLAD: Jegou, Douze, Schmid, Perez, CVPR 2010). Each word is
normalised separately (Arandjelovic, Zisserman, CVPR 2013).
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace

import cv2
import numpy as np
import scipy
from scipy.cluster.vq import kmeans2, vq

from factorgraph_loc.vision.consensus import FEWEST, GATE, CameraPose, Truths
from factorgraph_loc.vision.keypoints import Descriptors, Integers
from factors import positive, se2
from factors.camera import model as reprojection
from factors.camera.factor import ReprojectionFactor
from factors.camera.model import CameraModel
from factors.robust import huber_weight
from factors.se2 import Array

REACH = 3.0  # a pixel is an inlier of a sample if its error is below this number of standard deviations
CONFIDENCE, MOST_SAMPLES = 0.9999, 5000
REFINEMENTS = 10  # largest number of iterations
CONVERGED = 1e-6  # m, rad: step below which the refinement ends
# m, rad: largest height and tilt of the estimated pose of a robot on the floor, due to errors of the estimate and of the mounting
LARGEST_HEIGHT, LARGEST_TILT = 0.3, 0.15
LARGEST_SIGMA = 0.5  # m, rad: a pose with larger standard deviations is not accepted
WORDS = 64  # words of the vocabulary
SAMPLE, ROUNDS = 4000, 6  # number of descriptors for learning the vocabulary, and iterations of Lloyd's algorithm
NEAREST = 20  # number of keyframes that an image is compared with


@dataclass(frozen=True)
class Resection:
    """A camera pose, computed from K points. ``camera``: the pose. ``inliers`` (K,): mask of the points that agree with
    it."""

    camera: CameraPose
    inliers: Truths


@dataclass(frozen=True)
class FoundOnFloor:
    """The pose of a robot on the floor, computed from K points.

    ``pose`` (3,): x, y [m] and heading [rad]. ``covariance`` (3, 3): of a perturbation in the robot's frame.
    ``inliers`` (K,): mask of the points that agree with the pose.
    """

    pose: Array
    covariance: Array
    inliers: Truths


def located(model: CameraModel, points: Array, pixels: Array, covariances: Array | None = None) -> Resection | None:
    """Return the camera pose computed from K observed points, without a prediction, and a mask of the inliers.

    ``model``: the calibration of the camera. ``points`` (K, 3) [m]: positions in the world frame. ``pixels`` (K, 2):
    their observed pixels. ``covariances`` (K, 3, 3) [m^2]: of the positions, None if these are exact. Returns None if
    the points do not determine the pose.
    """
    if len(points) < FEWEST:
        return None
    parameters = cv2.UsacParams()
    parameters.confidence, parameters.maxIterations = CONFIDENCE, MOST_SAMPLES
    parameters.threshold = REACH * model.sigma
    parameters.score, parameters.sampler = cv2.SCORE_METHOD_MSAC, cv2.SAMPLING_UNIFORM
    parameters.loMethod = cv2.LOCAL_OPTIM_INNER_LO
    parameters.randomGeneratorState, parameters.isParallel = 0, False
    ideal = reprojection.undistorted(model, pixels) * (model.fx, model.fy) + (model.cx, model.cy)
    try:
        is_solved, _, turn, shift, inliers = cv2.solvePnPRansac(
            np.ascontiguousarray(points), ideal, model.matrix(), None, params=parameters
        )
    except cv2.error:  # degenerate samples
        return None
    if not is_solved or inliers is None or not np.all(np.isfinite(turn)) or not np.all(np.isfinite(shift)):
        return None
    rotation = scipy.spatial.transform.Rotation.from_rotvec(turn.ravel()).as_matrix().T
    return _refined(model, -rotation @ shift.ravel(), rotation, points, pixels, covariances)


def on_floor(
    model: CameraModel, camera: CameraPose, points: Array, pixels: Array, covariances: Array | None = None
) -> FoundOnFloor | None:
    """Return the planar pose of a robot on the floor from K observed points by least squares.

    ``model``: the calibration of the camera and its position on the robot. ``camera``: the initial pose of the camera.
    ``points`` (K, 3) [m]: positions in the world frame. ``pixels`` (K, 2): their observed pixels. ``covariances`` (K,
    3, 3) [m^2]: of the positions, None if these are exact. Returns None if ``camera`` means a tilted robot or one above
    the floor. Also returns None if the points do not determine the planar pose.
    """
    position, rotation = reprojection.carrier(model, camera.position, camera.rotation)
    tilt = math.acos(float(np.clip(rotation[2, 2], -1.0, 1.0)))
    if abs(position[2]) > LARGEST_HEIGHT or tilt > LARGEST_TILT:
        return None
    pose = np.array((position[0], position[1], math.atan2(rotation[1, 0], rotation[0, 0])))
    factor = ReprojectionFactor(model, points, pixels, point_covariances=covariances)
    information = np.zeros((3, 3))
    for _ in range(REFINEMENTS):
        residual, (jacobian,) = factor.linearize([pose])
        information = jacobian.T @ jacobian
        if np.linalg.eigvalsh(information)[0] < LARGEST_SIGMA**-2:
            return None
        step: Array = -np.asarray(np.linalg.solve(information, jacobian.T @ residual), dtype=float)
        pose = se2.compose(pose, se2.exp(step))
        if np.abs(step).max() < CONVERGED:
            break
    error, _ = factor.levelled([pose])
    inliers = np.sum(error**2, axis=1) < GATE
    if np.count_nonzero(inliers) < FEWEST:
        return None
    return FoundOnFloor(pose, np.asarray(np.linalg.inv(information), dtype=float), np.asarray(inliers))


def _refined(
    model: CameraModel, position: Array, rotation: Array, points: Array, pixels: Array, covariances: Array | None
) -> Resection | None:
    information = np.zeros((6, 6))
    for i in range(REFINEMENTS):
        predicted, by_camera, by_point = reprojection.linearize_in_space(model, position, rotation, points)
        residual = predicted - pixels
        noise = np.broadcast_to(model.sigma**2 * np.eye(2), (len(points), 2, 2))
        if covariances is not None:
            noise = noise + by_point @ covariances @ by_point.transpose(0, 2, 1)
        whitener = positive.whitener(noise)
        residual = np.einsum("kij,kj->ki", whitener, residual)
        squared = np.sum(residual**2, axis=1)
        # gross outliers get no weight, because the Huber loss alone would not remove their effect
        weight = np.where(squared < (2.0 * GATE if i < 3 else GATE), huber_weight(squared, model.robust), 0.0)
        by_camera = whitener @ by_camera
        information = np.einsum("k,kri,krj->ij", weight, by_camera, by_camera)
        if np.linalg.eigvalsh(information)[0] < LARGEST_SIGMA**-2:
            return None
        step = -np.linalg.solve(information, np.einsum("k,kri,kr->i", weight, by_camera, residual))
        position = position + rotation @ step[3:]
        rotation = rotation @ scipy.spatial.transform.Rotation.from_rotvec(step[:3]).as_matrix()
        if i >= 3 and np.abs(step).max() < CONVERGED:
            break
    inliers = squared < GATE
    if np.count_nonzero(inliers) < FEWEST:
        return None
    covariance = np.asarray(np.linalg.inv(information), dtype=float)
    return Resection(CameraPose(position, rotation, covariance), np.asarray(inliers))


def found_on_floor(
    model: CameraModel, points: Array, pixels: Array, covariances: Array | None = None
) -> FoundOnFloor | None:
    """Return the planar pose of a robot on the floor from K observed points, without a prediction, and reject outliers.

    ``model``: the calibration of the camera and its position on the robot. ``points`` (K, 3) [m]: positions in the
    world frame. ``pixels`` (K, 2): their observed pixels. ``covariances`` (K, 3, 3) [m^2]: of the positions, None if
    these are exact. Returns None if the points do not determine a pose on the floor.
    """
    resection = located(model, points, pixels, covariances)
    if resection is None:
        return None
    rows = resection.inliers
    planar = on_floor(
        model, resection.camera, points[rows], pixels[rows], None if covariances is None else covariances[rows]
    )
    if planar is None:
        return None
    inliers = rows.copy()
    inliers[rows] = planar.inliers
    return replace(planar, inliers=inliers)


class KeyframeIndex:
    """An index of the keyframes of a map, to find the keyframes that are most similar to an image.

    A keyframe is an image that was used to make the map. ``descriptors`` (M, D): of all M features in these images.
    ``seen_from`` (M, 3): the camera position of each feature's image. Equal camera positions mean the same keyframe.
    """

    def __init__(self, descriptors: Descriptors, seen_from: Array) -> None:
        _, self._of = np.unique(seen_from, axis=0, return_inverse=True)
        self._of = self._of.ravel()
        values = as_numbers(descriptors)
        sample = values[np.linspace(0, len(values) - 1, min(SAMPLE, len(values))).astype(np.int64)]
        begin = sample[np.linspace(0, len(sample) - 1, min(WORDS, len(sample))).astype(np.int64)]
        with warnings.catch_warnings(action="ignore"):  # words that are nearest to no descriptor stay unchanged
            self._words, _ = kmeans2(sample, begin, ROUNDS, minit="matrix")
        self._descriptions = self._vlad_vectors(values, self._of)

    def __len__(self) -> int:
        return len(self._descriptions)

    def views(self, descriptors: Descriptors) -> Integers:
        """Return the indices (V,) of features in the images of the map that are most similar to a new image.
        ``descriptors`` (N, D): of the new image. The result has all features of the :data:`NEAREST` most similar
        keyframes."""
        (description,) = self._vlad_vectors(as_numbers(descriptors), np.zeros(len(descriptors), dtype=np.int64))
        alike = np.zeros(len(self), dtype=bool)
        alike[np.argsort(-(self._descriptions @ description), kind="stable")[:NEAREST]] = True
        return np.flatnonzero(alike[self._of])

    def _vlad_vectors(self, values: Array, of: Integers) -> Array:
        """Return the VLAD vectors (K, WORDS * D) of K images. Similar images have similar vectors. ``values`` (M, D):
        descriptors of all images. ``of`` (M,): the index of each descriptor's image."""
        (nearest, _), count = vq(values, self._words), len(self._words)
        descriptions = np.zeros((int(of.max()) + 1, count, values.shape[1]))
        np.add.at(descriptions, (of, nearest), values - self._words[nearest])
        descriptions /= np.maximum(np.linalg.norm(descriptions, axis=2), 1e-9)[..., None]
        flat = descriptions.reshape(len(descriptions), -1)
        return np.asarray(flat / np.maximum(np.linalg.norm(flat, axis=1), 1e-9)[:, None])


def as_numbers(descriptors: Descriptors) -> Array:
    """Return descriptors as floating-point numbers. Each bit of a binary descriptor (``uint8``) becomes a number."""
    if descriptors.dtype == np.uint8:
        descriptors = np.unpackbits(descriptors, axis=1)
    return np.asarray(descriptors, dtype=float)
