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
    """``step``: from the previous record; ``predicted``, ``covariance`` (12 + P, 12 + P): before and after the update, of ``robot``
    and ``constants`` (P,). ``anew``: the pose was found by relocalization, independent of the past.
    """

    t: float
    step: Step
    predicted: Array
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
    total = len(here.covariance)
    known = after.step.transition.shape[1]
    transition = np.eye(total)
    transition[:ROBOT, :known] = after.step.transition
    kept = np.r_[0:POSE, ROBOT:total]
    block = np.ix_(kept, kept)
    own, predicted = here.covariance[block], after.predicted[block]
    gain = positive.solve(predicted, transition[block] @ own).T
    error = np.concatenate((later.robot.minus(after.step.robot), later.constants - here.constants))
    change = np.zeros(total)
    change[kept] = gain @ error[kept]
    own = own + gain @ (later.covariance[block] - predicted) @ gain.T
    covariance = here.covariance.copy()
    covariance[block] = 0.5 * (own + own.T)
    robot, constants = here.robot.plus(change[:ROBOT]), here.constants + change[ROBOT:]
    return replace(here, robot=robot, constants=constants, covariance=covariance, anew=False)
