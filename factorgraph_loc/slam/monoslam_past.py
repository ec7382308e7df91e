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
    ``anew``: the pose was found by relocalization, independent of the past.
    """

    t: float
    step: Step
    robot: RobotState
    constants: Array
    covariance: Array
    anew: bool = False


def smoothed(records: Sequence[UpdateRecord]) -> list[UpdateRecord]:
    """The records, smoothed with all later ones. Velocity and turn rate have no later influence and are not smoothed."""
    found = list(records[-1:])
    for after, here in zip(records[:0:-1], records[-2::-1], strict=True):
        found.append(here if after.anew else _smoothed(here, after, found[-1]))
    return found[::-1]


def _smoothed(here: UpdateRecord, after: UpdateRecord, later: UpdateRecord) -> UpdateRecord:
    """The record ``here`` given ``later``, which is the smoothed ``after``."""
    total, known = len(here.covariance), after.step.transition.shape[1]
    transition = np.zeros((POSE, total))
    transition[:, :known] = after.step.transition[:POSE]
    kept = np.r_[0:POSE, ROBOT:total]
    block = np.ix_(kept, kept)
    error = np.concatenate((later.robot.minus(after.step.robot), later.constants - here.constants))
    motion = transition[:, kept], after.step.noise[:POSE, :POSE]
    change, covariance = np.zeros(total), here.covariance.copy()
    change[kept], covariance[block] = positive.smoothed(
        here.covariance[block], *motion, error[kept], later.covariance[block]
    )
    robot, constants = here.robot.plus(change[:ROBOT]), here.constants + change[ROBOT:]
    return replace(here, robot=robot, constants=constants, covariance=covariance, anew=False)
