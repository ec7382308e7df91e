"""Priors of the start pose, estimated poses, beliefs, and estimated constants of sensors, landmarks and points."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from factorgraph_loc.maps.points import PointMap
from factors.se2 import Array

# standard deviations of a start pose that is given without a covariance
POSITION_SIGMA = 0.05  # m
HEADING_SIGMA = 0.05  # rad
EXACT_SIGMA = 1e-3  # m and rad: standard deviations of a start pose that defines the world frame

Status = Literal["unlocalized", "ambiguous", "localized"]


@dataclass(frozen=True)
class PosePrior:
    """Gaussian prior of the start pose.

    ``pose`` (3,): x, y [m], heading [rad] at time ``t`` [s], with ``covariance`` (3, 3), in the world frame.
    ``has_heading``: False if the heading is unknown. The heading of ``pose`` is then 0, with the variance of a uniform
    distribution.
    """

    t: float
    pose: Array
    covariance: Array
    has_heading: bool = True

    @staticmethod
    def at_position(t: float, position: Array, covariance: Array) -> PosePrior:
        """Return the prior of a ``position`` (2,) [m] at time ``t`` [s], with ``covariance`` (2, 2) [m^2] and unknown
        heading."""
        whole = np.diag((0.0, 0.0, math.pi**2 / 3.0))
        whole[:2, :2] = covariance
        return PosePrior(t, np.append(position, 0.0), whole, has_heading=False)


@dataclass(frozen=True)
class PoseEstimate:
    """The pose at a time, estimated from the measurements up to that time.

    ``t``: time [s]. ``pose`` (3,): x, y [m] and heading [rad] in the world frame. ``covariance`` (3, 3) of (x, y,
    heading). ``status``: whether the pose is known, ambiguous or unknown. ``doubts_model``: True if measurements
    contradict the model of their sensor, so that the covariance may be too small.
    """

    t: float
    pose: Array
    covariance: Array
    status: Status
    doubts_model: bool = False


@dataclass(frozen=True)
class Mode:
    """One Gaussian mode of a belief. ``weight``: from 0 to 1. ``pose`` (3,), ``covariance`` (3, 3): in the world
    frame."""

    weight: float
    pose: Array
    covariance: Array


@dataclass(frozen=True)
class Belief:
    """The probability distribution of the current pose.

    ``modes``: weighted Gaussians. ``particles`` (N, 3): poses in the world frame, with ``weights`` (N,). Both are None
    if the estimator uses no particles.
    """

    modes: tuple[Mode, ...]
    particles: Array | None = None
    weights: Array | None = None


def gaussian_belief(estimate: PoseEstimate) -> Belief:
    """Return a belief with the Gaussian ``estimate`` as its only mode, or without modes if it is not finite."""
    if not np.isfinite(estimate.pose).all():
        return Belief(())
    return Belief((Mode(1.0, np.array(estimate.pose), np.array(estimate.covariance)),))


@dataclass(frozen=True)
class LearntPoint:
    """The ``position`` (2,) [m] of a landmark, with ``covariance`` (2, 2) [m^2] of (x, y), in the world frame."""

    position: Array
    covariance: Array


@dataclass(frozen=True)
class Learnt:
    """The estimated sensor constants and landmarks of a run.

    ``values``: {name: (value, standard deviation)} of sensor constants in SI units. Constants of odometry have plain
    names (``scale_distance``), other constants have the sensor as a prefix (``bearing_range.x``). ``landmarks``:
    estimated landmarks by name. ``points``: estimated points in space that the map lacks, or None.
    """

    values: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    landmarks: Mapping[str, LearntPoint] = field(default_factory=dict)
    points: PointMap | None = None
