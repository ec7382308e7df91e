"""A pinhole camera with lens distortion on a robot: projection and its derivatives.

The axes of the camera frame are z forward, x right, y down. The direction of a point is (x, y) at depth 1. The lens
distorts this direction, and the pixel is (fx x + cx, fy y + cy) of the distorted direction. The distortion has radial
and tangential terms (k1, k2, p1, p2) after Brown, "Close-range camera calibration", Photogrammetric Engineering 37(8),
1971, as in OpenCV and ``gtsam.Cal3DS2``. Rational polynomials and fisheye lenses (Kannala and Brandt, 2006) are also as
in OpenCV. Pixel noise is Gaussian with Huber's loss (1964) against outliers.

The distortion polynomial is used up to the radius where it stops growing, because it would fold the image beyond. Directions beyond
this radius are extrapolated radially, so that they do not appear in the image. Points that are behind the camera, or nearer than
:data:`~factors.camera.kernels.NEAREST`, are projected as if at that depth. All results are therefore finite.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import gtsam
import numpy as np

from factors import positive, se2
from factors.camera import kernels as reprojection_kernels
from factors.camera.kernels import CONSTANTS, POINT, TILT, Lens
from factors.compiled import compiled
from factors.se2 import Array

# The constants of a camera that can be estimated: corrections of its position [m] along the robot's axes, small rotations [rad]
# about these axes, the logarithm of the focal length, and the time offset [s] of images relative to their timestamps.
PARAMETERS = ("x", "y", "z", "roll", "pitch", "yaw", "focal", "time_offset")
FOCAL, TIME_OFFSET = PARAMETERS.index("focal"), PARAMETERS.index("time_offset")
WIDEST = 4.0  # largest x^2 + y^2 for which a distortion polynomial is used (63 degrees off the axis)
WIDEST_FISHEYE = 400.0  # the same limit for a fisheye lens (87 degrees)
STEPS = 1000  # number of radii at which the slope of a distortion is checked
GRID = 33  # `folded` checks a lens at this many rows and columns of pixels
# The indices of x, y and heading of a level robot in the perturbation (6,) of a pose in space, rotation before translation.
PLANAR = [3, 4, 2]
NONE = 1e-9  # the undistortion of a direction has failed if its remaining error is larger

# The rotation of a forward-facing camera. The columns are the camera's axes in the robot frame (x forward, y left, z up).
FORWARD: Array = np.array(((0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)))


@dataclass(frozen=True, slots=True)
class CameraModel:
    """A camera, its pose on the robot, and its noise.

    ``fx``, ``fy``, ``cx``, ``cy`` [px]: focal lengths and principal point.
    ``width``, ``height`` [px]: size of the images.
    ``distortion``: (k1, k2, p1, p2), or (k1, k2, p1, p2, k3, k4, k5, k6), or (k1, k2, k3, k4) of a fisheye lens, as in
    OpenCV. ``position`` (3,) [m], ``rotation`` (3, 3): pose of the camera in the robot frame.
    ``sigma`` [px]: standard deviation of each pixel coordinate.
    ``robust``: scale of Huber's loss in standard deviations.
    ``tempering``: exponent of the likelihood, below 1 if errors are correlated between images.
    ``tilt`` [rad]: standard deviation of the robot's roll and pitch, because floors are not exactly level. All points
    of an image have the same roll and pitch.
    ``fisheye``: True for a fisheye lens.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    position: Array = field(default_factory=lambda: np.zeros(3))
    rotation: Array = field(default_factory=FORWARD.copy)
    sigma: float = 1.0
    robust: float = 2.0
    tempering: float = 1.0
    tilt: float = 0.005
    fisheye: bool = False

    def intrinsics(self) -> Array:
        """The focal lengths, principal point and distortion as one array, in this order. A fisheye lens has 1 as an
        additional last element."""
        return np.array((self.fx, self.fy, self.cx, self.cy, *self.distortion, *((1.0,) if self.fisheye else ())))

    def matrix(self) -> Array:
        """Return the camera matrix (3, 3), made of focal lengths and principal point [px]."""
        return np.array(((self.fx, 0.0, self.cx), (0.0, self.fy, self.cy), (0.0, 0.0, 1.0)))

    @property
    def is_brown(self) -> bool:
        """True if the lens has Brown's distortion (k1, k2, p1, p2)."""
        return len(self.distortion) == 4 and not self.fisheye

    def calibration(self) -> gtsam.Cal3DS2:
        """Return intrinsics and distortion as a GTSAM object. Only for Brown's distortion, see :attr:`is_brown`."""
        return gtsam.Cal3DS2(self.fx, self.fy, 0.0, self.cx, self.cy, *self.distortion)

    def contains(self, pixels: Array, margin: float = 0.0) -> Any:
        """Return a mask (...), True where ``pixels`` (..., 2) are in the image or at most ``margin`` [px] outside."""
        u, v = pixels[..., 0], pixels[..., 1]
        inside = (u >= -0.5 - margin) & (u <= self.width - 0.5 + margin)
        return inside & (v >= -0.5 - margin) & (v <= self.height - 0.5 + margin)


def mounting(roll: float, pitch: float, yaw: float) -> Array:
    """Return the rotation (3, 3) of a camera in the robot frame from three angles [rad].

    A forward-facing camera is rotated about the fixed axes of the robot: by ``roll`` about x, then by ``pitch`` about y
    (positive is down), then by ``yaw`` about z (positive is left).
    """
    return np.asarray(gtsam.Rot3.RzRyRx(roll, pitch, yaw).matrix() @ FORWARD)


def angles_of_camera(rotation: Array) -> tuple[float, float, float]:
    """Return roll, pitch and yaw [rad] of a camera from its ``rotation`` (3, 3). The inverse of :func:`mounting`."""
    roll, pitch, yaw = gtsam.Rot3(rotation @ FORWARD.T).xyz().tolist()
    return roll, pitch, yaw


def recalibrated(model: CameraModel, changes: Array) -> CameraModel:
    """Return the model with corrected constants. ``changes`` (8,): corrections of :data:`PARAMETERS`. The time offset
    is ignored, because it is not part of the model."""
    turn = np.asarray(gtsam.Rot3.Expmap(changes[3:6]).matrix())
    scale = math.exp(float(changes[FOCAL]))
    return replace(
        model,
        fx=scale * model.fx,
        fy=scale * model.fy,
        position=model.position + changes[:3],
        rotation=turn @ model.rotation,
    )


def project(model: CameraModel, points: Array) -> Array:
    """Return the pixels (K, 2) of ``points`` (K, 3), which are given in the camera frame."""
    return np.asarray(reprojection_kernels.project(lens_of(model), np.ascontiguousarray(points, dtype=float))[0])


def in_camera(model: CameraModel, pose: Array, points: Array) -> Array:
    """Transform world ``points`` (K, 3) to the camera frame (K, 3). The robot is at the planar ``pose`` (3,)."""
    local = np.empty_like(points, dtype=float)
    local[:, :2] = se2.transform_to(pose, points[:, :2])
    local[:, 2] = points[:, 2]
    return np.asarray((local - model.position) @ model.rotation)


def mounted(model: CameraModel, position: Array, rotation: Array) -> tuple[Array, Array]:
    """Return the camera's position (3,) and rotation (3, 3) in the world, from the robot's ``position`` (3,) and
    ``rotation`` (3, 3)."""
    return position + rotation @ model.position, rotation @ model.rotation


def lift(model: CameraModel) -> Array:
    """Return the Jacobian (6, 6) of the camera's perturbation by the robot's perturbation. Each perturbation is in the
    body's own frame, with rotation before translation."""
    x, y, z = model.position
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = jacobian[3:, 3:] = model.rotation.T
    jacobian[3:, :3] = -model.rotation.T @ np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))
    return jacobian


def carrier(model: CameraModel, position: Array, rotation: Array) -> tuple[Array, Array]:
    """Return the robot's position (3,) and rotation (3, 3) in the world, from the camera's ``position`` (3,) and
    ``rotation`` (3, 3) in the world. The inverse of :func:`mounted`."""
    turn = rotation @ model.rotation.T
    return position - turn @ model.position, turn


def camera_pose(model: CameraModel, pose: Array, tilt: Array | None = None) -> tuple[Array, Array]:
    """Return the camera's position (3,) and rotation (3, 3) in the world, from the robot's planar ``pose`` (3,).

    ``tilt`` (2,) [rad]: the robot's roll and pitch, a rotation vector along its x and y axes. None for a level robot.
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    turn = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
    if tilt is not None:
        turn = turn @ gtsam.Rot3.Expmap(np.append(tilt, 0.0)).matrix()
    return mounted(model, np.array((pose[0], pose[1], 0.0)), turn)


def predict(model: CameraModel, pose: Array, points: Array) -> tuple[Array, Array]:
    """Predict the pixels (K, 2) of world ``points`` (K, 3) from the robot's planar ``pose`` (3,). Also returns the
    depths (K,) [m], which are negative behind the camera."""
    local = in_camera(model, pose, points)
    return project(model, local), local[:, 2]


def undistorted(model: CameraModel, pixels: Array) -> Array:
    """Return the directions (K, 2) of ``pixels`` (K, 2), as (x, y) at depth 1 in the camera frame. The inverse of
    :func:`project`, computed by Newton's method."""
    distorted = (np.asarray(pixels, dtype=float) - (model.cx, model.cy)) / (model.fx, model.fy)
    return np.asarray(reprojection_kernels.undistorted(lens_of(model), np.ascontiguousarray(distorted))[0])


def rays(model: CameraModel, pixels: Array) -> Array:
    """Return the viewing rays of ``pixels`` (K, 2), as points (K, 3) at depth 1 in the camera frame."""
    return np.column_stack((undistorted(model, pixels), np.ones(len(pixels))))


def folded(model: CameraModel) -> Array | None:
    """Return a pixel (2,) at which the lens model is not invertible, or None. Checks a grid of pixels over the image.

    A lens is invertible at a pixel if a direction within the valid radius projects to the pixel, with a positive
    determinant of the lens's Jacobian.
    """
    if not any(model.distortion) and not model.fisheye:
        return None
    u, v = (np.linspace(-0.5, side - 0.5, GRID) for side in (model.width, model.height))
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    lens = lens_of(model)
    distorted = (pixels - (model.cx, model.cy)) / (model.fx, model.fy)
    directions, errors = reprojection_kernels.undistorted(lens, distorted)
    bad = ~(errors < NONE)
    if not model.fisheye:  # a fisheye image may have corners beyond the valid radius, more than 90 degrees off the axis
        bad |= lens[8] * np.sum(directions**2, axis=1) >= 1.0
    return np.asarray(pixels[np.argmax(bad)]) if bad.any() else None


def linearize(model: CameraModel, pose: Array, points: Array) -> tuple[Array, Array, Array, Array]:
    """Predict the pixels of world ``points`` (K, 3) from the robot's planar ``pose`` (3,), with derivatives.

    Returns the pixels (K, 2) and three Jacobians: by the pose's body-frame perturbation (K, 2, 3), by the points (K, 2,
    3), and by corrections of :data:`PARAMETERS` (K, 2, 8). The derivative by the time offset is set to zero.
    """
    camera = lens_of(model), model.position, model.rotation
    pixels, jacobian = reprojection_kernels.linearize(camera, pose, np.ascontiguousarray(points, dtype=float))
    return pixels, jacobian[..., :TILT], jacobian[..., POINT:CONSTANTS], jacobian[..., CONSTANTS:]


def by_tilt(model: CameraModel, by_parameters: Array) -> Array:
    """Return the Jacobian (K, 2, 2) of pixels by the robot's roll and pitch, in units of their standard deviation
    ``model.tilt``. ``by_parameters`` (K, 2, 8): the Jacobian by the camera's :data:`PARAMETERS`."""
    x, y, z = model.position
    arm = np.array(((0.0, z), (-z, 0.0), (y, -x)))
    return np.asarray(model.tilt * (by_parameters[..., 3:5] + by_parameters[..., :3] @ arm))


def linearize_in_space(
    model: CameraModel, position: Array, rotation: Array, points: Array
) -> tuple[Array, Array, Array]:
    """Predict the pixels of world ``points`` (K, 3) in a camera at ``position`` (3,) with ``rotation`` (3, 3).

    Returns the pixels (K, 2) and their Jacobians by the camera's perturbation (K, 2, 6) and by the points (K, 2, 3).
    The perturbation is in the camera frame with rotation before translation, as in ``gtsam.Pose3``.
    """
    linear: tuple[Array, Array, Array] = reprojection_kernels.linearize_in_space(
        lens_of(model), *(np.ascontiguousarray(part, dtype=float) for part in (position, rotation, points))
    )
    return linear


def log_likelihood(
    model: CameraModel,
    poses: Array,
    points: Array,
    pixels: Array,
    tilts: Array,
    covariances: Array | None = None,
) -> Array:
    """Return the robust, tempered log-likelihood (N,), up to a constant, of one image at N robot poses. Each pose is
    evaluated with the roll and pitch that fit best.

    ``poses`` (N, 3): robot poses. ``points`` (K, 3): world points. ``pixels`` (K, 2): their measured pixels.
    ``tilts`` (K, 2, 2): the Jacobian of the pixels by roll and pitch, from :func:`by_tilt`.
    ``covariances`` (K, 2, 2) [px^2]: covariance of each pixel, including the error of an inexact map. None: pixel
    noise.
    """
    if covariances is None:
        whiteners = np.broadcast_to(np.eye(2) / model.sigma, (len(points), 2, 2)).copy()
    else:
        whiteners = positive.whitener(covariances)
    camera = lens_of(model), model.position, model.rotation
    poses, points, pixels = (np.ascontiguousarray(part, dtype=float) for part in (poses, points, pixels))
    sightings = poses, points, pixels, whiteners, np.ascontiguousarray(whiteners @ tilts)
    return np.asarray(reprojection_kernels.log_likelihood(*camera, *sightings, model.robust, model.tempering))


def lens_of(model: CameraModel) -> Lens:
    """Return the camera's intrinsic constants as a tuple for compiled code, see :data:`factors.camera.kernels.Lens`.
    The distortion is valid up to the radius at which its radial part stops growing. This radius is limited to
    :data:`WIDEST`, or to :data:`WIDEST_FISHEYE` for a fisheye lens."""
    focal = model.fx, model.fy, model.cx, model.cy
    if not any(model.distortion) and not model.fisheye:
        return (*map(float, focal), *(0.0,) * 5)
    k1, k2, *others = model.distortion
    if model.is_brown:
        # the slope of the radial part at q = x^2 + y^2 is 1 + 3 k1 q + 5 k2 q^2: a quadratic in 1 / q
        square = 9.0 * k1 * k1 - 20.0 * k2
        end = max(1.0 / WIDEST, 0.5 * (math.sqrt(square) - 3.0 * k1) if square > 0.0 else 0.0)
        return (*map(float, (*focal, *model.distortion)), end)
    kind = reprojection_kernels.FISHEYE if model.fisheye else reprojection_kernels.RATIONAL
    p1, p2, *others = (0.0, 0.0, *others, 0.0, 0.0) if model.fisheye else others
    widest = WIDEST_FISHEYE if model.fisheye else WIDEST
    lens = (*map(float, (*focal, k1, k2, p1, p2)), 1.0 / widest, kind, *map(float, others))
    squares = np.linspace(0.0, 1.0, STEPS)[1:] ** 2 * widest
    falls = [q for q in squares.tolist() if not reprojection_kernels.radial_slope(lens, q) > 0.0]
    return (*lens[:8], 1.0 / falls[0] if falls else lens[8], *lens[9:])


# Possible standard deviations of the robot's tilt. Most images have the same one. On a door sill it may be any other.
SCALES = 0.0005 * 2.0 ** (0.5 * np.arange(15))  # rad: from half a millimetre per metre up to 0.064
VAGUE = math.log(3.0)  # standard deviation of the logarithm of the initial guess
MEMORY = 60.0  # number of images after which old images are forgotten
SILLS = 0.05  # fraction of images with a different standard deviation of the tilt


@dataclass(frozen=True)
class TiltScale:
    """A Bayesian filter that estimates the standard deviation of the robot's roll and pitch from images.

    ``sigma``: the estimated standard deviation [rad].
    ``guess`` (15,): the log prior of each of the 15 possible standard deviations :data:`SCALES`.
    ``log_evidence`` (15,): the log-likelihood of all images so far for each standard deviation.
    """

    sigma: float
    guess: Array
    log_evidence: Array

    @staticmethod
    def guessed(sigma: float) -> TiltScale:
        """Return the filter before the first image. ``sigma`` [rad]: a rough guess of the standard deviation."""
        return TiltScale(sigma, -0.5 * (np.log(SCALES / sigma) / VAGUE) ** 2, np.zeros(len(SCALES)))

    def learnt(self, tilt: Array, covariance: Array, prior: float) -> tuple[TiltScale, float]:
        """Return the filter after an update by the tilt estimated in one image. Also returns the expected standard
        deviation [rad] of the tilt in this image.

        ``tilt`` (2,) [rad], ``covariance`` (2, 2): the estimate of roll and pitch, and its covariance. ``prior`` [rad]:
        the standard deviation of the zero-mean prior of roll and pitch that the estimate was computed with.
        """
        log_evidence = self.log_evidence.copy()
        sigma, image_sigma = _learnt(tilt, covariance, prior, self.guess, log_evidence)
        return TiltScale(sigma, self.guess, log_evidence), image_sigma


@compiled(error_model="numpy")
def _learnt(tilt: Array, covariance: Array, prior: float, prior_log: Array, log_evidence: Array) -> tuple[float, float]:
    """Return the expected standard deviations [rad] of the tilt in later images and in this image. ``tilt``,
    ``covariance``, ``prior``: as in :meth:`TiltScale.learnt`. ``prior_log`` (15,): the log prior of each standard
    deviation. ``log_evidence`` (15,): the log-likelihood of each standard deviation, is updated in place."""
    determinant = covariance[0, 0] * covariance[1, 1] - covariance[0, 1] ** 2
    a, b, d = covariance[1, 1] / determinant, -covariance[0, 1] / determinant, covariance[0, 0] / determinant
    x, y = a * tilt[0] + b * tilt[1], b * tilt[0] + d * tilt[1]
    image = np.empty(len(SCALES))
    for i, scale in enumerate(SCALES):
        # log-likelihood of the image for this standard deviation, with the prior of the estimate divided out
        more = 1.0 / scale**2 - 1.0 / prior**2
        determinant = (a + more) * (d + more) - b * b
        fit = ((d + more) * x * x - 2.0 * b * x * y + (a + more) * y * y) / determinant
        image[i] = 0.5 * (fit - math.log(determinant)) - 2.0 * math.log(scale)
    image, predicted, any_scale = _normalised(image), _normalised(prior_log + log_evidence), SILLS / len(SCALES)
    posterior = image * ((1.0 - SILLS) * predicted + any_scale)
    for i in range(len(SCALES)):
        log_evidence[i] = (1.0 - 1.0 / MEMORY) * log_evidence[i] + math.log((1.0 - SILLS) * image[i] + any_scale)
    return _scale(_normalised(prior_log + log_evidence)), _scale(posterior / posterior.sum())


@compiled(error_model="numpy")
def _normalised(log: Array) -> Array:
    """Return weights with the sum 1 from log-weights."""
    weights: Array = np.exp(log - log.max())
    weights /= weights.sum()
    return weights


@compiled(error_model="numpy")
def _scale(weights: Array) -> float:
    """Return the geometric mean of :data:`SCALES` with ``weights``. An arithmetic mean would overrate large values."""
    total = 0.0
    for i, scale in enumerate(SCALES):
        total += weights[i] * math.log(scale)
    return math.exp(total)
