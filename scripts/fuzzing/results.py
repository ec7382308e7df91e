"""Invariants of the answers of a ``Localizer``: finite, with positive definite covariances."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from fuzzing.verdicts import WrongResultError


def check_estimate(found: Any) -> None:
    if found.status == "unlocalized" and not np.isfinite(found.pose).all():
        return
    check_pose("the estimate", found.pose, found.covariance)


def check_pose(what: str, pose: Any, covariance: Any) -> None:
    """A pose is finite, its covariance positive."""
    if not (np.isfinite(pose).all() and np.isfinite(covariance).all()):
        raise WrongResultError(
            f"{what} is not finite: {np.asarray(pose).tolist()}, covariance {np.asarray(covariance).tolist()}"
        )
    variances = np.diag(covariance)
    if np.any(variances <= 0.0):
        raise WrongResultError(f"{what} has variances {variances.tolist()}")
    scale = np.sqrt(variances)
    correlation = covariance / np.outer(scale, scale)
    if not np.allclose(correlation, correlation.T, atol=1e-6) or np.linalg.eigvalsh(correlation)[0] < -1e-6:
        raise WrongResultError(f"{what} has no positive covariance: {np.asarray(covariance).tolist()}")


def check_belief(found: Any) -> None:
    for mode in found.modes:
        check_pose("a mode", mode.pose, mode.covariance)
    for values in (found.particles, found.weights):
        if values is not None and not np.isfinite(values).all():
            raise WrongResultError("particles are not finite")


def check_trajectory(found: Any) -> None:
    if not np.isfinite(found.poses).all() or np.any(np.diff(found.t) <= 0.0):
        raise WrongResultError("the trajectory is not finite or not in order")
    if found.covariances is not None and np.any(np.diagonal(found.covariances, axis1=1, axis2=2) < 0.0):
        raise WrongResultError("the trajectory has variances below 0")


def check_learnt(found: Any) -> None:
    if not np.isfinite([number for pair in found.values.values() for number in pair]).all():
        raise WrongResultError(f"what was learnt is not finite: {found.values}")
    for name, landmark in found.landmarks.items():
        if not np.isfinite(landmark.position).all():
            raise WrongResultError(f"landmark {name} is not finite")


CHECKS: dict[str, Callable[[Any], None]] = {
    "estimate": check_estimate,
    "belief": check_belief,
    "learnt": check_learnt,
    "trajectory": check_trajectory,
    "diagnostics": lambda _: None,
}
