"""Consistency of the monoSLAM filter without a map: the covariance belongs to an error that does not depend on the estimate.

Robot and points may be moved, turned or, up to the lever arm of the camera, enlarged together, and no image changes. A filter
whose error state is relative to the estimate gains information on these directions each time the estimate moves (Huang,
Mourikis, Roumeliotis, International Journal of Robotics Research 29(5), 2010). An error that is one common motion and enlargement
of everything preserves these directions (motion: Barrau, Bonnabel, IEEE Transactions on Automatic Control 62(4), 2017). Changing
to it before an update and back after it is a linear map of the covariance, applied by :func:`carried`.
"""

import numpy as np

from factorgraph_loc.slam.monoslam_motion import ROBOT, SHIFT, TURN, VELOCITY, cross
from factorgraph_loc.slam.monoslam_state import POSE, SlamState
from factors.camera import inverse_depth
from factors.se2 import Array


def carried(prior: SlamState, posterior: SlamState, scale: int | None) -> Array:
    """The covariance (12 + P + D, 12 + P + D) of ``posterior``, an update of ``prior``. The error is invariant and has the
    covariance of the update.

    ``scale``: index of the constant that scales distances, or None.
    """
    covariance = posterior.covariance
    own, ours = prior.robot, posterior.robot
    by_turn, by_scale = _by_turn(prior, posterior), _by_scale(prior, posterior)
    change = np.zeros((len(covariance), prior.base if scale is not None else POSE))
    change[TURN, TURN] = change[SHIFT, SHIFT] = ours.rotation.T @ own.rotation - np.eye(3)
    change[:, TURN] += by_turn @ own.rotation
    if scale is not None:
        factor = 1.0 + prior.constants[scale]
        change[:, ROBOT + scale] = by_scale / factor
        change[ROBOT + scale, ROBOT + scale] = (1.0 + posterior.constants[scale]) / factor - 1.0
    known = change.shape[1]
    covariance = covariance + change @ covariance[:known]
    covariance += covariance[:, :known] @ change.T
    return np.asarray(0.5 * (covariance + covariance.T))


def _by_turn(prior: SlamState, posterior: SlamState) -> Array:
    """The difference between two states in the error (12 + P + D,) of a rotation (3,) of the world, without the rotation."""
    own, ours = prior.robot, posterior.robot
    change = np.zeros((len(posterior.covariance), 3))
    change[SHIFT] = ours.rotation.T @ cross(own.position - ours.position)
    change[VELOCITY] = cross(own.velocity - ours.velocity)
    for point, start in zip(prior.points, prior.starts().tolist(), strict=True):
        place = prior.base + start
        change[place : place + 3] = cross(prior.values[start : start + 3] - posterior.values[start : start + 3])
        if point.ray:
            angles = slice(start + 3, start + 5)
            turned = inverse_depth.turned(posterior.values[angles]) - inverse_depth.turned(prior.values[angles])
            change[place + 3 : place + 5] = turned
    return change


def _by_scale(prior: SlamState, posterior: SlamState) -> Array:
    """How the error (12 + P + D,) of one enlargement of the world differs between two states; the scale itself is left out."""
    own, ours = prior.robot, posterior.robot
    change = np.zeros(len(posterior.covariance))
    change[SHIFT] = ours.rotation.T @ (ours.position - own.position)
    change[VELOCITY] = ours.velocity - own.velocity
    change[prior.base :] = posterior.values - prior.values
    for point, start in zip(prior.points, prior.starts().tolist(), strict=True):
        if point.ray:
            place = prior.base + start
            change[place + 3 : place + 5] = 0.0
            change[place + 5] *= -1.0
    return change
