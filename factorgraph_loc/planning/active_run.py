"""Results of an active run: a robot that drives until it is localized."""

from dataclasses import dataclass

import numpy as np

from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factors.se2 import Array


@dataclass(frozen=True)
class PlanningStep:
    """One choice of a path.

    At ``t`` [s] after ``metres`` [m], with true pose ``truth`` (3,), estimated ``pose`` (3,) and ``covariance`` (3, 3), both NaN
    before the first observation. ``particles`` (K, 3): an equally weighted sample of the belief. ``candidates``: paths (S, 3)
    from the true pose, in the world frame; ``values`` (C,): the policy's scores, higher is better, empty if it does not compare.
    ``chosen``: the chosen path, None if there was none. ``planning_ms``: computing time.
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

    ``localized``: the robot was localized correctly, after ``metres`` [m] and ``seconds`` [s], with ``error_position`` [m] and
    ``error_heading`` [rad]; otherwise these are the values at the end. ``claimed_wrong``: at some time the estimator claimed to
    be localized with an error above three times the limits. ``truth``: the true trajectory. ``steps``: the choices.
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
        """Computing times (N,) [ms] of the choices."""
        return np.array([step.planning_ms for step in self.steps])
