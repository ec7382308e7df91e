"""Priors of the start pose, pose estimates, beliefs, and other estimates: constants of sensors, landmarks, points."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from factorgraph_loc.maps.points import PointMap
from factors.se2 import Array

# of a start given as a pose only
POSITION_SIGMA = 0.05  # m
HEADING_SIGMA = 0.05  # rad
EXACT_SIGMA = 1e-3  # m and rad: of a start that defines the frame

Status = Literal["unlocalized", "ambiguous", "localized"]


@dataclass(frozen=True)
class PosePrior:
    """Gaussian prior of the start pose.

    ``pose`` (3,) is (x, y, heading) at ``t`` with ``covariance`` (3, 3), in the world frame. ``has_heading`` is False if the
    heading is unknown: it is 0 then, with the variance of a uniform distribution.
    """

    t: float
    pose: Array
    covariance: Array
    has_heading: bool = True

    @staticmethod
    def at_position(t: float, position: Array, covariance: Array) -> PosePrior:
        """Prior of a ``position`` (2,) with ``covariance`` (2, 2) and unknown heading."""
        whole = np.diag((0.0, 0.0, math.pi**2 / 3.0))
        whole[:2, :2] = covariance
        return PosePrior(t, np.append(position, 0.0), whole, has_heading=False)


@dataclass(frozen=True)
class PoseEstimate:
    """A causal estimate: ``pose`` (3,) at ``t`` with ``covariance`` (3, 3) of (x, y, heading) in the world frame.

    ``status``: of the pose. ``doubts_model``: whether measurements contradict the model of their sensor; the covariance may be
    too small then.
    """

    t: float
    pose: Array
    covariance: Array
    status: Status
    doubts_model: bool = False


@dataclass(frozen=True)
class Mode:
    """One Gaussian mode of a belief, in the world frame."""

    weight: float
    pose: Array
    covariance: Array


@dataclass(frozen=True)
class Belief:
    """The current belief: weighted Gaussian modes, and particles (N, 3) with weights (N,) if the estimator uses particles."""

    modes: tuple[Mode, ...]
    particles: Array | None = None
    weights: Array | None = None


def gaussian_belief(estimate: PoseEstimate) -> Belief:
    """The belief of a Gaussian estimator; it has no modes if the estimate is not finite."""
    if not np.isfinite(estimate.pose).all():
        return Belief(())
    return Belief((Mode(1.0, np.array(estimate.pose), np.array(estimate.covariance)),))


@dataclass(frozen=True)
class LearntPoint:
    """Estimated ``position`` (2,) [m] of a landmark with ``covariance`` (2, 2) of (x, y), in the world frame."""

    position: Array
    covariance: Array


@dataclass(frozen=True)
class Learnt:
    """Estimates besides the poses.

    ``values``: constants by name, each (value, standard deviation) in SI units. Constants of odometry have plain names
    (``scale_distance``), those of other sensors a prefix (``bearing_range.x``). ``landmarks``: by name. ``points``: points in
    space that are not in the map, or None.
    """

    values: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    landmarks: Mapping[str, LearntPoint] = field(default_factory=dict)
    points: PointMap | None = None
