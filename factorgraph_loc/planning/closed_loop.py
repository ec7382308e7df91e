"""A simulated robot that chooses where to drive until it knows where it is."""

from __future__ import annotations

from factorgraph_loc.planning.active_run import ActiveRun
from factorgraph_loc.planning.settings import ActiveSettings
from factorgraph_loc.simulation.settings import SimulationSettings

POLICIES = ("information", "paper_literal", "random", "patrol", "nearest_tags")
ESTIMATORS = ("active_mcl", "particle_filter", "smoother")


def run_active(
    simulation: SimulationSettings, policy: str, estimator: str, seed: int, settings: ActiveSettings | None = None
) -> ActiveRun:
    """Drive from an unknown start until the place is known, or until the robot gives up.

    Runs of one seed share world, start, and all draws of noise, whatever the policy and the estimator. InputError names a wrong
    policy, estimator or start.
    """
    raise NotImplementedError
