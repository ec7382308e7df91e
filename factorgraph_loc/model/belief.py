"""What an estimator is told of the start, and what it believes of the pose."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from factors.se2 import Array

# of a start that is told as a pose alone
POSITION_SIGMA = 0.05  # m
HEADING_SIGMA = 0.05  # rad

Status = Literal["unlocalized", "ambiguous", "localized"]


@dataclass(frozen=True)
class PosePrior:
    """What is known of the start: ``pose`` (3,) at ``t`` with ``covariance`` (3, 3) of (x, y, heading) in the world's frame;
    ``space``: of a robot that is not on a floor. ``has_heading``: False where the heading may be any; that of the pose is 0 then,
    and its variance that of a uniform distribution."""

    t: float
    pose: Array
    covariance: Array
    space: SpacePose | None = None
    has_heading: bool = True

    @staticmethod
    def at_position(t: float, position: Array, covariance: Array) -> PosePrior:
        """At a ``position`` (2,) with ``covariance`` (2, 2), and any heading."""
        whole = np.diag((0.0, 0.0, math.pi**2 / 3.0))
        whole[:2, :2] = covariance
        return PosePrior(t, np.append(position, 0.0), whole, has_heading=False)


@dataclass(frozen=True)
class SpacePose:
    """A robot in space: ``position`` (3,) [m] and ``rotation`` (3, 3) in the world's frame, with the ``covariance`` (6, 6) of its
    perturbation in its own frame, turn first, then shift, as ``gtsam.Pose3`` has them."""

    position: Array
    rotation: Array
    covariance: Array


@dataclass(frozen=True)
class PoseEstimate:
    """A causal estimate: ``pose`` (3,) at ``t`` with ``covariance`` (3, 3) of (x, y, heading) in the world's frame; ``space``: of
    an estimator that knows the robot's pose in space."""

    t: float
    pose: Array
    covariance: Array
    status: Status
    space: SpacePose | None = None


@dataclass(frozen=True)
class Mode:
    """One Gaussian mode of a belief, in the world's frame."""

    weight: float
    pose: Array
    covariance: Array


@dataclass(frozen=True)
class Belief:
    """What an estimator believes now: weighted Gaussian modes, and particles (N, 3) with weights (N,) where it has them."""

    modes: tuple[Mode, ...]
    particles: Array | None = None
    weights: Array | None = None


def gaussian_belief(estimate: PoseEstimate) -> Belief:
    """The belief of an estimator that has one Gaussian; nothing is believed where the estimate is not a number."""
    if not np.isfinite(estimate.pose).all():
        return Belief(())
    return Belief((Mode(1.0, np.array(estimate.pose), np.array(estimate.covariance)),))
