"""Consistency of the monoSLAM filter without a map: its covariance is updated in an error state that is invariant.

No image changes if robot and points are moved, turned or enlarged together (enlarged: up to the lever arm of the camera). These
directions are unobservable. A filter whose error state is relative to the estimate gains false information on these directions
each time the estimate moves (Huang, Mourikis, Roumeliotis, International Journal of Robotics Research 29(5), 2010). An invariant
error is one common motion and enlargement of robot and points. It preserves these directions (motion: Barrau, Bonnabel, IEEE
Transactions on Automatic Control 62(4), 2017). To change to the invariant error before an update and back after the update is a
linear map of the covariance. :func:`carried` applies this map.
"""

import numpy as np

from factorgraph_loc.slam.monoslam_motion import ROBOT, SHIFT, TURN, VELOCITY, cross
from factorgraph_loc.slam.monoslam_state import POSE, SlamState
from factors.camera import inverse_depth
from factors.se2 import Array


def carried(prior: SlamState, posterior: SlamState, scale: int | None) -> Array:
    """Return the covariance (12 + P + D, 12 + P + D) of ``posterior`` without false information on unobservable
    directions, which an ordinary update adds. P is the number of constants of the odometry, and D the number of values
    of points. ``prior``: the state before the update. ``posterior``: the state after an ordinary update, with its
    covariance. ``scale``: the index of the odometry's constant that scales distances, or None if this constant is not
    estimated."""
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
    """Return the Jacobian (12 + P + D, 3) of the error state by a rotation of the world, at ``posterior`` minus at
    ``prior``. The rows of the robot's rotation are zero."""
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
    """Return the derivative (12 + P + D,) of the error state by the scale of the world, at ``posterior`` minus at
    ``prior``. The row of the scale itself is zero."""
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
