"""The past of the monoSLAM filter: a record after each measurement, and their smoothing (Rauch, Tung, Striebel, 1965)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from factorgraph_loc.slam.monoslam_motion import ROBOT, RobotState, Step
from factorgraph_loc.slam.monoslam_state import POSE
from factors import positive
from factors.se2 import Array


@dataclass(frozen=True)
class UpdateRecord:
    """``step``: from the previous record; ``covariance`` (12 + P, 12 + P): of ``robot`` and ``constants`` (P,) after the update.
    ``relocalized``: the pose is independent of the past.
    """

    t: float
    step: Step
    robot: RobotState
    constants: Array
    covariance: Array
    relocalized: bool = False


def smoothed(records: Sequence[UpdateRecord]) -> list[UpdateRecord]:
    """The records, smoothed with all later ones. Velocity and turn rate have no later influence and are not smoothed."""
    results = list(records[-1:])
    for next_record, record in zip(records[:0:-1], records[-2::-1], strict=True):
        results.append(record if next_record.relocalized else _smoothed(record, next_record, results[-1]))
    return results[::-1]


def _smoothed(record: UpdateRecord, next_record: UpdateRecord, later: UpdateRecord) -> UpdateRecord:
    """The smoothed ``record``; ``later``: the smoothed ``next_record``."""
    total, known = len(record.covariance), next_record.step.transition.shape[1]
    transition = np.zeros((POSE, total))
    transition[:, :known] = next_record.step.transition[:POSE]
    kept = np.r_[0:POSE, ROBOT:total]
    block = np.ix_(kept, kept)
    error = np.concatenate((later.robot.minus(next_record.step.robot), later.constants - record.constants))
    motion = transition[:, kept], next_record.step.noise[:POSE, :POSE]
    change, covariance = np.zeros(total), record.covariance.copy()
    change[kept], covariance[block] = positive.smoothed(
        record.covariance[block], *motion, error[kept], later.covariance[block]
    )
    robot, constants = record.robot.plus(change[:ROBOT]), record.constants + change[ROBOT:]
    return replace(record, robot=robot, constants=constants, covariance=covariance, relocalized=False)
