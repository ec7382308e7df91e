"""Accuracy of poses in space against the reference, and consistency of their covariances."""

from typing import Any

import numpy as np
import scipy

from factorgraph_loc.evaluation.pairing import pairs_in_space, rms
from factorgraph_loc.model.scoring import MAX_GAP
from factorgraph_loc.model.trajectory3 import Trajectory3
from factors import chi_squared, positive
from factors.se2 import Array

DOF = 6
CONFIDENCE = 0.95
FIGURES = (
    "space_position_rmse",
    "space_position_max",
    "space_rotation_rmse",
    "space_anees",
    "space_coverage_95",
    "space_scored",
)


def accuracy(found: Trajectory3 | None, reference: Trajectory3 | None, max_gap: float = MAX_GAP) -> dict[str, Any]:
    """:data:`FIGURES` of a trajectory in space against the reference, without alignment; all None without either.

    Pairing: see :func:`~factorgraph_loc.evaluation.pairing.pairs_in_space`. ``space_position_*`` [m]; ``space_rotation_rmse``
    [rad]: of the angle between estimated and true orientation. ``space_anees``: mean NEES of the pose, ideally 6;
    ``space_coverage_95``: fraction of the times at which it is below the 95 % quantile. ``space_scored``: number of poses of the
    reference with an estimate.
    """
    figures: dict[str, Any] = dict.fromkeys(FIGURES)
    if found is None or reference is None or not len(found):
        return figures
    estimates, truth = pairs_in_space(found, reference, max_gap)
    figures["space_scored"] = len(estimates)
    if not len(estimates):
        return figures
    errors = pose_errors(estimates, truth)
    distance = np.linalg.norm(errors[:, 3:], axis=1)
    figures["space_position_rmse"], figures["space_position_max"] = rms(distance), float(distance.max())
    figures["space_rotation_rmse"] = rms(np.linalg.norm(errors[:, :3], axis=1))
    if estimates.covariances is not None:
        spread = estimates.covariances
        good = np.linalg.eigvalsh(spread)[:, 0] > 0.0
        if good.any():
            nees = np.einsum("ni,ni->n", errors[good], positive.solve(spread[good], errors[good, :, None])[..., 0])
            figures["space_anees"] = float(nees.mean())
            figures["space_coverage_95"] = float(np.mean(nees < chi_squared.quantile(CONFIDENCE, DOF)))
    return figures


def pose_errors(found: Trajectory3, truth: Trajectory3) -> Array:
    """The perturbations (N, 6) from estimated to true poses, rotation first, in the estimate's frame."""
    back = found.rotations.transpose(0, 2, 1)
    turns = scipy.spatial.transform.Rotation.from_matrix(back @ truth.rotations).as_rotvec()
    return np.column_stack((turns, np.einsum("nij,nj->ni", back, truth.positions - found.positions)))
