"""What an active run was like: a robot that drives until it knows where it is."""

from dataclasses import dataclass

import numpy as np

from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factors.se2 import Array


@dataclass(frozen=True)
class PlanningStep:
    """One choice of a way.

    At ``t`` [s] after ``metres`` [m], the robot being at ``truth`` (3,) and estimated at ``pose`` (3,) with ``covariance`` (3, 3),
    both NaN before anything was seen. ``particles`` (K, 3): equally likely ones of the belief. ``candidates``: ways (S, 3) from the
    robot's true place, in the world's frame; ``values`` (C,): what the policy thought of them, higher is better, empty where it
    compares none. ``chosen``: the way that was taken, as a candidate is, None where there was none. ``planning_ms``: time
    that it took to choose.
    """

    t: float
    metres: float
    truth: Array
    pose: Array
    covariance: Array
    particles: Array
    candidates: tuple[Array, ...]
    values: Array
    chosen: Array | None
    planning_ms: float


@dataclass(frozen=True)
class ActiveRun:
    """A run of one policy with one estimator in one world.

    ``localized``: it knew where it was, and truly, after ``metres`` [m] and ``seconds`` [s], with ``error_position`` [m] and
    ``error_heading`` [rad]; otherwise these are those at the end. ``claimed_wrong``: at some time it said that it knew, and was
    wrong by more than three times the limits. ``truth``: where it went. ``steps``: its choices.
    """

    seed: int
    preset: str
    world: World
    policy: str
    estimator: str
    localized: bool
    metres: float
    seconds: float
    error_position: float
    error_heading: float
    claimed_wrong: bool
    truth: Trajectory
    steps: tuple[PlanningStep, ...]

    @property
    def planning_ms(self) -> Array:
        """The time (N,) [ms] that each choice took."""
        return np.array([step.planning_ms for step in self.steps])
