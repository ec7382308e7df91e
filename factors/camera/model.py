"""A pinhole camera with lens distortion on a robot: projection and its derivatives.

The camera is mounted on the robot at ``rTc``; its axes are z forward, x right, y down. A point in the camera frame is seen at the
pixel (fx x + cx, fy y + cy) of its distorted direction (x, y), with radial and tangential distortion (k1, k2, p1, p2) after
Brown, "Close-range camera calibration", Photogrammetric Engineering 37(8), 1971, as in OpenCV and ``gtsam.Cal3DS2``. Pixel noise is
Gaussian with Huber's loss (1964) against outliers.

Rational polynomials and fisheye lenses (Kannala and Brandt, 2006) are as in OpenCV too.

The distortion is used up to the radius where the lens would fold the image; directions beyond it, outside of the image of an
invertible lens, are extrapolated radially, so that they do not appear in the image. Points nearer than
:data:`~factors.camera.kernels.NEAREST`, or behind the camera, are treated as at that depth: all values are finite and nothing
raises.
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

# the constants of a camera that can be estimated: position [m] and small rotations [rad] about the robot's axes, logarithm of the
# focal length, and time offset [s] of images relative to their timestamps
PARAMETERS = ("x", "y", "z", "roll", "pitch", "yaw", "focal", "time_offset")
FOCAL, TIME_OFFSET = PARAMETERS.index("focal"), PARAMETERS.index("time_offset")
WIDEST = 4.0  # of x^2 + y^2 (63 degrees off the axis): maximum for the distortion polynomial
WIDEST_FISHEYE = 400.0  # likewise (87 degrees)
STEPS = 1000  # radii at which the slope of a distortion is checked
GRID = 33  # rows and columns of pixels at which a lens is checked
PLANAR = [3, 4, 2]  # indices in the perturbation of a pose in space: x, y and heading of a level robot
NONE = 1e-9  # tolerance of distorted directions

# columns: axes of a forward-facing camera in the robot frame (z up)
FORWARD: Array = np.array(((0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)))


@dataclass(frozen=True, slots=True)
class CameraModel:
    """A camera and its noise.

    ``fx``, ``fy``, ``cx``, ``cy`` [px]; ``distortion`` (k1, k2, p1, p2) or (k1, k2, p1, p2, k3, k4, k5, k6), or of a ``fisheye``
    (k1, k2, k3, k4), as in OpenCV; ``width``, ``height`` [px] of its images. ``position`` (3,) [m] and ``rotation`` (3, 3) of the
    camera in the robot frame. ``sigma`` [px] in u and in v; ``robust``: scale of Huber's loss in standard deviations.
    ``tempering``: exponent of the likelihood, below 1 if errors are correlated between images. ``tilt``: standard deviation [rad]
    of the robot's roll and pitch, which all points of an image have in common: no floor is level to a pixel.
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
        """Focal lengths, principal point and distortion as an array."""
        return np.array((self.fx, self.fy, self.cx, self.cy, *self.distortion, *((1.0,) if self.fisheye else ())))

    def matrix(self) -> Array:
        """The camera matrix (3, 3)."""
        return np.array(((self.fx, 0.0, self.cx), (0.0, self.fy, self.cy), (0.0, 0.0, 1.0)))

    @property
    def is_brown(self) -> bool:
        """Whether the lens has Brown's distortion (k1, k2, p1, p2)."""
        return len(self.distortion) == 4 and not self.fisheye

    def calibration(self) -> gtsam.Cal3DS2:
        """The calibration for GTSAM, if the lens :attr:`is_brown`."""
        return gtsam.Cal3DS2(self.fx, self.fy, 0.0, self.cx, self.cy, *self.distortion)

    def contains(self, pixels: Array, margin: float = 0.0) -> Any:
        """Whether ``pixels`` (..., 2) are in the image, or at most ``margin`` pixels outside of it: booleans (...)."""
        u, v = pixels[..., 0], pixels[..., 1]
        inside = (u >= -0.5 - margin) & (u <= self.width - 0.5 + margin)
        return inside & (v >= -0.5 - margin) & (v <= self.height - 0.5 + margin)


def mounting(roll: float, pitch: float, yaw: float) -> Array:
    """The rotation (3, 3) of a camera in the robot frame. The forward-facing camera is rotated by ``roll`` about x, ``pitch`` about
    y (down is positive), ``yaw`` about z (left is positive)."""
    return np.asarray(gtsam.Rot3.RzRyRx(roll, pitch, yaw).matrix() @ FORWARD)


def angles_of_camera(rotation: Array) -> tuple[float, float, float]:
    """Roll, pitch and yaw of a camera whose optical axes are ``rotation`` (3, 3) in the robot frame: the inverse of
    :func:`mounting`."""
    roll, pitch, yaw = gtsam.Rot3(rotation @ FORWARD.T).xyz().tolist()
    return roll, pitch, yaw


def recalibrated(model: CameraModel, changes: Array) -> CameraModel:
    """The model with corrections ``changes`` (8,) of :data:`PARAMETERS`; the time offset is ignored."""
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
    """Pixels (K, 2) of ``points`` (K, 3) in the camera frame."""
    return np.asarray(reprojection_kernels.project(lens_of(model), np.ascontiguousarray(points, dtype=float))[0])


def in_camera(model: CameraModel, pose: Array, points: Array) -> Array:
    """World ``points`` (K, 3) in the frame of the camera of a robot at ``pose`` (3,)."""
    local = np.empty_like(points, dtype=float)
    local[:, :2] = se2.transform_to(pose, points[:, :2])
    local[:, 2] = points[:, 2]
    return np.asarray((local - model.position) @ model.rotation)


def mounted(model: CameraModel, position: Array, rotation: Array) -> tuple[Array, Array]:
    """Position (3,) and rotation (3, 3) in the world of the camera of a robot at ``position`` (3,) with ``rotation`` (3, 3)."""
    return position + rotation @ model.position, rotation @ model.rotation


def lift(model: CameraModel) -> Array:
    """Jacobian (6, 6) of the camera's perturbation in its own frame by that of the robot, rotation before translation in both."""
    x, y, z = model.position
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = jacobian[3:, 3:] = model.rotation.T
    jacobian[3:, :3] = -model.rotation.T @ np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))
    return jacobian


def carrier(model: CameraModel, position: Array, rotation: Array) -> tuple[Array, Array]:
    """The inverse of :func:`mounted`: the robot whose camera is at ``position`` (3,) with ``rotation`` (3, 3)."""
    turn = rotation @ model.rotation.T
    return position - turn @ model.position, turn


def camera_pose(model: CameraModel, pose: Array, tilt: Array | None = None) -> tuple[Array, Array]:
    """Position (3,) and rotation (3, 3) in the world of the camera of a robot at ``pose`` (3,) with the ``tilt`` (2,) [rad], a
    rotation about its own x and y axes, by default none."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    turn = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
    if tilt is not None:
        turn = turn @ gtsam.Rot3.Expmap(np.append(tilt, 0.0)).matrix()
    return mounted(model, np.array((pose[0], pose[1], 0.0)), turn)


def predict(model: CameraModel, pose: Array, points: Array) -> tuple[Array, Array]:
    """Pixels (K, 2) of world ``points`` (K, 3) from ``pose`` (3,), and their depths (K,) [m], negative behind the camera."""
    local = in_camera(model, pose, points)
    return project(model, local), local[:, 2]


def undistorted(model: CameraModel, pixels: Array) -> Array:
    """Directions (K, 2), as (x, y) at depth 1 in the camera frame, of ``pixels`` (K, 2): the inverse of :func:`project`, by
    Newton's method."""
    distorted = (np.asarray(pixels, dtype=float) - (model.cx, model.cy)) / (model.fx, model.fy)
    return np.asarray(reprojection_kernels.undistorted(lens_of(model), np.ascontiguousarray(distorted))[0])


def rays(model: CameraModel, pixels: Array) -> Array:
    """The points (K, 3) at depth 1 in the camera frame of ``pixels`` (K, 2)."""
    return np.column_stack((undistorted(model, pixels), np.ones(len(pixels))))


def folded(model: CameraModel) -> Array | None:
    """A pixel (2,) at which the lens is not invertible, on a grid over the image; None if it is invertible everywhere.

    The lens is invertible where the determinant of its Jacobian is positive within the valid radius of the polynomial.
    """
    if not any(model.distortion) and not model.fisheye:
        return None
    u, v = (np.linspace(-0.5, side - 0.5, GRID) for side in (model.width, model.height))
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    lens = lens_of(model)
    distorted = (pixels - (model.cx, model.cy)) / (model.fx, model.fy)
    directions, errors = reprojection_kernels.undistorted(lens, distorted)
    bad = ~(errors < NONE)
    if not model.fisheye:  # images of a fisheye lens may have corners beyond a right angle
        bad |= lens[8] * np.sum(directions**2, axis=1) >= 1.0
    return np.asarray(pixels[np.argmax(bad)]) if bad.any() else None


def linearize(model: CameraModel, pose: Array, points: Array) -> tuple[Array, Array, Array, Array]:
    """Pixels (K, 2) of ``points`` (K, 3) from the planar ``pose`` (3,), and their Jacobians: by the pose's body-frame perturbation
    (K, 2, 3), by the points (K, 2, 3), and by corrections of :data:`PARAMETERS` (K, 2, 8); that by the time offset is zero, as it
    needs the robot's velocity."""
    camera = lens_of(model), model.position, model.rotation
    pixels, jacobian = reprojection_kernels.linearize(camera, pose, np.ascontiguousarray(points, dtype=float))
    return pixels, jacobian[..., :TILT], jacobian[..., POINT:CONSTANTS], jacobian[..., CONSTANTS:]


def by_tilt(model: CameraModel, by_parameters: Array) -> Array:
    """Jacobian (K, 2, 2) by the robot's roll and pitch about its axes on the floor, in standard deviations, from that by
    :data:`PARAMETERS` (K, 2, 8): the camera turns, and is moved."""
    x, y, z = model.position
    arm = np.array(((0.0, z), (-z, 0.0), (y, -x)))
    return np.asarray(model.tilt * (by_parameters[..., 3:5] + by_parameters[..., :3] @ arm))


def linearize_in_space(
    model: CameraModel, position: Array, rotation: Array, points: Array
) -> tuple[Array, Array, Array]:
    """Pixels (K, 2) of ``points`` (K, 3) in a camera at ``position`` (3,) with ``rotation`` (3, 3) in the world; their Jacobians by
    the camera's perturbation (K, 2, 6), rotation before translation, both in the camera frame as in ``gtsam.Pose3``, and by the
    points (K, 2, 3)."""
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
    """The robust, tempered log-likelihood (N,), up to a constant, of seeing ``points`` (K, 3) at ``pixels`` (K, 2) from ``poses``
    (N, 3), each with the tilt that fits best; ``tilts`` (K, 2, 2): see :func:`by_tilt`.

    ``covariances`` (K, 2, 2) [px^2]: of each pixel, including the map's error; by default the pixel noise only.
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
    """The camera's constants for the kernels. The distortion is valid up to the radius where its radial part stops growing, at most
    :data:`WIDEST` or :data:`WIDEST_FISHEYE`."""
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


# how level a floor is: the standard deviation of the robot's tilt is one of these. It is the same in most images; in a few, such as
# those on a sill, it may be any of them
SCALES = 0.0005 * 2.0 ** (0.5 * np.arange(15))  # rad: of half a millimetre in a metre, up to 0.064
VAGUE = math.log(3.0)  # standard deviation of the logarithm of the first guess
MEMORY = 60.0  # images that the scale is learnt from
SILLS = 0.05  # share of images with another scale


@dataclass(frozen=True)
class TiltScale:
    """A Bayesian filter of the tilt's scale, which measures how level a floor is. All points of an image share one tilt.

    ``sigma``: the standard deviation [rad] of roll and pitch. For each of the :data:`SCALES`, ``guess``: log prior;
    ``log_evidence``: log-likelihood of the images."""

    sigma: float
    guess: Array
    log_evidence: Array

    @staticmethod
    def guessed(sigma: float) -> TiltScale:
        """A guess, which is rough."""
        return TiltScale(sigma, -0.5 * (np.log(SCALES / sigma) / VAGUE) ** 2, np.zeros(len(SCALES)))

    def learnt(self, tilt: Array, covariance: Array, prior: float) -> tuple[TiltScale, float]:
        """The filter updated by the ``tilt`` (2,) of an image with ``covariance`` (2, 2), estimated with the prior sigma ``prior``;
        and the expected standard deviation in this image."""
        log_evidence = self.log_evidence.copy()
        sigma, image_sigma = _learnt(tilt, covariance, prior, self.guess, log_evidence)
        return TiltScale(sigma, self.guess, log_evidence), image_sigma


@compiled(error_model="numpy")
def _learnt(tilt: Array, covariance: Array, prior: float, prior_log: Array, log_evidence: Array) -> tuple[float, float]:
    """The expected standard deviations later and in this image: :meth:`TiltScale.learnt`. Updates ``log_evidence``."""
    determinant = covariance[0, 0] * covariance[1, 1] - covariance[0, 1] ** 2
    a, b, d = covariance[1, 1] / determinant, -covariance[0, 1] / determinant, covariance[0, 0] / determinant
    x, y = a * tilt[0] + b * tilt[1], b * tilt[0] + d * tilt[1]
    image = np.empty(len(SCALES))
    for i, scale in enumerate(SCALES):
        # likelihood of the image under this scale, with its prior divided out
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
    weights: Array = np.exp(log - log.max())
    weights /= weights.sum()
    return weights


@compiled(error_model="numpy")
def _scale(weights: Array) -> float:
    """The mean of its logarithm, as a few large scales would dominate any other."""
    total = 0.0
    for i, scale in enumerate(SCALES):
        total += weights[i] * math.log(scale)
    return math.exp(total)
